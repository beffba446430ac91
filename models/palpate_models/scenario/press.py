"""The standard press, by which stiffness is compared: what an examiner's hand does at a place, and what it feels there.

The indenter goes in along the inward normal from where the skin is touched, at one speed to one depth, and is held. What it feels
is the mean force of the end of the hold: the place's apparent stiffness.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from palpate_models.numerics.frames import Array

DEPTH_M: Final = 0.010
"""How deep, from where the skin is touched."""
SPEED_MPS: Final = 0.020
HOLD_S: Final = 0.5
"""How long the indenter is held at that depth."""
READ_S: Final = 0.1
"""The end of the hold, over which the force is averaged."""
LIMIT_N: Final = 15.0
"""At this force the press ends."""
DURATION_S: Final = DEPTH_M / SPEED_MPS + HOLD_S


def times(step_s: float) -> Array:
    """The ends of the press's steps of `step_s` [s], from the touch [s], shape (n,)."""
    return np.asarray(step_s * np.arange(1, round(DURATION_S / step_s) + 1), dtype=np.float64)


def depths(times_s: Array) -> Array:
    """How deep the indenter is at times from the touch [s], shape (n,) [m]."""
    return np.asarray(np.minimum(SPEED_MPS * times_s, DEPTH_M))


def apparent_stiffness(forces: Array) -> tuple[Array, NDArray[np.bool_]]:
    """What presses felt [N] and whether they ended at LIMIT_N, each of shape (k,).

    `forces` [N], shape (k, n), are those at the ends of equal steps over a whole press.
    """
    limited = forces.max(axis=1) >= LIMIT_N
    last = max(1, round(forces.shape[1] * READ_S / DURATION_S))
    return np.where(limited, LIMIT_N, forces[:, -last:].mean(axis=1)), limited
