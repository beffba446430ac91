"""The breathing motion that perception follows and forecasts (`perception/motion`), at any time in between."""

from __future__ import annotations

from collections import deque
from math import exp, hypot, sqrt
from typing import NamedTuple

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_planning.periods import MS, SECOND

FORECAST_STEP = 50 * MS
"""Spacing of the forecast's values [ns]; the first is that of the exposure."""
STALE = 500 * MS
"""A motion older than this is no longer followed [ns]: the forecast reaches no further."""
HIDDEN_M = 0.002
"""A wall that is hidden is followed by forecast up to this uncertainty."""
JOIN_S = 0.03
"""Time constant with which the step from one forecast to the next fades [s]: while it does, the older one still errs (from 0.1 s
to this: 0.69 to 0.53 mm, tuning seeds 1 and 2, 8 mm deep)."""
STEPS_KEPT = 0.98
"""Part of the mean square of these steps that counts on at the next message: it is that of 50 of them, a breath."""
REMEMBERED = 60
"""Exposures that are remembered: 6 s of them, longer than the skin is sought."""
UNTOLD = 1.3
"""What a forecast errs by over what its successor tells of that, for the successor errs with it (1.0 to 1.3: tuning seeds)."""


class BreathObservation(NamedTuple):
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
    shift_A: tuple[float, float] = (0.0, 0.0)
    """How far the patient lies from where the first look saw him, along the table in A [m]."""
    seen: bool = True
    """Whether enough of the wall is seen: the arm may hide it."""


class Breath:
    """How far the wall is moved where it moves most. Without a motion it is at the end of expiration and at rest."""

    def __init__(self) -> None:
        self._motion: BreathObservation | None = None
        self._gap, self._since = 0.0, 0
        """The last step from one forecast to the next [m], and when that was [ns]."""
        self._seen: deque[tuple[int, float]] = deque(maxlen=REMEMBERED)
        """Times of exposures [ns] with the displacement that was seen then [m]."""
        self._steps, self._growths = 0.0, 0.0
        """Number of steps, and sum of the r^2 [m^2/s^2] of `uncertainty` that they tell, the older the less they count."""

    def hear(self, motion: BreathObservation, t: int) -> None:
        """Takes perception's newest motion at `t` [ns]."""
        before, last = self.displacement(t), self._motion
        self._motion, self._gap = motion, 0.0
        self._seen.append((motion.stamp, float(motion.forecast[0])))
        if last is None:
            return
        self._gap, self._since = before - self.displacement(t), t
        if last.calm and motion.calm:
            longer = ((t - last.stamp) ** 2 - (t - motion.stamp) ** 2) / SECOND**2
            growth = self._gap**2 / max(longer, JOIN_S**2)
            self._steps, self._growths = 1.0 + STEPS_KEPT * self._steps, growth + STEPS_KEPT * self._growths

    def displacement(self, t: int) -> float:
        """Forecast at `t` [ns], outward, in metres; joined to the forecast before without a step."""
        motion = self._motion
        if motion is None:
            return 0.0
        k = (t - motion.stamp) / FORECAST_STEP
        forecast = float(np.interp(k, np.arange(len(motion.forecast)), motion.forecast))
        return forecast + self._gap * exp(-(t - self._since) / SECOND / JOIN_S)

    def seen(self, times: Array) -> Array | None:
        """Displacements [m] as they were seen at past times [ns], shape (n,): surer than the forecast was. None: not seen yet."""
        if not self._seen or self._seen[0][0] > times[0] or self._seen[-1][0] < times[-1]:
            return None
        exposed, displacement = zip(*self._seen, strict=True)
        return np.asarray(np.interp(times, exposed, displacement))

    @property
    def seen_uncertainty(self) -> float:
        """Standard deviation of a displacement that was seen [m]."""
        return 0.0 if self._motion is None else self._motion.uncertainty

    def uncertainty(self, t: int) -> float:
        """Standard deviation of the displacement [m] at `t` [ns].

        A forecast errs the more the longer ago the wall was seen, sigma(t)^2 = sigma_0^2 + (r (t - t_0))^2. Where a forecast was
        replaced by the next message's, the mean square of the step is about what it errs more for being older: that tells r.
        """
        if self._motion is None:
            return 0.0
        rate = UNTOLD * sqrt(self._growths / self._steps) if self._steps else 0.0
        return hypot(self._motion.uncertainty, rate * (t - self._motion.stamp) / SECOND)

    def calm(self, t: int) -> bool:
        """Whether the forecast can be relied on at `t` [ns]."""
        return self._motion is None or (self._motion.calm and t - self._motion.stamp <= STALE)

    @property
    def shift_A(self) -> Array:
        """How far the patient lies from where the first look saw him, along the table in A [m], shape (2,)."""
        return np.zeros(2) if self._motion is None else np.array(self._motion.shift_A)

    @property
    def hidden(self) -> bool:
        """Whether perception says that it does not see the wall."""
        return self._motion is not None and not self._motion.seen

    @property
    def moved(self) -> bool:
        """Whether the patient has moved."""
        return self._motion is not None and self._motion.moved
