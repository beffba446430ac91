"""How far the camera's depth has drifted, by the table, which stands still.

A camera that warms up sees everything farther away, or nearer, than it did before: by millimetres in minutes, the same at every
pixel (docs/errors.md). A wall that is followed by it seems to sink or to rise. The table's pixels show that drift alone,

    z_i(t) = z_i + b(t) + noise,

and what comes more slowly than `SLOWNESS_S` is taken off all depths.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from palpate_models.numerics.frames import Array
from palpate_models.robot.table import TABLE_TOP_M
from palpate_perception import cloud
from palpate_perception.views import Intrinsics
from palpate_perception.wall import EDGE, steady

NEAR_M: Final = 0.04
"""So near to the height of the table's top a point is the table's: camera and its calibration err by centimetres."""
SLOWNESS_S: Final = 10.0
"""What neighbouring pixels get wrong together lasts for some seconds, warming up for many minutes."""
LEAST_PIXELS: Final = 50
"""Fewer pixels of the table in view tell nothing, and the drift is taken to stay what it was."""


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
        """Where they showed it [m], shape (n,)."""
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
