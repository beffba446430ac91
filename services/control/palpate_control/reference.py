"""Set-points and what the controller follows between them: extrapolated by their twist, joined without a step."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from math import exp, sqrt
from operator import attrgetter
from typing import Final

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from palpate_control import layout
from palpate_control.extrapolation import carry, change_over, follow, joint_acceleration

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
    values: Array = field(init=False, repr=False, compare=False)
    """All of them as in `layout`, shape (64,)."""

    def __post_init__(self) -> None:
        values: Array = np.concatenate((*_PARTS(self), _STILL), axis=None)
        if values.size != layout.COUNT:
            raise ValueError(f"set-point: has {values.size - _STILL.size} numbers: must be {layout.COUNT - _STILL.size}")
        if not ((values >= _LOW) & (values <= _HIGH)).all():  # so it is, too, where one is NaN
            raise ValueError(self._wrong())
        object.__setattr__(self, "values", values)
        a, b, c, d, e, f, g, h, i = values[layout.R_WD : layout.QDD].tolist()
        determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
        if abs(determinant - 1) > 1e-6:
            raise ValueError(f"set-point: R_WD has determinant {determinant}: must be a rotation")

    def _wrong(self) -> str:
        """The first field that is out of its range."""
        for name, part, said, low, high in RANGES:
            values = getattr(self, name)[part]
            if not np.isfinite(values).all():
                return f"set-point: {said} = {values}: must be finite"
            if not ((values >= low) & (values <= high)).all():
                return f"set-point: {said} = {values}: must be within {low:g} and {high:g}"
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
_PARTS: Final = attrgetter(*(name for name in layout.NUMBERS.names or () if name != "qdd"))  # which is the last
_STILL: Final = np.zeros(layout.COUNT - layout.QDD)


def _bounds(column: int, of_rotation: float) -> Array:
    """Least or greatest values (`column` of `RANGES`) of all numbers, shape (64,)."""
    numbers = np.zeros(1, layout.NUMBERS)
    numbers["R_WD"] = of_rotation
    for row in RANGES:
        numbers[row[0]][:, row[1]] = row[column]
    return numbers.view(np.float64)


_LOW: Final = _bounds(3, -2.0)
_HIGH: Final = _bounds(4, 2.0)


def rotation_from_quaternion(x: float, y: float, z: float, w: float) -> Array:
    """Rotation matrix, shape (3, 3), of a unit quaternion. Raises ValueError if its norm is off by 1 % or more."""
    norm = sqrt(x * x + y * y + z * z + w * w)
    if not abs(norm - 1) < 0.01:
        raise ValueError(f"set-point: pose.orientation = ({x}, {y}, {z}, {w}) has norm {norm}: must be 1")
    rotation: Array = pin.Quaternion(w / norm, x / norm, y / norm, z / norm).toRotationMatrix()
    return rotation


@dataclass(slots=True)
class Reference:
    """What the law follows at one tick."""

    setpoint: Setpoint
    """The set-point that it comes from."""
    values: Array
    """That set-point's numbers carried on to the tick, and the joints' acceleration, as in `layout`, shape (64,)."""

    def __getitem__(self, name: str) -> Array:
        """The part of `values` that `layout.NUMBERS` has under this name, as a view of its shape."""
        part: Array = self.values.view(layout.NUMBERS)[name][0]
        return part


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
        acceleration = np.zeros(7)
        if setpoint.mode is Mode.JOINT and 0 < spacing <= MAX_EXTRAPOLATION_NS:
            joint_acceleration(old.values, setpoint.values, spacing * 1e-9, MAX_ACCELERATION, acceleration)
        self._acceleration = acceleration
        self._current = setpoint
        after = self._raw(setpoint, t)
        self._standing = False
        change_over(before.values, after.values, pin.log3(before["R_WD"] @ after["R_WD"].T), self._gap)
        if setpoint.mode is Mode.JOINT:
            self._gap[:18] = 0.0  # a joint reference has no pose of its own

    def _raw(self, setpoint: Setpoint, t: int) -> Reference:
        """The set-point extrapolated to `t` alone."""
        values = np.empty(layout.COUNT)
        age = t - setpoint.stamp
        carry(setpoint.values, self._acceleration, _bounded(age) * 1e-9, age > MAX_EXTRAPOLATION_NS, values)
        return Reference(setpoint, values)

    def at(self, t: int) -> Reference:
        """The reference at time `t` [ns], which does not go back. Raises ValueError before the first set-point."""
        setpoint = self._current
        if setpoint is None:
            raise ValueError("no set-point yet")
        age = t - setpoint.stamp
        standing = age > MAX_EXTRAPOLATION_NS
        if standing and not self._standing:
            self._standing = True  # the sender has fallen silent: brake smoothly
            if setpoint.mode is Mode.CARTESIAN:
                self._gap[6:12] += setpoint.V_WD
            self._gap[25:] += setpoint.qd
        elapsed = t - self._time
        fade = exp(-elapsed * 1e-9 / SMOOTHING_S) if self._time and elapsed > 0 else 1.0
        self._time = t
        values = np.empty(layout.COUNT)
        follow(setpoint.values, self._acceleration, _bounded(age) * 1e-9, standing, fade, self._gap, values)
        return Reference(setpoint, values)


def _bounded(age: int) -> int:
    """An age [ns] within what is extrapolated."""
    if age > MAX_EXTRAPOLATION_NS:
        return MAX_EXTRAPOLATION_NS
    return age if age > -MAX_EXTRAPOLATION_NS else -MAX_EXTRAPOLATION_NS
