"""The pinhole camera: pixel (u, v) looks along ((u - cx)/fx, (v - cy)/fy, 1) of the optical frame C (x right, y down).

Pixel centres have integer coordinates, as in ROS, so the principal point of a w x h image is ((w - 1)/2, (h - 1)/2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_models.scenario.schema import Camera


@dataclass(frozen=True, slots=True)
class Pinhole:
    """Intrinsics in pixels, without distortion."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @classmethod
    def of(cls, camera: Camera) -> Pinhole:
        """The intrinsics of a scenario's camera."""
        focal = camera.focal_px
        return cls(camera.width_px, camera.height_px, focal, focal, (camera.width_px - 1) / 2, (camera.height_px - 1) / 2)

    @property
    def matrix(self) -> Array:
        """K, shape (3, 3), in pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def directions(self) -> Array:
        """Viewing directions in C with unit z, shape (height, width, 3): a depth times a direction is a point."""
        directions = np.ones((self.height, self.width, 3))
        directions[..., 0] = (np.arange(self.width) - self.cx) / self.fx
        directions[..., 1] = ((np.arange(self.height) - self.cy) / self.fy)[:, np.newaxis]
        return directions

    def every(self, k: int) -> Pinhole:
        """The camera of every `k`-th pixel: its pixel (i, j) is (k // 2 + k i, k // 2 + k j) of this one."""
        first = k // 2
        size = len(range(first, self.width, k)), len(range(first, self.height, k))
        return Pinhole(*size, self.fx / k, self.fy / k, (self.cx - first) / k, (self.cy - first) / k)
