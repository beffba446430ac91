"""The two kinds of set-point of planning, with the stiffness of each."""

from typing import Final

import numpy as np

from palpate_bus.setpoint import ControlMode, Setpoint
from palpate_models.numerics.frames import Array


def _freeze(values: list[float]) -> Array:
    array = np.array(values)
    array.setflags(write=False)
    return array


NORMAL_STIFFNESS: Final = 5000.0
"""K_z [N/m] along the tool: the depth error is 0.4 to 1.5 mm even before regulation."""
CARTESIAN_STIFFNESS: Final = _freeze([3000.0, 3000.0, NORMAL_STIFFNESS, 250.0, 250.0, 100.0])
"""[N/m, N m/rad] in axes of the indenter: stiff along the tool, softer across it, softest in spin."""
DAMPING_RATIO: Final = _freeze([0.8] * 6)
POSTURE_STIFFNESS: Final = 20.0
"""Null space in contact [N m/rad]; the controller caps its torque at 5 N m."""
_NO_TWIST: Final = _freeze([0.0] * 6)
_NO_WRENCH: Final = _freeze([0.0] * 6)
_NO_JOINTS: Final = _freeze([])
AT_REST: Final = Setpoint(
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
