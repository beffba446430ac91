"""Position loop of a simulated arm that takes joint positions: commands in, torques of the drives out.

A command is followed after a latency, by a critically damped reference r within limits of speed and acceleration; the drives are

    tau = gravity + k (r' - q - h v) + d (dr/dt - v)

discretised as stable proportional-derivative control (Tan, Liu and Turk, IEEE CG&A 2011, doi 10.1109/MCG.2011.30): r' is the
reference at the end of the step h, and the terms in v are implicit, so any gains are stable.
"""

from collections import deque
from typing import NamedTuple

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_models.robot.chain import Arm
from palpate_robot.plant import DT


class PositionLoopTuning(NamedTuple):
    """Constants of the loop (assumed): those of a geared arm with a servo at 500 Hz."""

    stiffness_per_torque: float = 100.0
    """k over the torque limit [1/rad]: 15 N on an outstretched arm turn its shoulder by 0.7 mrad."""
    settling_s: float = 0.02
    """d / k: time constant with which an error of position decays."""
    latency_ns: int = 11_000_000
    """Delay from the time of a command to its motion. Commands are interpolated, so that their jitter does not jerk the arm."""
    extrapolation_ns: int = 20_000_000
    """Time for which the motion continues where no newer command has come, as a UR's driver and a Franka's do."""
    reference_radps: float = 100.0
    """Frequency of the reference."""
    acceleration_factor: float = 2.0
    """Limit of acceleration over that of free motion."""


TUNING = PositionLoopTuning()
_STEP = round(DT * 1e9)  # [ns]


class PositionLoop:
    """Torques that follow position commands. Arrays have shape (n,)."""

    def __init__(self, arm: Arm, q: Array) -> None:
        """Start at rest at measured positions `q` [rad]."""
        self._stiffness = TUNING.stiffness_per_torque * arm.torque_nm
        self._rate = TUNING.settling_s * self._stiffness
        self.damping = self._rate + DT * self._stiffness
        """Damping to take implicitly [N m s/rad]."""
        self._limits = (arm.velocity_radps, TUNING.acceleration_factor * arm.acceleration_radps2, arm.torque_nm)
        self._goal, self._r, self._rd = q, q.copy(), np.zeros_like(q)
        self._commands = deque([(-_STEP, q)])
        """Time [ns] and positions of the command in effect and of later ones."""
        self._t = 0

    def torque(self, command: Array | None, q: Array, v: Array, gravity: Array, age: int = 0) -> Array:
        """Return the explicit part of the torques without gravity [N m] for a step at measured `q` [rad] and `v` [rad/s].

        It is within the torque limits together with gravity and with the implicit damping at the present `v`. Without a command
        the arm stops as fast as it may and stays. `age` of the command [ns]: negative if its sender is ahead of the arm.
        """
        self._t += _STEP
        speed, acceleration, limit = self._limits
        if command is None:
            wanted = -self._rd / DT
        else:
            if self._t - age > self._commands[-1][0]:
                self._commands.append((self._t - age, command))
            before, self._goal = self._goal, self._interpolated(self._t - TUNING.latency_ns)
            error, error_rate = self._goal - self._r, (self._goal - before) / DT - self._rd
            wanted = TUNING.reference_radps**2 * error + 2 * TUNING.reference_radps * error_rate
        self._rd = np.clip(self._rd + DT * np.clip(wanted, -acceleration, acceleration), -speed, speed)
        self._r = self._r + DT * self._rd
        if command is None:
            self._goal = self._r
            self._commands = deque([(self._t - _STEP, self._r)])
        damped = self.damping * v
        drives = self._stiffness * (self._r - q) + self._rate * self._rd - damped + gravity
        return np.asarray(np.clip(drives, -limit, limit) - gravity + damped)

    def _interpolated(self, t: int) -> Array:
        """Return the commanded positions at `t` [ns]; before the first command, that one."""
        while len(self._commands) > 2 and self._commands[1][0] <= t:
            self._commands.popleft()
        (t_0, q_0), (t_1, q_1) = self._commands[0], self._commands[-1] if len(self._commands) == 1 else self._commands[1]
        if t <= t_0 or t_1 == t_0:
            return q_0
        return np.asarray(q_0 + (min(t, t_1 + TUNING.extrapolation_ns) - t_0) / (t_1 - t_0) * (q_1 - q_0))
