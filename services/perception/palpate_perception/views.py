"""Camera view: intrinsics and pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from palpate_models.numerics.frames import Array

HEIGHT_M: Final = (-0.16, 0.06)
"""Heights in A that may be abdomen. The arm hovers higher; the wall falls away by its whole height at most."""
TABLE_CLEARANCE_M: Final = 0.02
"""Points this near to the table's top are the table."""


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """Intrinsics and pose from camera_info and tf_static."""

    K: Array
    """Shape (3, 3), in pixels."""
    X_WC: Array
    """Calibrated pose of the optical frame in world, shape (4, 4)."""
    shape: tuple[int, int]
    """Height and width of the full image."""

    def same(self, other: Intrinsics) -> bool:
        """True if the other has the same intrinsics and pose."""
        return self.shape == other.shape and np.array_equal(self.K, other.K) and np.array_equal(self.X_WC, other.X_WC)
