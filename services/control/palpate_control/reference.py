"""What the law follows between set-points: each is carried on by its velocity and joined to the one before without a step."""

from __future__ import annotations

from math import exp
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from palpate_bus.setpoint import ControlMode, Setpoint
from palpate_models.numerics.frames import Array

BRIDGED_PERIODS = 3
"""A set-point older than this many periods stands still. One is one to two periods old in use, and one may be missing."""
SMOOTHING_S = 0.005
"""Time constant with which the step between two set-points fades [s]."""
MAX_ACCELERATION = 15.0
"""Bound on the acceleration read off consecutive joint set-points [rad/s^2]."""


# The coordinates of a motion are one vector, shape (39,), so that carrying on, joining and fading are one expression: position,
# rotation vector away from the set-point's own R_WD in world axes, joint positions; the velocities of these; wrench; the joints'
# acceleration, which alone is not joined.
P, PHI, Q, V, QD, F, QDD = (
    slice(0, 3), slice(3, 6), slice(6, 13), slice(13, 19), slice(19, 26), slice(26, 32), slice(32, 39)
)  # fmt: skip
_POSITIONS, _VELOCITIES, _JOINED = slice(0, 13), slice(13, 26), slice(0, 32)


class ReferenceMotion(NamedTuple):
    """The moving part of a set-point at one moment: its properties are as the fields of `Setpoint`."""

    R_WD: Array
    x: Array
    """Coordinates, shape (39,)."""

    @property
    def p_WD(self) -> Array:
        """[m], shape (3,)."""
        return self.x[P]

    @property
    def V_WD(self) -> Array:
        """[m/s] and [rad/s], shape (6,)."""
        return self.x[V]

    @property
    def F_W(self) -> Array:
        """[N] and [N m], shape (6,)."""
        return self.x[F]

    @property
    def q(self) -> Array:
        """[rad], shape (7,)."""
        return self.x[Q]

    @property
    def qd(self) -> Array:
        """[rad/s], shape (7,)."""
        return self.x[QD]

    @property
    def qdd(self) -> Array:
        """Acceleration of `q` [rad/s^2], shape (7,); zero in mode CARTESIAN."""
        return self.x[QDD]


class Reference(NamedTuple):
    """What the law follows at one tick."""

    setpoint: Setpoint
    """The set-point in use: its mode, stiffness and damping hold as they are."""
    motion: ReferenceMotion
    """Its motion, carried on to the tick."""


class Extrapolator:
    """Carries set-points on to the present: pose by the twist, joint positions by their velocity and acceleration.

    Consecutive set-points rarely meet exactly, because their path accelerates. The gap between them at the change-over is added
    to the new one and fades within `SMOOTHING_S`: there is neither a step nor a lag.
    """

    def __init__(self, period: int) -> None:
        """Set-points come every `period` [ns]."""
        self._max_age = BRIDGED_PERIODS * period
        self._terms = np.zeros((4, 39))
        """Coordinates at the set-point's stamp, what they gain with its age [s] and the square of that, and the gap."""
        self._since = 0
        """The last tick of the set-point before [ns]: the gap fades from then on."""
        self._tick = 0
        """The newest tick [ns]."""
        self.current: Setpoint | None = None
        """The set-point in use."""

    def clear(self) -> None:
        """Forgets the set-point, so that the next one starts afresh."""
        self.current = None

    def accept(self, setpoint: Setpoint, t: int) -> None:
        """Takes a new set-point at time `t` [ns]."""
        before = self.current
        if before is None or before.mode is not setpoint.mode:
            self.current, self._tick, self._terms = setpoint, t, _terms(setpoint, np.zeros(7))
            return
        now, acceleration = self._coordinates(before, t, self._tick), np.zeros(7)
        now[PHI] = pin.log3(pin.exp3(now[PHI]).dot(before.R_WD).dot(setpoint.R_WD.T))  # away from the new R_WD
        spacing = setpoint.stamp - before.stamp
        if setpoint.mode is ControlMode.JOINT and 0 < spacing <= self._max_age:
            acceleration = np.clip((setpoint.qd - before.qd) / (spacing * 1e-9), -MAX_ACCELERATION, MAX_ACCELERATION)
        self.current, self._since, self._terms = setpoint, self._tick, _terms(setpoint, acceleration)
        self._terms[3, _JOINED] = (now - self._coordinates(setpoint, t, t))[_JOINED]

    def at(self, t: int) -> Reference:
        """The reference at time `t` [ns]. Raises ValueError before the first set-point."""
        setpoint = self.current
        if setpoint is None:
            raise ValueError("no set-point yet")
        self._tick = t
        x = self._coordinates(setpoint, t, t)
        return Reference(setpoint, ReferenceMotion(pin.exp3(x[PHI]).dot(setpoint.R_WD), x))

    def _coordinates(self, setpoint: Setpoint, t: int, faded: int) -> Array:
        """Coordinates of the reference at `t`, shape (39,), with the gap as it has faded until `faded` [ns]."""
        since, longest = t - setpoint.stamp, self._max_age
        age = min(max(since, -longest), longest) * 1e-9
        fading = min(self._since - faded, 0) * 1e-9  # a clock that is set back makes no gap wider
        x: Array = np.array((1.0, age, age * age, exp(fading / SMOOTHING_S))).dot(self._terms)
        if since > longest:  # the sender has fallen silent: brake smoothly
            x[_VELOCITIES] *= exp((longest - since) * 1e-9 / SMOOTHING_S)
            x[QDD] = 0.0
        return x


def coordinates(setpoint: Setpoint, acceleration: Array) -> Array:
    """Coordinates of a set-point at its own stamp, shape (39,); `acceleration` of the joints [rad/s^2]."""
    return np.concatenate((setpoint.p_WD, np.zeros(3), setpoint.q, setpoint.V_WD, setpoint.qd, setpoint.F_W, acceleration))


def _terms(setpoint: Setpoint, acceleration: Array) -> Array:
    """The terms of a set-point's coordinates without a gap, shape (4, 39); `acceleration` of the joints [rad/s^2]."""
    terms = np.zeros((4, 39))
    terms[0] = coordinates(setpoint, acceleration)
    terms[1, _POSITIONS], terms[1, QD] = terms[0, _VELOCITIES], acceleration
    terms[2, Q] = acceleration / 2
    return terms
