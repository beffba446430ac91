"""Reference motion between set-points: each is extrapolated by its velocity and blended with the previous one."""

from math import exp
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from palpate_bus.setpoint import ControlMode, Setpoint
from palpate_models.numerics.frames import Array


class ReferenceTuning(NamedTuple):
    """Extrapolation and blending of set-points."""

    bridged_periods: int = 3
    """Set-points are extrapolated up to this many periods. In use they are one to two periods old, and one may be missing."""
    smoothing_s: float = 0.005
    """Time constant of the blend from one set-point to the next, and of braking in contact when set-points stop."""
    free_braking_s: float = 0.1
    """Time constant of braking in free motion: at 0.6 m/s a tool of 0.35 kg then loads its F/T sensor with 2 N."""
    max_acceleration_radps2: float = 15.0
    """Bound on the joint acceleration estimated from consecutive set-points."""


TUNING = ReferenceTuning()


# The coordinates of a motion are one vector, shape (18 + 3 n,) for n joints, so that extrapolation and blending are one
# expression: position, rotation vector relative to the set-point's R_WD in world axes, their velocity, wrench; then joint
# positions, velocities and accelerations. Only the accelerations are not blended.
POSITION, PHI, TWIST, WRENCH = slice(0, 3), slice(3, 6), slice(6, 12), slice(12, 18)
JOINTS = 18
"""Index of the first joint position."""
_POSE = slice(0, 6)


class ReferenceMotion(NamedTuple):
    """The moving part of a set-point at one time; the fields after `x` are views of it, as in `Setpoint`."""

    R_WD: Array
    x: Array
    """Coordinates, shape (18 + 3 n,)."""
    p_WD: Array
    V_WD: Array
    F_W: Array
    q: Array
    qd: Array
    qdd: Array
    """Acceleration of `q` [rad/s^2], shape (n,); zero in mode CARTESIAN."""

    @classmethod
    def of(cls, R_WD: Array, x: Array) -> "ReferenceMotion":
        """Return the motion with coordinates `x`, shape (18 + 3 n,)."""
        return cls(R_WD, x, x[POSITION], x[TWIST], x[WRENCH], *x[JOINTS:].reshape(3, -1))


class Reference(NamedTuple):
    """Set-point in use (mode, stiffness, damping) and its motion extrapolated to the tick."""

    setpoint: Setpoint
    motion: ReferenceMotion
    t: int
    """[ns]"""


class Extrapolator:
    """Extrapolates set-points: the pose by its twist, joint positions by their velocity and acceleration.

    Consecutive set-points rarely meet exactly, because their path accelerates. The gap at the change-over is added to the new
    set-point and decays with `smoothing_s`: there is neither a step nor a lag.
    """

    def __init__(self, period: int) -> None:
        """Create an extrapolator for set-points that arrive every `period` [ns]."""
        self._max_age = TUNING.bridged_periods * period
        self._terms = np.zeros((4, JOINTS))
        """Rows: coordinates at the set-point's stamp, coefficients of its age [s] and of the age squared, and the gap."""
        self._since = 0  # last tick of the previous set-point [ns]: the gap decays from then on
        self._tick = 0
        self.current: Setpoint | None = None

    def clear(self) -> None:
        """Discard the set-point; the next one is not blended."""
        self.current = None

    def accept(self, setpoint: Setpoint, t: int) -> None:
        """Accept a new set-point at time `t` [ns]."""
        before = self.current
        if before is None or before.mode is not setpoint.mode:
            self.current, self._tick, self._terms = setpoint, t, _terms(setpoint, np.zeros_like(setpoint.q))
            return
        now, acceleration = self._coordinates(before, t, self._tick), np.zeros_like(setpoint.q)
        now[PHI] = pin.log3(pin.exp3(now[PHI]).dot(before.R_WD).dot(setpoint.R_WD.T))  # relative to the new R_WD
        spacing = setpoint.stamp - before.stamp
        if setpoint.mode is ControlMode.JOINT and 0 < spacing <= self._max_age:
            limit = TUNING.max_acceleration_radps2
            acceleration = np.clip((setpoint.qd - before.qd) / (spacing * 1e-9), -limit, limit)
        self.current, self._since, self._terms = setpoint, self._tick, _terms(setpoint, acceleration)
        blended = slice(0, len(now) - len(acceleration))
        self._terms[3, blended] = (now - self._coordinates(setpoint, t, t))[blended]

    def at(self, t: int) -> Reference:
        """Return the reference at time `t` [ns]. Raises ValueError before the first set-point."""
        setpoint = self.current
        if setpoint is None:
            raise ValueError("no set-point received")
        self._tick = t
        x = self._coordinates(setpoint, t, t)
        return Reference(setpoint, ReferenceMotion.of(pin.exp3(x[PHI]).dot(setpoint.R_WD), x), t)

    def _coordinates(self, setpoint: Setpoint, t: int, faded: int) -> Array:
        """Return the coordinates at `t`, shape (18 + 3 n,), with the gap decayed until `faded` [ns]."""
        since, longest = (t - setpoint.stamp) * 1e-9, self._max_age * 1e-9
        age = min(max(since, -longest), longest)
        fading = min(self._since - faded, 0) * 1e-9  # a clock that is set back does not widen the gap
        x: Array = np.array((1.0, age, age * age, exp(fading / TUNING.smoothing_s))).dot(self._terms)
        if since > longest:  # set-points have stopped: the speed decays
            slowing = TUNING.free_braking_s if setpoint.mode is ControlMode.JOINT else TUNING.smoothing_s
            braked, n = exp((longest - since) / slowing), len(setpoint.q)
            q, qd = slice(JOINTS, JOINTS + n), slice(JOINTS + n, JOINTS + 2 * n)
            for place, speed in ((_POSE, TWIST), (q, qd)):
                x[place] += slowing * (1 - braked) * x[speed]
                x[speed] *= braked
            x[qd.stop :] = 0.0
        return x


def coordinates(setpoint: Setpoint, acceleration: Array) -> Array:
    """Return the coordinates of a set-point at its stamp, shape (18 + 3 n,); `acceleration` of the n joints [rad/s^2]."""
    return np.concatenate((setpoint.p_WD, np.zeros(3), setpoint.V_WD, setpoint.F_W, setpoint.q, setpoint.qd, acceleration))


def _terms(setpoint: Setpoint, acceleration: Array) -> Array:
    """Return the terms of a set-point's coordinates without a gap, shape (4, 18 + 3 n); `acceleration` [rad/s^2]."""
    x, n = coordinates(setpoint, acceleration), len(acceleration)
    terms = np.zeros((4, len(x)))
    terms[0] = x
    terms[1, _POSE] = x[TWIST]
    terms[1, JOINTS : JOINTS + 2 * n] = x[JOINTS + n :]
    terms[2, JOINTS : JOINTS + n] = acceleration / 2
    return terms
