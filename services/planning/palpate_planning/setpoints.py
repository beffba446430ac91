"""The two kinds of set-point of planning, with the stiffness of each, and how they return to the arm."""

from collections.abc import Mapping
from math import cos, sqrt

import numpy as np
import pinocchio as pin

from palpate_bus.setpoint import ControlMode, Setpoint
from palpate_models.numerics.frames import Array, frozen

NORMAL_STIFFNESS = 5000.0
"""K_z [N/m] along the tool: the depth error is 0.4 to 1.5 mm even before regulation."""
CARTESIAN_STIFFNESS = frozen([3000.0, 3000.0, NORMAL_STIFFNESS, 250.0, 250.0, 100.0])
"""[N/m, N m/rad] in axes of the indenter: stiff along the tool, softer across it, softest in spin."""
DAMPING_RATIO = frozen([0.8] * 6)
POSTURE_STIFFNESS = 20.0
"""Null space in contact [N m/rad]; the controller caps its torque at 5 N m."""
_NO_TWIST = frozen([0.0] * 6)
_NO_WRENCH = frozen([0.0] * 6)
_NO_JOINTS = frozen([])
AT_REST = Setpoint(
    stamp=0,
    mode=ControlMode.JOINT,
    R_WD=np.eye(3),
    p_WD=np.zeros(3),
    V_WD=_NO_TWIST,
    F_W=_NO_WRENCH,
    stiffness=CARTESIAN_STIFFNESS,
    damping_ratio=DAMPING_RATIO,
    q=_NO_JOINTS,
    qd=_NO_JOINTS,
    joint_stiffness=_NO_JOINTS,
)
"""Common fields of both kinds."""


def joint_setpoint(t: int, X_WI: Array, q: Array, qd: Array, stiffness: Array) -> Setpoint:
    """Return the set-point of free motion at `t` [ns]: positions [rad], velocities [rad/s], stiffness [N m/rad], shapes (n,).

    X_WI, shape (4, 4): desired pose of the indenter, at `q`; drivers that take Cartesian set-points follow it.
    """
    return AT_REST._replace(stamp=t, R_WD=X_WI[:3, :3], p_WD=X_WI[:3, 3], q=q, qd=qd, joint_stiffness=stiffness)


def cartesian_setpoint(
    t: int, R_WD: Array, p_WD: Array, q: Array, V_WD: Array = _NO_TWIST, F_W: Array = _NO_WRENCH, qd: Array | None = None
) -> Setpoint:
    """Return the set-point of contact at `t` [ns]: pose, twist, feed-forward wrench, posture q [rad] in the null space.

    Shapes and units as in `Setpoint`.
    """
    motion = {"R_WD": R_WD, "p_WD": p_WD, "V_WD": V_WD, "F_W": F_W, "q": q, "qd": np.zeros_like(q) if qd is None else qd}
    return AT_REST._replace(stamp=t, mode=ControlMode.CARTESIAN, joint_stiffness=np.full_like(q, POSTURE_STIFFNESS), **motion)


RATE_SHARE = 0.8
"""Share of the contract's rates with which set-points return to the arm."""


class ReturnToArm:
    """Spreads a leap of the set-point to the arm over several periods, within the contract's rates.

    A motion that ends early continues from the arm, which lags behind, was held, or does not follow at all. A field that leaps
    towards the arm is limited until it is where it is wanted, though the arm may move. Any other leap is not changed: the port
    refuses it.
    """

    def __init__(self, period_s: float, rates: Mapping[str, float]) -> None:
        """`period_s`: of planning [s]; `rates`: maximum rates of change by field, as the contract has them."""
        fields = ("pose.position", "pose.orientation", "joint_position")
        self._step_m, self._step_rad, self._joint_step_rad = (RATE_SHARE * rates[field] * period_s for field in fields)
        self._last: Setpoint | None = None
        self._returning = False, False, False
        """True for each of position, orientation and joint positions that has leapt and has not arrived."""

    def step(self, wanted: Setpoint, X_WI: Array, q: Array) -> Setpoint:
        """Return the set-point of a period; X_WI, shape (4, 4), and q [rad], shape (n,): measured pose and posture."""
        last = self._last
        self._last = wanted if last is None else self._limited(last, wanted, X_WI, q)
        return self._last

    def _limited(self, last: Setpoint, wanted: Setpoint, X_WI: Array, q: Array) -> Setpoint:
        p_arm, change, turn = X_WI[:3, 3], wanted.p_WD - last.p_WD, wanted.q - last.q
        length, returning = sqrt(change.dot(change)), self._returning
        position = length > self._step_m and (
            returning[0] or np.linalg.norm(wanted.p_WD - p_arm) < np.linalg.norm(last.p_WD - p_arm)
        )
        orientation = _cosine(last.R_WD, wanted.R_WD) < cos(self._step_rad) and (
            returning[1] or _cosine(wanted.R_WD, X_WI) > _cosine(last.R_WD, X_WI)
        )
        joints = np.abs(turn).max() > self._joint_step_rad and (
            returning[2] or np.abs(wanted.q - q).max() < np.abs(last.q - q).max()
        )
        self._returning = position, orientation, joints
        if position:
            wanted = wanted._replace(p_WD=last.p_WD + change * (self._step_m / length))
        if orientation:
            phi = pin.log3(last.R_WD.T @ wanted.R_WD)
            wanted = wanted._replace(R_WD=last.R_WD @ pin.exp3(phi * (self._step_rad / np.linalg.norm(phi))))
        if joints:
            wanted = wanted._replace(q=last.q + np.clip(turn, -self._joint_step_rad, self._joint_step_rad))
        return wanted


def _cosine(R: Array, other: Array) -> float:
    """Return the cosine of the angle between two orientations, of shape (3, 3) or part of a pose (4, 4)."""
    return (float(np.vdot(R, other[:3, :3])) - 1) / 2
