"""What the position sensors of the joints read: they sit at the motors, with gear and elasticity between them and the links.

    theta = q + zero + d + A sin(n q + phase),    T dd/dt + d = c tau

q is where the links truly are, d how far the joint gives way under the drive's torque tau (compliance c, settling with T), and
A sin(...) the gear's ripple, which comes back n times a revolution.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, sin
from typing import Final

import numpy as np

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array
from palpate_models.scenario.errors import MOMENT_PER_FORCE_M, DrawnArm, DrawnForce
from palpate_robot.plant import DT

RIPPLES: Final = 320
"""Ripples of a gear a revolution of its joint: two of each turn of the wave generator of a strain wave gear of 160 : 1 [A]."""
SETTLING_S: Final = 0.02
"""Time constant with which a joint gives way [A]: motor inertia of 4 kg m^2, as felt at the joint, on a spring of 10 kN m/rad."""
_NOISE_BLOCK: Final = 1024


@compiled
def _read(table: Array, q: Array, v: Array, torque: Array, dt: float) -> Array:
    """Readings of position and velocity, shape (2, 7), after a step of `dt` [s].

    `table`, shape (5, 7), has zero, compliance, amplitude, phase, and d, which is moved on.
    """
    out = np.empty((2, 7))
    for i in range(7):
        rate = (table[1, i] * torque[i] - table[4, i]) / SETTLING_S
        table[4, i] += dt * rate
        angle = RIPPLES * q[i] + table[3, i]
        out[0, i] = q[i] + (table[0, i] + table[4, i] + table[2, i] * sin(angle))
        out[1, i] = v[i] + (rate + table[2, i] * RIPPLES * cos(angle) * v[i])
    return out


class JointSensor:
    """Measured positions [rad] and velocities [rad/s], shapes (7,). Without white noise they are `q` and `v`."""

    def __init__(self, drawn: DrawnArm, rng: np.random.Generator, q: Array, torque: Array) -> None:
        """For an arm that has rested at joint positions `q` [rad] under joint torques [N m], gravity's included, shapes (7,)."""
        given = drawn.given
        ripple, compliance = np.full(7, given.ripple_rad), np.full(7, given.compliance_radpnm)
        self._table = np.array((drawn.zero_rad, compliance, ripple, drawn.ripple_phase_rad, compliance * torque))
        self._deviation = np.repeat((given.position_noise_rad, given.velocity_noise_radps), 7)
        self._rng = rng
        self._noise: list[Array] = []
        """Noise of the measurements to come, the last one first: of a tick's positions, then its velocities."""
        self.q: Array
        self.v: Array
        self.q, self.v = _read(self._table, q, np.zeros(7), torque, 0.0)

    def update(self, q: Array, v: Array, torque: Array) -> None:
        """Follows the arm over a step of the plant: true positions and velocities after it, and the torque during it."""
        self.q, self.v = _read(self._table, q, v, torque, DT)

    def read(self) -> tuple[Array, Array]:
        """Positions and velocities with white noise."""
        if not self._noise:
            noise = self._deviation * self._rng.standard_normal((_NOISE_BLOCK, 14))
            self._noise = list(noise.reshape(-1, 7)[::-1])
        return self.q + self._noise.pop(), self.v + self._noise.pop()


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
