"""The standard press, which defines apparent stiffness.

The indenter moves along the inward normal from the touched skin, at constant speed to a fixed depth, and holds. The apparent
stiffness is the mean force at the end of the hold.
"""

import numpy as np

from palpate_models.numerics.frames import Array, Mask

DEPTH_M = 0.010
"""Depth below the touched skin."""
SPEED_MPS = 0.020
HOLD_S = 0.5
"""Duration of the hold."""
READ_S = 0.1
"""Averaging window at the end of the hold."""
LIMIT_N = 15.0
"""Force at which the press ends."""
DURATION_S = DEPTH_M / SPEED_MPS + HOLD_S


def times(step_s: float) -> Array:
    """Return the ends of the press's steps of `step_s` [s], from the touch [s], shape (n,)."""
    return np.asarray(step_s * np.arange(1, round(DURATION_S / step_s) + 1), dtype=np.float64)


def depths(times_s: Array) -> Array:
    """Return the depth [m] at times from the touch [s], shape (n,)."""
    return np.asarray(np.minimum(SPEED_MPS * times_s, DEPTH_M))


def apparent_stiffness(forces: Array) -> tuple[Array, Mask]:
    """Return the apparent stiffness [N] of presses, and True for those that ended at LIMIT_N, shape (k,) each.

    `forces` [N], shape (k, n): at the ends of equal steps over a whole press.
    """
    limited = forces.max(axis=1) >= LIMIT_N
    last = max(1, round(forces.shape[1] * READ_S / DURATION_S))
    return np.where(limited, LIMIT_N, forces[:, -last:].mean(axis=1)), limited
