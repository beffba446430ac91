"""Forward kinematics and Jacobian of the arm with its tool, straight from its tables: numpy only, not for hot paths."""

import numpy as np
from scipy.spatial.transform import Rotation

from palpate_models.numerics.frames import Array, rigid
from palpate_models.robot.arm import TOOL, arm_of, base_pose, link_names
from palpate_models.scenario.schema import Robot


def link_transforms(q: Array, robot: Robot) -> list[tuple[str, str, Array]]:
    """(parent, child, X_PC) of every link of the URDF, from `world` to `indenter`, at joint positions `q` [rad], shape (n,)."""
    arm = arm_of(robot)
    turns = Rotation.from_rotvec(np.asarray(q)[:, None] * arm.axis).as_matrix()
    steps = (arm.flange_m, (0.0, 0.0, TOOL.flange_to_ft_m), (0.0, 0.0, TOOL.ft_to_indenter_m))
    found = [base_pose(robot), *map(rigid, turns, arm.origin_m), *(rigid(np.eye(3), step) for step in steps)]
    links = link_names(robot)
    return list(zip(("world", *links[:-1]), links, found, strict=True))


def tool_pose(q: Array, robot: Robot) -> Array:
    """X_WI of the indenter, shape (4, 4)."""
    X_WI = np.eye(4)
    for _, _, X in link_transforms(q, robot):
        X_WI = X_WI @ X
    return X_WI


def tool_jacobian(q: Array, robot: Robot) -> Array:
    """Jacobian of the indenter's V_WI_W (linear above angular) by the joint speeds, shape (6, n)."""
    p_WI = tool_pose(q, robot)[:3, 3]
    columns = []
    X = np.eye(4)
    joints = link_transforms(q, robot)
    X = X @ joints[0][2]
    for (_, _, X_PC), axis in zip(joints[1:-3], arm_of(robot).axis, strict=True):
        X = X @ X_PC
        axis_W = X[:3, :3] @ axis
        columns.append(np.concatenate((np.cross(axis_W, p_WI - X[:3, 3]), axis_W)))
    return np.array(columns).T
