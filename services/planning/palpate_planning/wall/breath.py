"""Breathing motion from perception's forecasts (`perception/motion`), interpolated to any time."""

from collections import deque
from math import exp, hypot, sqrt
from typing import NamedTuple

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_planning.periods import MS, SECOND

FORECAST_STEP = 50 * MS
"""Spacing of the forecast's values [ns]; the first is at the exposure."""
HIDDEN_M = 0.002
"""Uncertainty up to which an occluded wall is followed by forecast."""


class ForecastTuning(NamedTuple):
    """Blending of forecasts and estimation of their error."""

    stale_ns: int = 500 * MS
    """Age above which a motion is not followed: the length of the forecast."""
    join_s: float = 0.03
    """Time constant of the blend from one forecast to the next. During the blend the older forecast still adds its error (0.69 mm
    with 0.1 s, 0.53 mm with this; tuning seeds 1 and 2, 8 mm deep)."""
    inward_mps: float = 0.1
    """Maximum speed at which a receding wall is joined: four times that of a deep breath. A camera may be wrong."""
    steps_kept: float = 0.98
    """Forgetting factor of the mean square step per message: an average over 50 messages, about a breath."""
    exposures: int = 60
    """Number of exposures kept: 6 s, longer than a descent."""
    forecast_error_scale: float = 1.3
    """Scale on the error estimated from consecutive forecasts, whose errors are correlated (1.0-1.3, tuning seeds)."""


TUNING = ForecastTuning()


class BreathObservation(NamedTuple):
    """One message of perception about the breath."""

    stamp: int
    """Time of the exposure [ns]."""
    forecast: Array
    """Outward displacement [m] at `stamp` and every `FORECAST_STEP` after it, at the point that moves most; shape (k,)."""
    uncertainty: float
    """SD of the displacement [m]."""
    calm: bool
    """True if the wall is visible and follows the forecast: neither cough nor deep breath."""
    moved: bool = False
    """True if the patient has moved since the surface was perceived."""
    shift_A: tuple[float, float] = (0.0, 0.0)
    """Shift of the patient along the table since the first scan of the surface, in A [m]."""
    seen: bool = True
    """True if enough of the wall is visible; the arm may occlude it."""


class Breath:
    """Wall displacement at the point that moves most. Without messages the wall is at rest at the end of expiration."""

    def __init__(self) -> None:
        self._motion: BreathObservation | None = None
        self._gap, self._since = 0.0, 0
        """Last step between forecasts [m] and its time [ns]."""
        self._seen: deque[tuple[int, float]] = deque(maxlen=TUNING.exposures)
        """Times of exposures [ns] and measured displacements [m]."""
        self._steps, self._growths = 0.0, 0.0
        """Weighted number of steps, and weighted sum of r^2 in `uncertainty` [m^2/s^2]."""

    def receive(self, motion: BreathObservation, t: int) -> None:
        """Update with the latest motion of perception at `t` [ns]."""
        before, last = self.displacement(t), self._motion
        self._motion, self._gap = motion, 0.0
        self._seen.append((motion.stamp, float(motion.forecast[0])))
        if last is None:
            return
        self._gap, self._since = before - self.displacement(t), t
        if last.calm and motion.calm:
            longer = ((t - last.stamp) ** 2 - (t - motion.stamp) ** 2) / SECOND**2
            growth = self._gap**2 / max(longer, TUNING.join_s**2)
            self._steps, self._growths = 1.0 + TUNING.steps_kept * self._steps, growth + TUNING.steps_kept * self._growths

    def displacement(self, t: int) -> float:
        """Return the forecast displacement at `t` [ns], outward [m], blended with the previous forecast."""
        motion = self._motion
        if motion is None:
            return 0.0
        k = (t - motion.stamp) / FORECAST_STEP
        forecast = float(np.interp(k, np.arange(len(motion.forecast)), motion.forecast))
        since_s = (t - self._since) / SECOND
        return forecast + max(self._gap * exp(-since_s / TUNING.join_s), self._gap - TUNING.inward_mps * since_s)

    def measured_at(self, times: Array) -> Array | None:
        """Return measured displacements [m] at past times [ns], shape (n,), or None if not measured yet."""
        if not self._seen or self._seen[0][0] > times[0] or self._seen[-1][0] < times[-1]:
            return None
        exposed, displacement = zip(*self._seen, strict=True)
        return np.asarray(np.interp(times, exposed, displacement))

    @property
    def seen_uncertainty(self) -> float:
        """SD of a measured displacement [m]."""
        return 0.0 if self._motion is None else self._motion.uncertainty

    def uncertainty(self, t: int) -> float:
        """Return the SD of the displacement [m] at `t` [ns].

        The forecast error grows with its age, sigma(t)^2 = sigma_0^2 + (r (t - t_0))^2. r is estimated from the mean square step
        when a forecast is replaced by the next one.
        """
        if self._motion is None:
            return 0.0
        rate = TUNING.forecast_error_scale * sqrt(self._growths / self._steps) if self._steps else 0.0
        return hypot(self._motion.uncertainty, rate * (t - self._motion.stamp) / SECOND)

    def calm(self, t: int) -> bool:
        """Return True if the forecast is reliable at `t` [ns]."""
        return self._motion is None or (self._motion.calm and t - self._motion.stamp <= TUNING.stale_ns)

    @property
    def shift_A(self) -> Array:
        """Shift of the patient along the table since the first scan of the surface, in A [m], shape (2,)."""
        return np.zeros(2) if self._motion is None else np.array(self._motion.shift_A)

    @property
    def hidden(self) -> bool:
        """True if the wall is occluded."""
        return self._motion is not None and not self._motion.seen

    @property
    def moved(self) -> bool:
        """True if the patient has moved."""
        return self._motion is not None and self._motion.moved
