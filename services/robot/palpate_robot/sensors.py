"""Errors of the simulated sensors.

Joint sensors sit at the motors, with gear and elasticity between them and the links:

    theta = q + zero + d + A sin(n q + phase),    T dd/dt + d = c tau

with the true joint angle q, the deflection d under the drive torque tau (compliance c, settling time T), and the gear ripple
A sin(...) with n periods per revolution.

The six-axis force/torque sensor reads

    reading = S w + b + a (1 - exp(-t / T)) + x(t) + white noise

with the true wrench w, after a lag of first order if the sensor has one, a sensitivity S (gain errors, cross-talk), the bias b at
power-on, the warm-up a, and x(t), which a tare does not remove: an Ornstein-Uhlenbeck process plus a random walk.
"""

from collections.abc import Sequence
from math import cos, exp, sin
from typing import Final, NamedTuple

import numpy as np

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array
from palpate_models.scenario.errors import MOMENT_PER_FORCE_M, DrawnArm, DrawnForce, DrawnTorque
from palpate_models.scenario.schema import Robot
from palpate_robot.kinematics import Kinematics
from palpate_robot.plant import DT, STICK_RADPS


class SensorTuning(NamedTuple):
    """Constants of the sensors, for the compiled function too."""

    ripples: int = 320
    """Ripple periods per joint revolution: two per turn of the wave generator of a 160 : 1 strain wave gear (assumed)."""
    settling_s: float = 0.02
    """Time constant of the joint deflection (assumed): motor inertia of 4 kg m^2 (at the joint) on a spring of 10 kN m/rad."""
    block: int = 1024
    """Readings whose errors are drawn at once. Slow errors are exact at the ends of a block and linear in between."""


SENSORS: Final = SensorTuning()


@compiled
def _read(table: Array, q: Array, v: Array, torque: Array, dt: float) -> Array:
    """Return readings of position and velocity, shape (2, n), after a step of `dt` [s].

    Rows of `table`, shape (5, n): zero, compliance, amplitude, phase, and d, which is updated.
    """
    out = np.empty((2, len(q)))
    for i in range(len(q)):
        rate = (table[1, i] * torque[i] - table[4, i]) / SENSORS.settling_s
        table[4, i] += dt * rate
        angle = SENSORS.ripples * q[i] + table[3, i]
        out[0, i] = q[i] + (table[0, i] + table[4, i] + table[2, i] * sin(angle))
        out[1, i] = v[i] + (rate + table[2, i] * SENSORS.ripples * cos(angle) * v[i])
    return out


class JointSensor:
    """Measured positions [rad] and velocities [rad/s], shapes (n,). Without white noise they are `q` and `v`."""

    def __init__(self, drawn: DrawnArm, rng: np.random.Generator, q: Array, torque: Array) -> None:
        """Start with an arm at rest at positions `q` [rad] under joint torques including gravity [N m], shapes (n,)."""
        given = drawn.given
        ripple, compliance = np.full(len(q), given.ripple_rad), np.full(len(q), given.compliance_radpnm)
        self._table = np.array((drawn.zero_rad, compliance, ripple, drawn.ripple_phase_rad, compliance * torque))
        self._deviation = np.repeat((given.position_noise_rad, given.velocity_noise_radps), len(q))
        self._rng = rng
        self._noise: list[Array] = []
        """Noise of later measurements in reverse order; per tick positions, then velocities."""
        self.q: Array
        self.v: Array
        self.q, self.v = _read(self._table, q, np.zeros_like(q), torque, 0.0)

    def update(self, q: Array, v: Array, torque: Array) -> None:
        """Advance by a step of the plant: true positions and velocities after it, and the torque during it."""
        self.q, self.v = _read(self._table, q, v, torque, DT)

    def read(self) -> tuple[Array, Array]:
        """Return positions and velocities with white noise."""
        if not self._noise:
            noise = self._deviation * self._rng.standard_normal((SENSORS.block, len(self._deviation)))
            self._noise = list(noise.reshape(-1, len(self.q))[::-1])
        return self.q + self._noise.pop(), self.v + self._noise.pop()


