"""Forward kinematics and Jacobian of the arm with its tool, straight from the tables of `lbr`: numpy only, not for hot paths."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from palpate_models.numerics.frames import Array
from palpate_models.robot import lbr
from palpate_models.scenario.schema import Robot


def link_transforms(q: Array, robot: Robot) -> list[tuple[str, str, Array]]:
    """(parent, child, X_PC) of every link of the URDF, from `world` to `indenter`, at joint positions `q` [rad], shape (7,)."""
    base = np.eye(4)
    base[:3, :3] = Rotation.from_euler("z", robot.base_yaw_rad).as_matrix()
    base[:3, 3] = (*robot.base_xy_m, robot.base_height_m)
    found = [base]
    turns = Rotation.from_rotvec(np.asarray(q)[:, None] * np.array(lbr.JOINT_AXIS)).as_matrix()
    for turn, origin in zip(turns, lbr.JOINT_ORIGIN, strict=True):
        X = np.eye(4)
        X[:3, :3] = turn
        X[:3, 3] = origin
        found.append(X)
    for length in (lbr.LINK_7_TO_FLANGE_M, lbr.FLANGE_TO_FT_M, lbr.FT_TO_INDENTER_M):
        X = np.eye(4)
        X[2, 3] = length
        found.append(X)
    parents = ("world", *lbr.LINK_NAMES[:-1])
    return list(zip(parents, lbr.LINK_NAMES, found, strict=True))


def tool_pose(q: Array, robot: Robot) -> Array:
    """X_WI of the indenter, shape (4, 4)."""
    X_WI = np.eye(4)
    for _, _, X in link_transforms(q, robot):
        X_WI = X_WI @ X
    return X_WI


def tool_jacobian(q: Array, robot: Robot) -> Array:
    """Jacobian of the indenter's V_WI_W (linear above angular) by the joint speeds, shape (6, 7)."""
    p_WI = tool_pose(q, robot)[:3, 3]
    columns = []
    X = np.eye(4)
    joints = link_transforms(q, robot)
    X = X @ joints[0][2]
    for (_, _, X_PC), axis in zip(joints[1:8], lbr.JOINT_AXIS, strict=True):
        X = X @ X_PC
        axis_W = X[:3, :3] @ np.array(axis)
        columns.append(np.concatenate((np.cross(axis_W, p_WI - X[:3, 3]), axis_W)))
    return np.array(columns).T
