"""What the position sensors of the joints read: they sit at the motors, with gear and elasticity between them and the links.

    theta = q + zero + d + A sin(n q + phase),    T dd/dt + d = c tau

q is where the links truly are, d how far the joint gives way under the drive's torque tau (compliance c, settling with T), and
A sin(...) the gear's ripple, which comes back n times a revolution.
"""

from __future__ import annotations

from math import cos, sin
from typing import Final

import numpy as np

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array
from palpate_models.scenario.errors import DrawnArm
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
