"""What a six-axis force/torque sensor reads.

    reading = S w + b + a (1 - exp(-t / T)) + x(t) + white noise

with the true wrench w, a sensitivity S that is not quite the identity (gain, cross-talk), the bias b since it was switched on,
warming up, and x(t), which a tare does not take away: an Ornstein-Uhlenbeck process plus a random walk.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_models.scenario.errors import MOMENT_PER_FORCE_M, DrawnForce

_BLOCK: Final = 1024
"""Readings whose errors are made at once. The slow ones are exact at a block's ends and straight in between."""
_MINUTE_S: Final = 60.0


class FtSensor:
    """Adds the sensor's errors to the true wrench. Wrenches: force [N], then moment [N m], in its axes."""

    def __init__(self, drawn: DrawnForce, rng: np.random.Generator, period_s: float) -> None:
        """A sensor that is switched on at the first reading and read every `period_s` [s]; `rng` makes its noise."""
        given = drawn.given
        self._drawn = drawn
        self._sensitivity = np.ascontiguousarray(drawn.sensitivity)
        self._deviation = np.repeat((given.noise_n, given.noise_nm), 3)
        self._scale = np.repeat((1.0, MOMENT_PER_FORCE_M), 3)
        self._rng = rng
        (slow,) = rng.bit_generator.seed_seq.spawn(1)  # type: ignore[attr-defined]  # white noise stays as it is without drift
        self._slow = np.random.Generator(np.random.PCG64(slow))
        self._t = period_s * np.arange(_BLOCK)
        self._length_s = period_s * _BLOCK
        self._blocks = 0
        self._wander = given.tare_n * self._scale * self._slow.standard_normal(6)
        self._walk = np.zeros(6)
        self._errors: list[Array] = []
        """Errors of the readings to come, the last one first, shape (6,) each."""

    def read(self, wrench: Sequence[float]) -> list[float]:
        """A reading of the true wrench."""
        if not self._errors:
            self._errors = list(self.block()[::-1])
        reading: list[float] = (self._sensitivity.dot(wrench) + self._errors.pop()).tolist()
        return reading

    def block(self) -> Array:
        """What the next readings have beside sensitivity times wrench, shape (k, 6): all that are made at once."""
        return np.asarray(self._drift() + self._deviation * self._rng.standard_normal((_BLOCK, 6)))

    def _drift(self) -> Array:
        """All errors of the next block but the white noise, shape (_BLOCK, 6)."""
        given, drawn = self._drawn.given, self._drawn
        t = self._blocks * self._length_s + self._t
        self._blocks += 1
        before = self._wander + self._walk
        step = self._slow.standard_normal((2, 6))
        kept = np.exp(-self._length_s / given.tare_s)
        self._wander = kept * self._wander + given.tare_n * self._scale * np.sqrt(1 - kept**2) * step[0]
        self._walk = self._walk + given.walk_n * self._scale * np.sqrt(self._length_s / _MINUTE_S) * step[1]
        way = np.outer(self._t / self._length_s, self._wander + self._walk - before)
        warm = np.outer(1 - np.exp(-t / given.warm_up_s), drawn.warm_up)
        return np.asarray(drawn.bias + before + way + warm)
