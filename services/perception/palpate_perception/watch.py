"""Watches the wall for about two breaths after a trigger."""

from __future__ import annotations

from typing import Final

import numpy as np

from palpate_models.numerics.frames import Array, inverse
from palpate_models.scenario.schema import Exam
from palpate_perception import cloud, wall
from palpate_perception.arm import ArmMask
from palpate_perception.cloud import RegionBox
from palpate_perception.drift import CameraDrift
from palpate_perception.fusion import Image
from palpate_perception.views import Intrinsics
from palpate_perception.wall import SeenWall

LONGEST_S: Final = 10.0
"""A watch lasts no longer."""
STILL_S: Final = 5.0
"""Time without motion after which a wall is still [s]."""
STILL_M: Final = 0.001
"""Between its 5th and 95th percentile the mean depth of a still wall differs by less."""
BREATHS: Final = 2


class Watch:
    """The small images of one look."""

    def __init__(self, camera: Intrinsics, X_WA: Array, exam: Exam) -> None:
        self.camera = camera
        """Intrinsics of the small image."""
        self._X_WA, self._exam = X_WA, exam
        X_CA = inverse(camera.X_WC) @ X_WA
        self._middle = cloud.window(RegionBox.of(exam, 0.0, (-0.05, 0.03)), X_CA, camera.K, camera.shape)
        self._r_W = (cloud.deproject(np.ones(camera.shape), camera.K) @ camera.X_WC[:3, :3].T).reshape(-1, 3)
        self._times: list[float] = []
        self._images: list[Image] = []

    def add(self, t_s: float, image: Image, arm: ArmMask, q: Array | None) -> None:
        """Takes an image [m], exposed at `t_s` [s] with the arm at the joint positions `q` [rad], which are not known if None."""
        seen = image.copy()
        if q is not None:
            z = np.nan_to_num(image.ravel().astype(float), nan=0.5)
            seen[arm.hides(q, self.camera.X_WC[:3, 3], self._r_W, z).reshape(image.shape)] = np.nan
        self._times.append(t_s)
        self._images.append(seen)

    def over(self) -> bool:
        """True after two breaths, with a still wall, or at the time limit."""
        lasted = self._times[-1] - self._times[0] if self._times else 0.0
        if lasted < STILL_S:
            return False
        with np.errstate(invalid="ignore"):
            height = -np.array([np.nanmean(image[self._middle]) for image in self._images])
        if lasted >= LONGEST_S or not np.isfinite(height).all():
            return lasted >= LONGEST_S
        low, high = np.quantile(height, (0.05, 0.95))
        return bool(high - low < STILL_M or rises(height, low, high) > BREATHS)

    def learn(self) -> tuple[SeenWall, Array, Array, CameraDrift]:
        """The wall, its displacements [m] at the times [s] of the images, and what follows the camera's drift from there.

        Raises UnseenWallError.
        """
        if not self._images:
            raise wall.UnseenWallError("no small image has come")
        frames = np.array(self._images, np.float64)
        found, d = wall.learn(frames, self.camera, self._X_WA, self._exam)
        return found, np.array(self._times), d, CameraDrift(frames, self.camera, self._times[-1])


def rises(height: Array, low: float, high: float) -> int:
    """Return how often a height rises from the lower third between `low` and `high` to the upper one."""
    part = (height - low) / (high - low)
    ends = part[(part < 1 / 3) | (part > 2 / 3)] > 0.5
    return int(np.count_nonzero(ends[1:] & ~ends[:-1]))