class TorqueSensors:
    """Torque sensors between the gears and the links, as an LBR has them; see `TorqueErrors` for the equation."""

    def __init__(self, robot: Robot, drawn: DrawnTorque, rng: np.random.Generator) -> None:
        self._drawn, self._rng = drawn, rng
        self._missing = Kinematics(robot, mass_scale=drawn.link_mass - 1.0)  # gravity is linear in the masses

    def read(self, q: Array, v: Array, torque: Array, readings: int) -> Array:
        """Return the mean measured torque on the links [N m], shape (n,), of `readings` readings at `q` [rad] and `v` [rad/s]."""
        given, drawn = self._drawn.given, self._drawn
        loaded = torque + self._missing.state(q, np.zeros_like(v))[13:]
        friction = (given.friction_nm + given.load_friction * np.abs(loaded)) * (v / (np.abs(v) + STICK_RADPS))
        noise = given.noise_nm / np.sqrt(readings) * self._rng.standard_normal(len(q))
        return np.asarray(drawn.gain * loaded + drawn.zero_nm + friction + noise)


class FtSensor:
    """Adds the sensor's errors to the true wrench. Wrenches: force [N], then moment [N m], in sensor axes."""

    def __init__(self, drawn: DrawnForce, rng: np.random.Generator, period_s: float) -> None:
        """Create a sensor that powers on at the first reading and is read every `period_s` [s]."""
        given = drawn.given
        self._drawn = drawn
        self._sensitivity = np.ascontiguousarray(drawn.sensitivity)
        self._lag = exp(-period_s / drawn.lag_s) if drawn.lag_s else 0.0
        self._filtered: Array | None = None
        """Reading after the lag; None before the first reading."""
        self._deviation = np.repeat((given.noise_n, given.noise_nm), 3)
        self._scale = np.repeat((1.0, MOMENT_PER_FORCE_M), 3)
        self._rng = rng
        (slow,) = rng.bit_generator.seed_seq.spawn(1)  # type: ignore[attr-defined]  # white noise does not depend on drift
        self._slow = np.random.Generator(np.random.PCG64(slow))
        self._t = period_s * np.arange(SENSORS.block)
        self._length_s = period_s * SENSORS.block
        self._blocks = 0
        self._wander = given.tare_n * self._scale * self._slow.standard_normal(6)
        self._walk = np.zeros(6)
        self._errors: list[Array] = []
        """Errors of later readings in reverse order, shape (6,) each."""

    def read(self, wrench: Sequence[float]) -> list[float]:
        """Return a reading of the true wrench."""
        if not self._errors:
            self._errors = list(self.block()[::-1])
        if self._lag:
            true = np.asarray(wrench)
            self._filtered = true if self._filtered is None else true + self._lag * (self._filtered - true)
            wrench = self._filtered.tolist()
        reading: list[float] = (self._sensitivity.dot(wrench) + self._errors.pop()).tolist()
        return reading

    def block(self) -> Array:
        """Return the additive errors of the next block of readings, shape (k, 6)."""
        return np.asarray(self._drift() + self._deviation * self._rng.standard_normal((SENSORS.block, 6)))

    def _drift(self) -> Array:
        """Return the errors of the next block without white noise, shape (k, 6)."""
        given, drawn = self._drawn.given, self._drawn
        t = self._blocks * self._length_s + self._t
        self._blocks += 1
        before = self._wander + self._walk
        step = self._slow.standard_normal((2, 6))
        kept = np.exp(-self._length_s / given.tare_s)
        self._wander = kept * self._wander + given.tare_n * self._scale * np.sqrt(1 - kept**2) * step[0]
        self._walk = self._walk + given.walk_n * self._scale * np.sqrt(self._length_s / 60.0) * step[1]
        path = np.outer(self._t / self._length_s, self._wander + self._walk - before)
        warm = np.outer(1 - np.exp(-t / given.warm_up_s), drawn.warm_up)
        return np.asarray(drawn.bias + before + path + warm)
