"""Depth of the wall from the onset of force in a slow descent.

While the indenter descends at constant speed, the normal force over depth d is

    F = b + a max(d - d0, 0)^1.3.

b, a and d0 are fitted together (Levenberg and Marquardt, `scipy.optimize.curve_fit`): b is the remaining sensor bias, d0 the
depth of the wall. At 14 mm/s, positions on patients and lumps (tuning seeds 0 to 7) follow the law up to 1 N with exponents of
1.2 to 1.5, and 1.8 over a guarded muscle. There the error of d0 is -0.02 +- 0.15 mm, and 0.2 mm more where the indenter meets the
wall between mesh points (computed).
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import curve_fit

from palpate_models.numerics.frames import Array

FELT_N = 1.0
"""Force at which the descent has enough samples for the fit."""


class OnsetTuning(NamedTuple):
    """Fit of the onset law."""

    exponent: float = 1.3
    begun_n: float = 0.2
    """Force that gives the initial guess of the onset."""
    window_m: float = 0.010
    """Minimum depth range used in the fit."""
    air_m: float = 0.003
    """Depth range in air used in the fit, also on a soft wall, where FELT_N is reached at more than 7 mm."""
    samples_min: int = 8
    model_sd_m: float = 0.00025
    """SD of d0 from deviations from the law."""
    model_sd_fraction: float = 0.035
    """Minimum SD of d0 as a fraction of the distance from d0 to FELT_N: a different exponent causes a proportional error (0.055
    for 1.45)."""
    unfitted_sd_m: float = 0.001
    """SD of d0 without a fit, as on bone, where force rises within a few samples: d0 is where the force began."""


TUNING = OnsetTuning()
_SINCE_BEGUN = 1 - (TUNING.begun_n / FELT_N) ** (1 / TUNING.exponent)
"""Fraction of the distance from d0 to FELT_N that remains at `begun_n`, by the law."""


class WallDepth(NamedTuple):
    """Measured depth of the wall."""

    depth: float
    """d0 [m], in the depth used during the descent."""
    sigma: float
    """SD [m]."""


class Onset:
    """Collects depth and force of one slow descent."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, float]] = []
        self._moving: list[tuple[int, float]] = []

    def add(self, depth: float, force: float, t: int, displacement: float) -> None:
        """Add depth [m] and normal force [N] measured at `t` [ns], and the wall displacement contained in the depth [m]."""
        self._rows.append((depth, force))
        self._moving.append((t, displacement))

    def touch(self) -> WallDepth:
        """Return the touch found in the samples."""
        return find_touch(np.array(self._rows))

    @property
    def times(self) -> Array:
        """Times of the samples [ns], shape (n,)."""
        return np.array([t for t, _ in self._moving])

    def touch_again(self, displacement: Array) -> WallDepth:
        """Return the touch for a different wall displacement [m], shape (n,)."""
        rows = np.array(self._rows)
        rows[:, 0] += displacement - np.array([lifted for _, lifted in self._moving])
        return find_touch(rows)


def find_touch(rows: Array) -> WallDepth:
    """Return the touch in rows of depth [m] and force [N], shape (n, 2), the last of which is deepest with the largest force."""
    quiet = np.flatnonzero(rows[:, 1] < TUNING.begun_n)
    begun = float(rows[quiet[-1] if len(quiet) else 0, 0])
    rows = rows[rows[:, 0] > rows[-1, 0] - max(TUNING.window_m, (rows[-1, 0] - begun) / _SINCE_BEGUN + TUNING.air_m)]
    depth, force = rows.T
    guess = WallDepth(begun, TUNING.unfitted_sd_m)
    if len(rows) < TUNING.samples_min:
        return guess
    scale = (force[-1] - force[0]) / max(depth[-1] - begun, 1e-4) ** TUNING.exponent
    try:
        (_, slope, d0), covariance = curve_fit(_force, depth, force, (0.0, scale, begun))
    except (RuntimeError, ValueError):
        return guess
    variance = float(covariance[2, 2])
    if not (slope > 0 and depth[0] < d0 < depth[-1] and variance < TUNING.unfitted_sd_m**2):
        return guess
    return WallDepth(
        float(d0), math.hypot(max(TUNING.model_sd_m, TUNING.model_sd_fraction * (depth[-1] - d0)), math.sqrt(variance))
    )


def _force(depth: Array, bias: float, slope: float, onset: float) -> Array:
    return np.asarray(bias + slope * np.maximum(depth - onset, 0.0) ** TUNING.exponent)
