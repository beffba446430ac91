"""Short-term forecast of the wall's displacement: a Kalman filter of quasi-periodic motion.

The displacement is a level and two stochastic oscillators, one at the breathing rate w and one at twice that (Solin and Sarkka
2014, "Explicit link between periodic covariance functions and state space models"). Over h, with the rotation R by an angle,

    level(t + h) = exp(-h / T_0) level(t) + noise
    x_j(t + h)   = exp(-h / T) R(j w h) x_j(t) + noise
    d            = mean + level + x_1[0] + x_2[0]

each of them with a constant variance. These, and the rate, are renewed from the last half minute: amplitude and period wander.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from palpate_models.numerics.frames import Array

RATES_PER_MIN: Final = (4.0, 40.0)
"""Breaths a minute that are looked for."""
LEAST_S: Final = 5.0
"""Least history for an estimate of rate and amplitude [s]."""
MEMORY_S: Final = 30.0
"""History from which rate and amplitude are estimated [s]."""
RENEWAL_S: Final = 1.0
COHERENCE_S: Final = 8.0
"""T, coherence time of phase and amplitude: two breaths, which differ by a fifth in length and a third in depth."""
LEVEL_S: Final = 20.0
"""T_0."""
SHARES: Final = (0.5, 0.5, 0.125)
"""Standard deviations of level and oscillators, in peak-to-peak amplitudes."""
LEAST_M: Final = 2e-4
"""A wall that moves by less is still [m]: then the filter's forecast is the level."""
_GRID_PER_MIN: Final = np.arange(RATES_PER_MIN[0], RATES_PER_MIN[1], 0.5)


class BreathFilter:
    """Follows one displacement."""

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
            self.update(float(value), LEAST_M)

    def forward(self, t_s: float) -> tuple[float, float]:
        """Predicts to time `t_s` [s]: displacement [m] expected then, and its standard deviation [m]."""
        F = self._transition(np.array((t_s - self._t_s,)))[0]
        self._t_s = t_s
        self._x = F @ self._x
        self._P = F @ (self._P - self._stationary) @ F.T + self._stationary
        return self._mean + float(self._H @ self._x), self.sigma

    def update(self, d: float, sigma: float) -> None:
        """Takes a displacement [m] with its standard deviation [m], seen at the time last predicted to."""
        S = float(self._H @ self._P @ self._H) + sigma**2
        gain = self._P @ self._H / S
        self._x = self._x + gain * (d - self._mean - float(self._H @ self._x))
        self._P = self._P - np.outer(gain, self._H @ self._P)

    def remember(self, d: float) -> None:
        """Add a displacement [m], at the time last predicted to, to the history of rate and amplitude."""
        self._times.append(self._t_s)
        self._seen.append(d)
        if self._t_s - self._renewed_s > RENEWAL_S:
            while self._times[0] < self._t_s - MEMORY_S:
                del self._times[0], self._seen[0]
            self._renewed_s = self._t_s
            if self._times[-1] - self._times[0] >= LEAST_S:  # else the wall was hidden for long: it breathes as it did before
                self._learn()

    def forget(self, d: float) -> None:
        """Reset to a displacement [m] with unknown phase."""
        self._x = np.array((d - self._mean, 0.0, 0.0, 0.0, 0.0))
        self._P = self._stationary.copy()

    def forecast(self, ahead_s: Array) -> Array:
        """Return the expected displacement [m] at `ahead_s` after the time last predicted to, shape (n,) of both."""
        return np.asarray(self._mean + self._transition(ahead_s) @ self._x @ self._H)

    @property
    def sigma(self) -> float:
        """Standard deviation of the displacement at the time last predicted to [m]."""
        return float(np.sqrt(max(self._H @ self._P @ self._H, 0.0)))

    @property
    def depth(self) -> float:
        """Mean depth of the breaths, peak to peak [m]: that of the sine of equal variance."""
        return self._depth

    def _learn(self) -> None:
        d, t = np.array(self._seen), np.array(self._times)
        mean = float(d.mean())
        self._x[0] += self._mean - mean
        self._mean = mean
        self._depth = max(float(2 * np.sqrt(2) * d.std()), LEAST_M)
        self._rate = 2 * np.pi / 60 * strongest_rate(t, d - mean)
        scale = self._depth * np.array((SHARES[0], SHARES[1], SHARES[1], SHARES[2], SHARES[2]))
        self._stationary = np.diag(scale**2)

    def _transition(self, h: Array) -> Array:
        """F over times `h` [s], shape (n,): shape (n, 5, 5)."""
        F = np.zeros((len(h), 5, 5))
        F[:, 0, 0] = np.exp(-h / LEVEL_S)
        for j in (1, 2):
            kept, angle = np.exp(-h / COHERENCE_S), j * self._rate * h
            i = 2 * j - 1
            F[:, i, i] = F[:, i + 1, i + 1] = kept * np.cos(angle)
            F[:, i, i + 1] = kept * np.sin(angle)
            F[:, i + 1, i] = -F[:, i, i + 1]
        return F


def strongest_rate(t_s: Array, d: Array) -> float:
    """Breaths a minute of the strongest sine in `d` at times `t_s` [s], shape (n,) each, under a Hann window."""
    length = max(float(t_s[-1] - t_s[0]), 1e-3)
    window = 1 - np.cos(2 * np.pi * (t_s - t_s[0]) / length)
    rates = _GRID_PER_MIN[60 / length < _GRID_PER_MIN]
    if not len(rates):
        return float(RATES_PER_MIN[0])
    waves: NDArray[np.complex128] = np.exp(-2j * np.pi / 60 * np.outer(rates, t_s))
    return float(rates[np.argmax(np.abs(waves @ (window * d)))])
