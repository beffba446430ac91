"""Forward kinematics and Jacobian of the tool from the tables of `palpate_models.lbr`, independent of any service."""

from __future__ import annotations

import numpy as np
from palpate_models import lbr
from palpate_models.frames import Array
from palpate_models.scenario import Robot
from scipy.spatial.transform import Rotation


def _chain(q: Array, robot: Robot) -> tuple[Array, list[Array], list[Array]]:
    """X_WI, and origins and axes of the joints in world."""
    X = np.eye(4)
    X[:3, :3] = Rotation.from_euler("z", robot.base_yaw_rad).as_matrix()
    X[:3, 3] = (*robot.base_xy_m, robot.base_height_m)
    origins, axes = [], []
    for angle, origin, axis in zip(q, lbr.JOINT_ORIGIN, lbr.JOINT_AXIS, strict=True):
        X[:3, 3] += X[:3, :3] @ np.array(origin)
        axis_W = X[:3, :3] @ np.array(axis)
        origins.append(X[:3, 3].copy())
        axes.append(axis_W)
        X[:3, :3] = X[:3, :3] @ Rotation.from_rotvec(angle * np.array(axis)).as_matrix()
    X[:3, 3] += X[:3, :3] @ np.array((0.0, 0.0, lbr.LINK_7_TO_FLANGE_M + lbr.FLANGE_TO_FT_M + lbr.FT_TO_INDENTER_M))
    return X, origins, axes


def tool_pose(q: Array, robot: Robot) -> Array:
    """X_WI of the indenter at joint positions `q` [rad], shape (4, 4)."""
    return _chain(q, robot)[0]


def tool_jacobian(q: Array, robot: Robot) -> Array:
    """Jacobian of the indenter's V_WI_W (linear above angular) by the joint speeds, shape (6, 7)."""
    X_WI, origins, axes = _chain(q, robot)
    columns = [np.concatenate((np.cross(axis, X_WI[:3, 3] - origin), axis)) for origin, axis in zip(origins, axes, strict=True)]
    return np.array(columns).T
