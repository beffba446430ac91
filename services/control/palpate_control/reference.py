"""Set-points and what the controller follows between them: extrapolated by their twist, joined without a step."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from math import exp
from typing import Final

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from palpate_control.extrapolation import bridge, carry

Array = NDArray[np.float64]

MAX_EXTRAPOLATION_NS = 30_000_000
"""Past this age a set-point stands still. One is 10 to 19 ms old in use; one missing message is bridged."""
SMOOTHING_S = 0.005
"""Time constant in which the step between two set-points fades."""
MAX_ACCELERATION = 15.0
"""Bound on the acceleration read off consecutive joint set-points [rad/s^2]."""


class Mode(IntEnum):
    """What a set-point asks for; values of `palpation_msgs/ImpedanceSetpoint`."""

    CARTESIAN = 0
    JOINT = 1


@dataclass(frozen=True, slots=True)
class Setpoint:
    """One set-point of the impedance controller. Constructing one checks it; ValueError names the field."""

    mode: Mode
    stamp: int
    """Time at which pose and joint position hold [ns]."""
    R_WD: Array
    """Desired rotation of the indenter frame in world, shape (3, 3)."""
    p_WD: Array
    """Desired origin of the indenter frame in world [m], shape (3,)."""
    V_WD: Array
    """Desired twist in world axes, linear [m/s] then angular [rad/s], shape (6,)."""
    F_W: Array
    """Feed-forward wrench exerted on the environment, force [N] then torque [N m], world axes, at I, shape (6,)."""
    stiffness: Array
    """In axes of the desired frame: translation [N/m], rotation [N m/rad], shape (6,)."""
    damping_ratio: Array
    """[1], shape (6,)."""
    q: Array
    """JOINT: target; CARTESIAN: null-space posture [rad], shape (7,)."""
    qd: Array
    """Velocity of `q` [rad/s], shape (7,)."""
    joint_stiffness: Array
    """JOINT: joint stiffness; CARTESIAN: null-space stiffness [N m/rad], shape (7,)."""

    def __post_init__(self) -> None:
        everything = np.concatenate([getattr(self, name).ravel() for name in _ARRAYS])
        if not ((everything >= _LOW) & (everything <= _HIGH)).all():  # so it is, too, where one is NaN
            raise ValueError(self._wrong())
        a, b, c, d, e, f, g, h, i = everything[-9:].tolist()
        determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
        if abs(determinant - 1) > 1e-6:
            raise ValueError(f"set-point: R_WD has determinant {determinant}: must be a rotation")

    def _wrong(self) -> str:
        """The first field that is out of its range."""
        for name, part, field, low, high in RANGES:
            values = getattr(self, name)[part]
            if not np.isfinite(values).all():
                return f"set-point: {field} = {values}: must be finite"
            if not ((values >= low) & (values <= high)).all():
                return f"set-point: {field} = {values}: must be within {low:g} and {high:g}"
        return f"set-point: R_WD = {self.R_WD}: must be a rotation"


_ALL, _FIRST, _LAST = slice(None), slice(0, 3), slice(3, 6)
RANGES: Final = (
    ("stiffness", _ALL, "stiffness", 0.0, 20000.0),
    ("damping_ratio", _ALL, "damping_ratio", 0.0, 10.0),
    ("joint_stiffness", _ALL, "joint_stiffness", 0.0, 5000.0),
    ("p_WD", _ALL, "pose.position", -3.0, 3.0),
    ("V_WD", _FIRST, "twist.linear", -2.0, 2.0),
    ("V_WD", _LAST, "twist.angular", -20.0, 20.0),
    ("F_W", _FIRST, "wrench.force", -100.0, 100.0),
    ("F_W", _LAST, "wrench.torque", -50.0, 50.0),
    ("q", _ALL, "joint_position", -3.2, 3.2),
    ("qd", _ALL, "joint_velocity", -4.0, 4.0),
)
"""What a set-point may ask for: attribute, part of it, the message's field, least and largest value; as in the contract, where it
says."""
_ARRAYS: Final = ("stiffness", "damping_ratio", "joint_stiffness", "p_WD", "V_WD", "F_W", "q", "qd", "R_WD")
_SIZES: Final = (6, 6, 7, 3, 3, 3, 3, 3, 7, 7)
_LOW: Final = np.repeat([row[3] for row in RANGES] + [-2.0], (*_SIZES, 9))
_HIGH: Final = np.repeat([row[4] for row in RANGES] + [2.0], (*_SIZES, 9))


def rotation_from_quaternion(x: float, y: float, z: float, w: float) -> Array:
    """Rotation matrix, shape (3, 3), of a unit quaternion. Raises ValueError if its norm is off by 1 % or more."""
    norm = float(np.sqrt(x * x + y * y + z * z + w * w))
    if not abs(norm - 1) < 0.01:
        raise ValueError(f"set-point: pose.orientation = ({x}, {y}, {z}, {w}) has norm {norm}: must be 1")
    rotation: Array = pin.Quaternion(w / norm, x / norm, y / norm, z / norm).toRotationMatrix()
    return rotation


@dataclass(slots=True)
class Reference:
    """What the law follows at one tick; fields as in `Setpoint`."""

    mode: Mode
    R_WD: Array
    p_WD: Array
    V_WD: Array
    F_W: Array
    stiffness: Array
    damping_ratio: Array
    joint: Array
    """Joint position [rad], velocity and acceleration, shape (3, 7); the acceleration is zero in mode CARTESIAN."""
    joint_stiffness: Array

    @property
    def q(self) -> Array:
        """Joint position [rad], shape (7,)."""
        row: Array = self.joint[0]
        return row

    @property
    def qd(self) -> Array:
        """Joint velocity [rad/s], shape (7,)."""
        row: Array = self.joint[1]
        return row

    @property
    def qdd(self) -> Array:
        """Joint acceleration [rad/s^2], shape (7,)."""
        row: Array = self.joint[2]
        return row


class Extrapolator:
    """Carries set-points on to the present: pose (+) twist * age, joint position + velocity * age.

    Consecutive set-points rarely meet exactly: their path accelerates. The gap at the change-over (in pose, twist,
    wrench, joint position and velocity) is added to the new one and fades in `SMOOTHING_S`: neither step nor lag.
    """

    def __init__(self) -> None:
        self._current: Setpoint | None = None
        self._acceleration = np.zeros(7)
        self._gap = np.zeros(32)  # as `extrapolation.bridge` has it
        self._time = 0
        self._standing = False

    @property
    def current(self) -> Setpoint | None:
        """The set-point in use."""
        return self._current

    def clear(self) -> None:
        """Forgets the set-point, so that the next one starts afresh."""
        self._current = None
        self._acceleration = np.zeros(7)
        self._gap[:] = 0.0
        self._standing = False

    def accept(self, setpoint: Setpoint, t: int) -> None:
        """Takes a new set-point at time `t` [ns]."""
        old = self._current
        if old is None or old.mode != setpoint.mode:
            self.clear()
            self._current = setpoint
            return
        before = self._raw(old, t)
        spacing = setpoint.stamp - old.stamp
        joint = setpoint.mode is Mode.JOINT and 0 < spacing <= MAX_EXTRAPOLATION_NS
        acceleration = (setpoint.qd - old.qd) / (spacing * 1e-9) if joint else np.zeros(7)
        self._acceleration = np.clip(acceleration, -MAX_ACCELERATION, MAX_ACCELERATION)
        self._current = setpoint
        after = self._raw(setpoint, t)
        self._standing = False
        gap = self._gap
        gap[:3] += before.p_WD - after.p_WD
        gap[3:6] += pin.log3(before.R_WD @ after.R_WD.T)
        gap[6:12] += before.V_WD - after.V_WD
        gap[12:18] += before.F_W - after.F_W
        gap[18:25] += before.q - after.q
        gap[25:] += before.qd - after.qd

    def _raw(self, setpoint: Setpoint, t: int) -> Reference:
        """The set-point extrapolated to `t` alone, in arrays of its own."""
        age_ns = t - setpoint.stamp
        standing = age_ns > MAX_EXTRAPOLATION_NS
        age = min(max(age_ns, -MAX_EXTRAPOLATION_NS), MAX_EXTRAPOLATION_NS) * 1e-9
        R, p, V, joint = np.empty((3, 3)), np.empty(3), np.empty(6), np.empty((3, 7))
        carry(
            np.ascontiguousarray(setpoint.R_WD),
            setpoint.p_WD,
            setpoint.V_WD,
            setpoint.q,
            setpoint.qd,
            self._acceleration,
            age,
            standing,
            R,
            p,
            V,
            joint,
        )
        return Reference(
            setpoint.mode,
            R,
            p,
            V,
            setpoint.F_W.copy(),
            setpoint.stiffness,
            setpoint.damping_ratio,
            joint,
            setpoint.joint_stiffness,
        )

    def at(self, t: int) -> Reference:
        """The reference at time `t` [ns], which does not go back. Raises ValueError before the first set-point."""
        setpoint = self._current
        if setpoint is None:
            raise ValueError("no set-point yet")
        reference = self._raw(setpoint, t)
        if not self._standing and t - setpoint.stamp > MAX_EXTRAPOLATION_NS:
            self._standing = True  # the sender has fallen silent: brake smoothly
            self._gap[6:12] += setpoint.V_WD
            self._gap[25:] += setpoint.qd
        fade = exp(-max(t - self._time, 0) * 1e-9 / SMOOTHING_S) if self._time else 1.0
        self._time = t
        if setpoint.mode is Mode.JOINT:
            self._gap[:18] = 0.0  # a joint reference has no pose of its own
        bridge(fade, self._gap, reference.R_WD, reference.p_WD, reference.V_WD, reference.F_W, reference.joint)
        return reference
