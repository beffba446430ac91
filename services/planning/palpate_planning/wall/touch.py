"""Where the tissue begins: the place of the skin from the onset of force in a slow descent.

While the indenter sinks at one speed, the normal force over depth d is

    F = b + a max(d - d0, 0)^1.3.

The three are fitted together (Levenberg and Marquardt, `scipy.optimize.curve_fit`): b, what is left of the sensor's bias, is seen
before the skin is touched, d0 is the depth at which it is. Pressed at 14 mm/s, places of persons and of lumps (tuning seeds 0 to
7) follow the law up to 1 N with exponents of 1.2 to 1.5, 1.8 over a guarded muscle; d0 errs by -0.02 +- 0.15 mm there, and by
0.2 mm more where the indenter meets the skin between the points of a mesh [C].
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import curve_fit

from palpate_models.numerics.frames import Array

ONSET_EXPONENT = 1.3
FELT_N = 1.0
"""At this force the descent has felt enough."""
BEGUN_N = 0.2
"""About here the onset is looked for first."""
WINDOW_M, AIR_M = 0.010, 0.003
"""So much of the descent is kept, in depth, at least; and so much of the air above the skin, as on a soft wall, where FELT_N is
felt at a depth of more than 7 mm."""
_SINCE_BEGUN = 1 - (BEGUN_N / FELT_N) ** (1 / ONSET_EXPONENT)
"""Part of the way from d0 to FELT_N that is left at BEGUN_N, by the law."""
SAMPLES_MIN = 8
METHOD_M, METHOD_SHARE = 0.00025, 0.035
"""Standard deviation of d0 for what the law leaves out; at least this part of the way from d0 to FELT_N, since another exponent
errs by a part of it: 0.055 where it is 1.45."""
UNFITTED_M = 0.001
"""The same where no law can be fitted, as on bone, where force rises within a few samples: d0 is where force began."""


class SkinDepth(NamedTuple):
    """Where the skin was felt."""

    depth: float
    """d0 [m], in the depth that was counted during the descent."""
    sigma: float
    """Its standard deviation [m]."""


class Onset:
    """Collects depth and force of one slow descent."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, float]] = []
        self._moving: list[tuple[int, float]] = []

    def add(self, depth: float, force: float, t: int, displacement: float) -> None:
        """Takes depth [m] and normal force [N] measured at `t` [ns], and the wall's displacement that is in this depth [m]."""
        self._rows.append((depth, force))
        self._moving.append((t, displacement))

    def touch(self) -> SkinDepth:
        """The touch in what was collected."""
        return find_touch(np.array(self._rows))

    @property
    def times(self) -> Array:
        """When it was collected [ns], shape (n,)."""
        return np.array([t for t, _ in self._moving])

    def touch_again(self, displacement: Array) -> SkinDepth:
        """The touch, had the wall been displaced as is known by now [m], shape (n,)."""
        rows = np.array(self._rows)
        rows[:, 0] += displacement - np.array([lifted for _, lifted in self._moving])
        return find_touch(rows)


def find_touch(rows: Array) -> SkinDepth:
    """The touch in a descent's rows of depth [m] and force [N], shape (n, 2), of which the last is the deepest and firmest."""
    quiet = np.flatnonzero(rows[:, 1] < BEGUN_N)
    begun = float(rows[quiet[-1] if len(quiet) else 0, 0])
    rows = rows[rows[:, 0] > rows[-1, 0] - max(WINDOW_M, (rows[-1, 0] - begun) / _SINCE_BEGUN + AIR_M)]
    depth, force = rows.T
    guess = SkinDepth(begun, UNFITTED_M)
    if len(rows) < SAMPLES_MIN:
        return guess
    scale = (force[-1] - force[0]) / max(depth[-1] - begun, 1e-4) ** ONSET_EXPONENT
    try:
        (_, slope, d0), covariance = curve_fit(_force, depth, force, (0.0, scale, begun))
    except (RuntimeError, ValueError):
        return guess
    variance = float(covariance[2, 2])
    if not (slope > 0 and depth[0] < d0 < depth[-1] and variance < UNFITTED_M**2):
        return guess
    return SkinDepth(float(d0), math.hypot(max(METHOD_M, METHOD_SHARE * (depth[-1] - d0)), math.sqrt(variance)))


def _force(depth: Array, bias: float, slope: float, onset: float) -> Array:
    return np.asarray(bias + slope * np.maximum(depth - onset, 0.0) ** ONSET_EXPONENT)
