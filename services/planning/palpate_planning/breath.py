"""The breathing motion that perception follows and forecasts (`perception/motion`), at any time in between."""

from __future__ import annotations

from math import exp
from typing import NamedTuple

import numpy as np

from palpate_models.frames import Array
from palpate_planning.periods import MS, SECOND

FORECAST_STEP = 50 * MS
"""Spacing of the forecast's values [ns]; the first is that of the exposure."""
STALE = 500 * MS
"""A motion older than this is no longer followed [ns]: the forecast reaches no further."""
HIDDEN_M = 0.002
"""A wall that is hidden is followed by forecast up to this uncertainty."""
JOIN_S = 0.1
"""Time constant with which the step from one forecast to the next fades [s]."""


class Motion(NamedTuple):
    """One word of perception's about the breath."""

    stamp: int
    """Time of the exposure [ns]."""
    forecast: Array
    """Displacement [m] at `stamp` and every `FORECAST_STEP` after it, outward, where the wall moves most; shape (k,)."""
    uncertainty: float
    """Standard deviation of the displacement [m]."""
    calm: bool
    """Whether the wall does what the forecast expects: neither cough nor deep breath, and it is seen."""
    moved: bool = False
    """Whether the patient lies elsewhere than when the surface was perceived."""


class Breath:
    """How far the wall is moved where it moves most. Without a motion it is at the end of expiration and at rest."""

    def __init__(self) -> None:
        self._motion: Motion | None = None
        self._gap, self._since = 0.0, 0
        """The last step from one forecast to the next [m], and when that was [ns]."""

    def hear(self, motion: Motion, t: int) -> None:
        """Takes perception's newest motion at `t` [ns]."""
        before = self.displacement(t)
        first = self._motion is None
        self._motion, self._gap = motion, 0.0
        self._gap, self._since = 0.0 if first else before - self.displacement(t), t

    def displacement(self, t: int) -> float:
        """Forecast at `t` [ns], outward, in metres; joined to the forecast before without a step."""
        motion = self._motion
        if motion is None:
            return 0.0
        k = (t - motion.stamp) / FORECAST_STEP
        forecast = float(np.interp(k, np.arange(len(motion.forecast)), motion.forecast))
        return forecast + self._gap * exp(-(t - self._since) / SECOND / JOIN_S)

    def uncertainty(self, t: int) -> float:
        """Standard deviation of the displacement [m] at `t` [ns]."""
        return 0.0 if self._motion is None else self._motion.uncertainty

    def calm(self, t: int) -> bool:
        """Whether the forecast can be relied on at `t` [ns]."""
        return self._motion is None or (self._motion.calm and t - self._motion.stamp <= STALE)

    @property
    def moved(self) -> bool:
        """Whether the patient has moved."""
        return self._motion is not None and self._motion.moved
