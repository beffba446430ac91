"""Short-term forecast of the wall's displacement: a Kalman filter of quasi-periodic motion.

The displacement is a level and two stochastic oscillators, one at the breathing rate w and one at twice that (Solin and Sarkka
2014, "Explicit link between periodic covariance functions and state space models"). Over h, with the rotation R by an angle,

    level(t + h) = exp(-h / T_0) level(t) + noise
    x_j(t + h)   = exp(-h / T) R(j w h) x_j(t) + noise
    d            = mean + level + x_1[0] + x_2[0]

each with a constant variance. Variances and rate are re-estimated from the last half minute, since amplitude and period change.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_models.numerics.frames import Array


class BreathTuning(NamedTuple):
    """Tuning of the breath filter."""

    rates_per_min: tuple[float, float] = (4.0, 40.0)
    """Range of breathing rates."""
    min_history_s: float = 5.0
    """Minimum history for an estimate of rate and amplitude [s]."""
    memory_s: float = 30.0
    """History from which rate and amplitude are estimated [s]."""
    renewal_s: float = 1.0
    coherence_s: float = 8.0
    """T, coherence time of phase and amplitude: two breaths, which differ by a fifth in length and a third in depth."""
    level_s: float = 20.0
    """Time constant T_0 of the level."""
    shares: tuple[float, float, float] = (0.5, 0.5, 0.125)
    """SDs of level and oscillators, relative to the peak-to-peak amplitude."""
    min_m: float = 2e-4
    """Minimum amplitude; a wall that moves less is still, and the forecast is the level."""


TUNING: Final = BreathTuning()

_GRID_PER_MIN: Final = np.arange(TUNING.rates_per_min[0], TUNING.rates_per_min[1], 0.5)


class BreathFilter:
    """Kalman filter of one displacement."""

    def __init__(self, t_s: Array, d: Array) -> None:
        """Initialise from earlier displacements `d` [m] at times `t_s` [s], shape (n,) each, evenly spaced."""
        self._times, self._seen = t_s.tolist(), d.tolist()
        self._x, self._mean = np.zeros(5), float(d.mean())
        self._stationary: Array = np.eye(5)
        self._H = np.array((1.0, 1.0, 0.0, 1.0, 0.0))
        self._t_s = self._renewed_s = float(t_s[0])
        self._learn()
        self._P = self._stationary
        for t, value in zip(t_s, d, strict=True):
            self.forward(float(t))
            self.update(float(value), TUNING.min_m)

    def forward(self, t_s: float) -> tuple[float, float]:
        """Predict to time `t_s` [s]; return the expected displacement and its SD [m]."""
        F = self._transition(np.array((t_s - self._t_s,)))[0]
        self._t_s = t_s
        self._x = F @ self._x
        self._P = F @ (self._P - self._stationary) @ F.T + self._stationary
        return self._mean + float(self._H @ self._x), self.sigma

    def update(self, d: float, sigma: float) -> None:
        """Update with a displacement and its SD [m], measured at the time of the last prediction."""
        S = float(self._H @ self._P @ self._H) + sigma**2
        gain = self._P @ self._H / S
        self._x = self._x + gain * (d - self._mean - float(self._H @ self._x))
        self._P = self._P - np.outer(gain, self._H @ self._P)

    def remember(self, d: float) -> None:
        """Add a displacement [m], measured at the time of the last prediction, to the history of rate and amplitude."""
        self._times.append(self._t_s)
        self._seen.append(d)
        if self._t_s - self._renewed_s > TUNING.renewal_s:
            while self._times[0] < self._t_s - TUNING.memory_s:
                del self._times[0], self._seen[0]
            self._renewed_s = self._t_s
            if self._times[-1] - self._times[0] >= TUNING.min_history_s:  # else the wall was long hidden: keep the estimates
                self._learn()

    def forget(self, d: float) -> None:
        """Reset to a displacement [m] with unknown phase."""
        self._x = np.array((d - self._mean, 0.0, 0.0, 0.0, 0.0))
        self._P = self._stationary.copy()

    def forecast(self, ahead_s: Array) -> Array:
        """Return the expected displacement [m] at `ahead_s` after the time of the last prediction, shape (n,) each."""
        return np.asarray(self._mean + self._transition(ahead_s) @ self._x @ self._H)

    @property
    def sigma(self) -> float:
        """SD of the displacement at the time of the last prediction [m]."""
        return float(np.sqrt(max(self._H @ self._P @ self._H, 0.0)))

    def _learn(self) -> None:
        d, t = np.array(self._seen), np.array(self._times)
        mean = float(d.mean())
        self._x[0] += self._mean - mean
        self._mean = mean
        self.depth = max(float(2 * np.sqrt(2) * d.std()), TUNING.min_m)
        """Mean peak-to-peak depth of the breaths [m]: that of a sine of equal variance."""
        self._rate = 2 * np.pi / 60 * strongest_rate(t, d - mean)
        scale = self.depth * np.array((TUNING.shares[0], TUNING.shares[1], TUNING.shares[1], TUNING.shares[2], TUNING.shares[2]))
        self._stationary = np.diag(scale**2)

    def _transition(self, h: Array) -> Array:
        """Return F over times `h` [s], shape (n,): shape (n, 5, 5)."""
        F = np.zeros((len(h), 5, 5))
        F[:, 0, 0] = np.exp(-h / TUNING.level_s)
        for j in (1, 2):
            kept, angle = np.exp(-h / TUNING.coherence_s), j * self._rate * h
            i = 2 * j - 1
            F[:, i, i] = F[:, i + 1, i + 1] = kept * np.cos(angle)
            F[:, i, i + 1] = kept * np.sin(angle)
            F[:, i + 1, i] = -F[:, i, i + 1]
        return F


def strongest_rate(t_s: Array, d: Array) -> float:
    """Return the breaths per minute of the strongest sine in `d` at times `t_s` [s], shape (n,) each, under a Hann window."""
    length = max(float(t_s[-1] - t_s[0]), 1e-3)
    window = 1 - np.cos(2 * np.pi * (t_s - t_s[0]) / length)
    rates = _GRID_PER_MIN[60 / length < _GRID_PER_MIN]
    if not len(rates):
        return float(TUNING.rates_per_min[0])
    waves: NDArray[np.complex128] = np.exp(-2j * np.pi / 60 * np.outer(rates, t_s))
    return float(rates[np.argmax(np.abs(waves @ (window * d)))])
