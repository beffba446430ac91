"""Drift of the camera's depth, measured on the table, which does not move.

The depth of a camera that warms up changes by millimetres in minutes, equally at every pixel (docs/errors.md), so a tracked wall
seems to sink or to rise. The table's pixels show the drift alone,

    z_i(t) = z_i + b(t) + noise,

and its part slower than `SLOWNESS_S` is subtracted from all depths.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from palpate_models.numerics.frames import Array
from palpate_models.robot.table import TABLE_TOP_M
from palpate_perception import cloud
from palpate_perception.cloud import Intrinsics
from palpate_perception.wall import EDGE, steady

NEAR_M: Final = 0.04
"""Distance from the table's top within which a point belongs to the table [m]: camera calibration has errors of centimetres."""
SLOWNESS_S: Final = 10.0
"""Time constant of the drift [s]: errors shared by neighbouring pixels last for seconds, warming up for minutes."""
LEAST_PIXELS: Final = 50
"""Least number of table pixels in view; with fewer the drift estimate is kept."""


class CameraDrift:
    """Follows the drift since a watch."""

    def __init__(self, frames: Array, camera: Intrinsics, t_s: float) -> None:
        """The small images of a watch that ended at `t_s` [s]: depth [m], shape (frames, height, width), NaN where unknown."""
        pixel, depth, noise = steady(frames)
        r_W = cloud.deproject(np.ones(camera.shape), camera.K).reshape(-1, 3)[pixel] @ camera.X_WC[:3, :3].T
        height = camera.X_WC[2, 3] + depth * r_W[:, 2]
        table = np.abs(height - TABLE_TOP_M) < NEAR_M
        table[table] &= noise[table] < EDGE * np.median(noise[table]) if table.any() else False
        self.pixel: NDArray[np.intp] = pixel[table]
        """Flat indices of the pixels that show the table, shape (n,)."""
        self.depth: Array = depth[table]
        """Their first depth [m], shape (n,)."""
        self.r_W: Array = r_W[table]
        """Viewing rays of unit z in world axes, shape (n, 3)."""
        self.drift = 0.0
        """By the images so far [m]."""
        self._last_s = t_s

    def follow(self, t_s: float, depth: Array, hidden: NDArray[np.bool_]) -> float:
        """The drift [m] by an image exposed at `t_s` [s]: depths of these pixels [m], and which the arm may hide, (n,) each."""
        seen = np.isfinite(depth) & ~hidden
        if np.count_nonzero(seen) >= LEAST_PIXELS:
            now = float(np.median((depth - self.depth)[seen]))
            self.drift += (1 - np.exp((self._last_s - t_s) / SLOWNESS_S)) * (now - self.drift)
        self._last_s = t_s
        return self.drift
