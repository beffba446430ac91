"""Planning's messages from arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_bus.messages import ExamState, ImpedanceSetpoint
from palpate_bus.messages.codec import Message, message_type
from palpate_bus.messages.stamps import header
from palpate_models.rotations import quaternion
from palpate_planning.measure import Contact
from palpate_planning.setpoint import DAMPING_RATIO, Setpoint
from palpate_planning.status import ExamStatus

Array = NDArray[np.float64]

_Path: Any = message_type("nav_msgs/msg/Path")
_PoseStamped: Any = message_type("geometry_msgs/msg/PoseStamped")
_Pose: Any = message_type("geometry_msgs/msg/Pose")
_Point: Any = message_type("geometry_msgs/msg/Point")
_Vector3: Any = message_type("geometry_msgs/msg/Vector3")
_Quaternion: Any = message_type("geometry_msgs/msg/Quaternion")
_Twist: Any = message_type("geometry_msgs/msg/Twist")
_Wrench: Any = message_type("geometry_msgs/msg/Wrench")
_NO_MOMENT: Any = _Vector3(0.0, 0.0, 0.0)


def pose_message(X_WI: Array) -> Message:
    """`geometry_msgs/Pose` of a homogeneous matrix."""
    (xx, xy, xz, x), (yx, yy, yz, y), (zx, zy, zz, z), _ = X_WI.tolist()
    return _Pose(_Point(x, y, z), _Quaternion(*quaternion(((xx, xy, xz), (yx, yy, yz), (zx, zy, zz)))))


def setpoint_message(t: int, setpoint: Setpoint, valid_for: Message) -> Message:
    """`palpation_msgs/ImpedanceSetpoint` that holds at `t` [ns]."""
    vx, vy, vz, wx, wy, wz = setpoint.V_WI.tolist()
    return ImpedanceSetpoint(
        header=header(t, "world"),
        mode=int(setpoint.mode),
        pose=pose_message(setpoint.X_WI),
        twist=_Twist(_Vector3(vx, vy, vz), _Vector3(wx, wy, wz)),
        wrench=_Wrench(_Vector3(*setpoint.F_W.tolist()), _NO_MOMENT),
        stiffness=setpoint.stiffness,
        damping_ratio=DAMPING_RATIO,
        joint_position=setpoint.q,
        joint_velocity=setpoint.qd,
        joint_stiffness=setpoint.joint_stiffness,
        valid_for=valid_for,
    )


def state_message(t: int, status: ExamStatus, contact: Contact | None) -> Message:
    """`palpation_msgs/ExamState`; without a contact (the robot has not been heard of) nothing is measured."""
    p = (0.0, 0.0, 0.0) if contact is None else contact.p_W.tolist()
    n = (0.0, 0.0, 1.0) if contact is None else contact.n_W.tolist()
    return ExamState(
        header=header(t, "world"),
        phase=int(status.phase),
        message=status.message,
        target_index=status.target_index,
        target_count=status.target_count,
        targets_skipped=status.targets_skipped,
        in_contact=contact is not None and contact.touching,
        steady=status.steady,
        force_limited=status.force_limited,
        view_blocked=status.view_blocked,
        depth_setpoint=float(status.depth_setpoint),
        depth=0.0 if contact is None else float(contact.depth),
        normal_force=0.0 if contact is None else float(contact.force),
        surface_point=_Point(*p),
        surface_normal=_Vector3(*n),
        end_tick=status.end_tick,
    )


def path_message(t: int, poses_WI: Array) -> Message:
    """`nav_msgs/Path` of indenter poses, shape (n, 4, 4)."""
    stamped = [_PoseStamped(header(t, "world"), pose_message(X)) for X in poses_WI]
    return _Path(header(t, "world"), stamped)
