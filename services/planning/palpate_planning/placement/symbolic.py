"""The arm in CasADi, from the same tables as its URDF: kinematics, gravity torques and cost of a posture.

A task is a position of the indenter's origin and the direction of its z axis: five equations. The spin about that axis and the
elbow swivel are free. A base placement is (x [m], y [m], height [m], yaw [rad]) in world, shape (4,).
"""

from functools import lru_cache
from importlib import import_module
from typing import Any, Final, NamedTuple

import numpy as np

from palpate_errors import UserError
from palpate_models.numerics.frames import GRAVITY, Array
from palpate_models.robot.arm import TOOL, arm_of, inertias
from palpate_models.scenario.schema import Robot


class PostureCost(NamedTuple):
    """Scales of the cost of a posture, and the weights of its terms, each of order one (assumed)."""

    elbow_clearance_m: float = 0.15
    """Minimum height of the elbow above the indenter, which keeps upper arm and forearm away from abdomen and table."""
    elbow_softness_m: float = 0.03
    """Height over which the cost of a low elbow begins."""
    reach_m: float = 0.4
    """Length scale of linear against angular rows of the Jacobian: upper arm and forearm."""
    ridge: float = 1e-12
    """Added to the Gram matrix of the Jacobian [1], so that no pivot is zero at a singularity."""
    limits_weight: float = 1.0
    torque_weight: float = 1.0
    dexterity_weight: float = 0.5
    elbow_weight: float = 5.0


COST: Final = PostureCost()


def casadi() -> Any:
    """Return the CasADi module, imported on first use. Raises UserError if it is not installed."""
    try:
        return import_module("casadi")
    except ImportError as error:
        raise UserError("posture planning needs CasADi: pip install 'palpate[run]'") from error


class ArmFunctions(NamedTuple):
    """CasADi functions of the arm.

    `q` (n,) [rad], `base` (4,), `p` (3,) [m], `frame` (3, 3): columns t1, t2 (tangents), n (outward surface normal).
    `force` [N] is pressed along the tool's z axis.
    """

    task: Any
    """(q, base, p, frame) -> residual (5,) [m, 1], its Jacobian by q (5, n): zero residual at the task's solutions."""
    facing: Any
    """(q, base, frame) -> cosine between the tool's z axis and -n [1]."""
    cost: Any
    """(q, base, force) -> cost of a posture [1], its gradient by q (n,)."""
    torque: Any
    """(q, base, force) -> joint torques that hold gravity and press with `force` [N m], shape (n,)."""
    dexterity: Any
    """(q, base) -> sqrt(det(J J^T)) of the length-scaled Jacobian [1]: zero where singular."""


def _axis_rotation(ca: Any, axis: Array | tuple[float, float, float], angle: Any) -> Any:
    """Return the rotation matrix about a unit vector (Rodrigues)."""
    K = ca.skew(ca.DM(np.asarray(axis)))
    return ca.DM.eye(3) + ca.sin(angle) * K + (1 - ca.cos(angle)) * ca.mtimes(K, K)


def _determinant(ca: Any, A: Any) -> Any:
    """Return the determinant of a positive semi-definite matrix by A = L D L'; `ca.det` uses cofactors, many more operations."""
    pivots, _, _ = ca.ldl(A + COST.ridge * ca.DM.eye(A.shape[0]), False)
    determinant = 1
    for pivot in ca.vertsplit(pivots):
        determinant *= pivot
    return determinant


@lru_cache(maxsize=8)
def arm(robot: Robot) -> ArmFunctions:
    """Return the functions of an arm with this robot's tool. The robot's base fields are not used: base is an argument."""
    ca, model = casadi(), arm_of(robot)
    n = model.joints
    q, base = ca.SX.sym("q", n), ca.SX.sym("base", 4)
    target, frame, force = ca.SX.sym("p", 3), ca.SX.sym("frame", 3, 3), ca.SX.sym("force")
    loads = list(inertias(robot).values())

    R = _axis_rotation(ca, (0.0, 0.0, 1.0), base[3])
    if model.R_BL is not None:
        R = ca.mtimes(R, ca.DM(model.R_BL))
    p = base[:3]
    origins, axes = [], []
    energy = ca.SX(0)
    for i in range(n):
        p = p + ca.mtimes(R, ca.DM(model.origin_m[i]))
        R = ca.mtimes(R, _axis_rotation(ca, model.axis[i], q[i]))
        origins.append(p)
        axes.append(ca.mtimes(R, ca.DM(model.axis[i])))
        link = loads[i + 1]
        energy += link.mass * GRAVITY * (p + ca.mtimes(R, ca.DM(link.com)))[2]
    p = p + ca.mtimes(R[:, :2], ca.DM(model.flange_m[:2])) if model.flange_m[:2].any() else p
    for load, offset in zip(loads[-3:], (model.flange_m[2], TOOL.flange_to_ft_m, TOOL.ft_to_indenter_m), strict=True):
        p = p + R[:, 2] * offset
        energy += load.mass * GRAVITY * (p + ca.mtimes(R, ca.DM(load.com)))[2]

    tool_axis = R[:, 2]
    linear = ca.horzcat(*(ca.cross(axis, p - origin) for axis, origin in zip(axes, origins, strict=True)))
    jacobian = ca.vertcat(linear / COST.reach_m, ca.horzcat(*axes))
    gram = _determinant(ca, ca.mtimes(jacobian, jacobian.T))
    torque = ca.gradient(energy, q) + ca.mtimes(linear.T, tool_axis * force)
    residual = ca.vertcat(p - target, ca.mtimes(frame[:, :2].T, tool_axis))
    elbow = origins[model.elbow[0]]

    relative = (q - ca.DM(model.middle_rad)) / ca.DM(model.half_range_rad)
    low = (p[2] + COST.elbow_clearance_m - elbow[2]) / COST.elbow_softness_m
    cost = (
        COST.limits_weight * ca.sum1(-ca.log(1 - relative**2))
        + COST.torque_weight * ca.sumsqr(torque / ca.DM(model.torque_nm))
        - COST.dexterity_weight * ca.log(gram + 1e-9)
        + COST.elbow_weight * ca.log1p(ca.exp(ca.fmin(low, 50)))
    )
    return ArmFunctions(
        ca.Function("task", [q, base, target, frame], [residual, ca.jacobian(residual, q)]),
        ca.Function("facing", [q, base, frame], [-ca.dot(frame[:, 2], tool_axis)]),
        ca.Function("cost", [q, base, force], [cost, ca.gradient(cost, q)]),
        ca.Function("torque", [q, base, force], [torque]),
        ca.Function("dexterity", [q, base], [ca.sqrt(ca.fmax(gram, 0))]),
    )


def surface_frames(normals: Array) -> Array:
    """Return frames with columns t1, t2 (tangents) and n for outward unit normals of shape (n, 3); shape (n, 3, 3)."""
    n = normals / np.linalg.norm(normals, axis=1)[:, None]
    helper = np.zeros_like(n)
    helper[np.arange(len(n)), np.abs(n).argmin(axis=1)] = 1.0
    t1 = np.cross(helper, n)
    t1 /= np.linalg.norm(t1, axis=1)[:, None]
    return np.stack((t1, np.cross(n, t1), n), axis=2)


def base_of(robot: Robot) -> Array:
    """Return the robot's base placement, shape (4,)."""
    return np.array([*robot.base_xy_m, robot.base_height_m, robot.base_yaw_rad])
