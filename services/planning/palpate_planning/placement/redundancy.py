"""Redundancy resolution: postures that perform a whole scan with the most margin.

    postures = plan_redundancy(robot, positions_W, normals_W, q_seed)

Position and tool axis take five of six or seven joints. The rest (elbow swivel, spin about the tool) is chosen by optimisation:
far from joint limits and singularities, little torque at the pressing force, elbow high, smooth along the path.
`palpate arm place` optimises the base placement with the same costs.

The arm in CasADi has kinematics, gravity torques and cost of a posture from the same tables as its URDF. A task is a position of
the indenter's origin and the direction of its z axis: five equations. A base placement is (x [m], y [m], height [m],
yaw [rad]) in world, shape (4,).
"""

from functools import lru_cache
from importlib import import_module
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial import cKDTree

from palpate_errors import UserError
from palpate_models.numerics.frames import GRAVITY, Array, Indices, Mask, path_length
from palpate_models.robot.arm import TOOL, arm_of, inertias
from palpate_models.robot.fitting import seeds_of
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


class ResolutionTuning(NamedTuple):
    """Numerical tuning of the redundancy resolution."""

    task_tolerance: float = 1e-5
    """Residual at which a target is reached [m, rad]."""
    projection_steps: int = 12
    """Gauss-Newton steps that project a posture onto its target."""
    ik_steps: int = 40
    descent: float = 0.05
    largest_step_rad: float = 0.15


RESOLUTION = ResolutionTuning()


class Batch:
    """Targets with their CasADi maps, evaluated for all postures at once. Postures are rows."""

    def __init__(self, robot: Robot, positions: Array, normals: Array, limits: tuple[Array, Array], force: float) -> None:
        n, self.arm = len(positions), arm_of(robot)
        self.robot, self.count, self.limits, self.force = robot, n, limits, force
        self.base = base_of(robot)
        self.positions = positions
        self.frames = surface_frames(normals)
        self.functions = arm(robot)
        self._task, self._cost = self.functions.task.map(n), self.functions.cost.map(n)
        self._base = np.tile(self.base[:, None], (1, n))
        self._frames = np.hstack(list(self.frames))

    def task(self, q: Array) -> tuple[Array, Array]:
        """Return residuals (n, 5) and their Jacobians (n, 5, joints)."""
        residual, jacobian = self._task(q.T, self._base, self.positions.T, self._frames)
        return np.array(residual).T, np.array(jacobian).reshape(5, self.count, self.arm.joints).transpose(1, 0, 2)

    def cost(self, q: Array) -> Array:
        """Return the costs of the postures, shape (n,)."""
        cost: Array = np.array(self._cost(q.T, self._base, self.force)[0])[0]
        return cost

    def gradient(self, q: Array) -> Array:
        """Return the gradients of the costs, shape (n, joints)."""
        return np.array(self._cost(q.T, self._base, self.force)[1]).T

    def facing(self, q: Array) -> Array:
        """Return the cosine between tool axis and inward normal, shape (n,)."""
        cosine: Array = np.array(self.functions.facing.map(self.count)(q.T, self._base, self._frames))[0]
        return cosine

    def solve(self, q: Array, steps: int, descent: float) -> Array:
        """Return postures after damped Gauss-Newton steps, shape (n, joints); `descent` scales the gradient in the null space."""
        damping = 1e-6 * np.eye(5)
        for step in range(steps):
            residual, J = self.task(q)
            gram = J @ J.transpose(0, 2, 1) + damping
            rhs = residual[..., None]
            if descent:
                push = -descent * self.gradient(q) * (1 - step / steps)
                rhs = rhs + J @ push[..., None]
            move = -(J.transpose(0, 2, 1) @ np.linalg.solve(gram, rhs))[..., 0]
            if descent:
                move += push
            largest = np.abs(move).max(axis=1, keepdims=True)
            q = q + move * np.minimum(1.0, RESOLUTION.largest_step_rad / np.maximum(largest, 1e-12))
            q = np.clip(q, *self.limits)
        return q

    def part(self, indices: Indices) -> "Batch":
        """Return a batch with some of the targets."""
        return Batch(self.robot, self.positions[indices], self.frames[indices, :, 2], self.limits, self.force)

    def search(self, q: Array) -> Array:
        """Return inverse kinematics from postures `q` with low cost, shape (n, joints)."""
        return self.solve(self.solve(q, RESOLUTION.ik_steps, RESOLUTION.descent), RESOLUTION.projection_steps, 0.0)

    def from_one(self, start: Array) -> Array:
        """Return inverse kinematics of all targets from one posture, shape (n, joints)."""
        return self.search(np.tile(np.clip(start, *self.limits), (self.count, 1)))

    def verdict(self, q: Array) -> tuple[int, float]:
        """Return a score, lower is better: number of missed targets, then mean cost of the others, rounded for repeatability."""
        reached = self.check_reached(q)[1]
        cost = self.cost(q)
        return int((~reached).sum()), round(float(cost[reached].mean()), 3) if reached.any() else 0.0

    def check_reached(self, q: Array) -> tuple[Array, Mask]:
        """Return the norm of the residual (n,), and True where the target is reached with the right orientation (n,)."""
        residual = np.linalg.norm(self.task(q)[0], axis=1)
        facing = self.facing(q)
        wrong = facing <= 0
        return np.where(wrong, np.maximum(residual, 1 - facing), residual), (residual < RESOLUTION.task_tolerance) & ~wrong


class PostureTuning(NamedTuple):
    """Tuning of the optimised postures."""

    knots: int = 32
    """Maximum number of optimised targets; postures in between are interpolated and projected onto their targets."""
    smoothness: float = 2.0
    """Weight of squared joint travel [1/rad^2] between knots of mean spacing (assumed)."""
    pressing_force_n: float = 15.0
    """Normal force in the cost of postures: the working force limit."""


POSTURES = PostureTuning()

_IPOPT_STEPS, _SAMPLES = 80, 16


class PostureSequence(NamedTuple):
    """A posture for each target, in the order of the targets."""

    q: Array
    """Joint positions [rad], shape (n, joints); the closest posture where the target is not reachable."""
    reachable: Mask
    """True where the target is reached within the joint limits minus the margin, shape (n,)."""
    margin: Array
    """Distance to the nearest joint limit [rad], shape (n,)."""
    torque_fraction: Array
    """Maximum joint torque over its limit, from gravity and pressing force [1], shape (n,)."""
    dexterity: Array
    """Distance from singularity, sqrt(det(J J^T)) of the length-scaled Jacobian [1], shape (n,)."""
    refined: bool
    """True if the optimisation converged; else the result of inverse kinematics with a null-space gradient."""


def plan_redundancy(
    robot: Robot,
    positions_W: Array,
    normals_W: Array,
    q_seed: Array,
    *,
    joint_margin_rad: float = 0.05,
    force_n: float = POSTURES.pressing_force_n,
) -> PostureSequence:
    """Return postures that move the indenter along targets with the tool's z axis opposite to the surface normals.

    Args:
        robot: the robot with its base placement and tool.
        positions_W: origins of the indenter frame (the sphere's centre) in world, in path order [m], shape (n, 3).
        normals_W: outward unit surface normals in world, shape (n, 3).
        q_seed: initial posture, e.g. the present one [rad], shape (joints,); it selects among equally good branches.
        joint_margin_rad: distance kept from each joint limit.
        force_n: normal force of the postures.

    Unreachable targets are flagged, not dropped. The result depends only on the arguments.
    """
    model = arm_of(robot)
    limits = (model.lower_rad + joint_margin_rad, model.upper_rad - joint_margin_rad)
    batch = Batch(robot, positions_W, normals_W, limits, force_n)
    q = _inverse_kinematics(batch, q_seed)
    better = _refine(robot, batch, q, batch.check_reached(q)[1])
    if better is not None:  # the refined postures, except for targets that only inverse kinematics reached
        lost = batch.check_reached(q)[1] & ~batch.check_reached(better)[1]
        q = np.where(lost[:, None], q, better)
    return _judge(batch, q, better is not None)


def prepare(robot: Robot, force_n: float = POSTURES.pressing_force_n) -> None:
    """Build the CasADi functions and the solver of `plan_redundancy` in advance."""
    arm(robot)
    _program(_at_origin(robot), POSTURES.knots, force_n)


def _at_origin(robot: Robot) -> Robot:
    """Return the robot with its base at the origin; the solver takes the base as a parameter."""
    return robot.model_copy(update={"base_xy_m": (0.0, 0.0)})


def _seeds(batch: Batch, seed: Array) -> list[Array]:
    """Return initial postures: the caller's, and the arm's, turned about its first joint to the targets."""
    x, y = batch.positions.mean(axis=0)[:2] - batch.base[:2]
    azimuth = np.arctan2(y, x) - batch.base[3]
    azimuth = np.arctan2(np.sin(azimuth), np.cos(azimuth))
    seeds = [seed]
    for q in np.array(seeds_of(batch.arm)):
        q[0] = 0.0
        x, y, _ = batch.arm.posture(q)[0][-1]
        q[0] = azimuth - np.arctan2(y, x)
        seeds.append(q)
    return seeds


def _inverse_kinematics(batch: Batch, seed: Array) -> Array:
    """Return a posture for each target, shape (n, joints), from the best seed, then from the nearest reached neighbour."""
    sample = batch.part(np.unique(np.linspace(0, batch.count - 1, min(_SAMPLES, batch.count)).round().astype(int)))
    best = min(_seeds(batch, seed), key=lambda start: sample.verdict(sample.from_one(start)))
    q = batch.from_one(best)
    missing, reached = batch.check_reached(q)
    if reached.any() and not reached.all():
        _, nearest = cKDTree(batch.positions[reached]).query(batch.positions)
        trial = batch.search(q[np.flatnonzero(reached)[nearest]])
        residual, good = batch.check_reached(trial)
        better = ~reached & (good | (residual < missing))
        q = np.where(better[:, None], trial, q)
    return q


def _knots(batch: Batch, reachable: Mask) -> Indices:
    """Return indices of the optimised targets: reachable, evenly spaced along the path, ends included."""
    candidates = np.flatnonzero(reachable)
    s = path_length(batch.positions, least=1e-6)[candidates]
    wanted = np.linspace(s[0], s[-1], min(POSTURES.knots, len(candidates)))
    nearest = np.unique(np.abs(s[None, :] - wanted[:, None]).argmin(axis=1))
    return np.asarray(candidates[nearest])


@lru_cache(maxsize=4)
def _program(robot: Robot, count: int, force: float) -> Any:
    """Return an Ipopt solver for `count` knots. Parameters: base, positions, frames, weight of each step between knots."""
    ca = casadi()
    functions = arm(robot)
    Q = ca.MX.sym("q", arm_of(robot).joints, count)
    base, P = ca.MX.sym("base", 4), ca.MX.sym("P", 3, count)
    frames, weights = ca.MX.sym("frames", 3, 3 * count), ca.MX.sym("weights", count - 1)
    bases = ca.repmat(base, 1, count)
    travel = Q[:, 1:] - Q[:, :-1]
    cost = ca.sum2(functions.cost.map(count)(Q, bases, force)[0])
    cost += POSTURES.smoothness * ca.dot(weights, ca.sum1(travel**2).T)
    residual = functions.task.map(count)(Q, bases, P, frames)[0]
    problem = {"x": ca.vec(Q), "p": ca.vertcat(base, ca.vec(P), ca.vec(frames), weights), "f": cost, "g": ca.vec(residual)}
    ipopt = {"max_iter": _IPOPT_STEPS, "tol": 1e-4, "print_level": 0, "sb": "yes", "max_wall_time": 1e6}
    return ca.nlpsol("redundancy", "ipopt", problem, {"ipopt": ipopt, "print_time": False})


def _refine(robot: Robot, batch: Batch, q: Array, reachable: Mask) -> Array | None:
    """Return optimal postures interpolated from the knots and projected onto the targets; None if Ipopt did not converge."""
    if reachable.sum() < 2 or len(knots := _knots(batch, reachable)) < 2:
        return None
    solver = _program(_at_origin(robot), len(knots), batch.force)
    s = path_length(batch.positions, least=1e-6)
    spacing = np.diff(s[knots])
    weights = spacing.mean() / spacing
    parameters = np.concatenate(
        (batch.base, batch.positions[knots].ravel(), np.hstack(list(batch.frames[knots])).ravel(order="F"), weights)
    )
    lower, upper = (np.tile(limit, len(knots)) for limit in batch.limits)
    result = solver(x0=q[knots].ravel(), p=parameters, lbx=lower, ubx=upper, lbg=0, ubg=0)
    if not solver.stats()["success"]:
        return None
    optimal = np.array(result["x"]).reshape(len(knots), -1)
    within = np.clip(s, s[knots[0]], s[knots[-1]])
    between = PchipInterpolator(s[knots], optimal)(within)
    return batch.solve(between, RESOLUTION.projection_steps, 0.0)


def _judge(batch: Batch, q: Array, refined: bool) -> PostureSequence:
    bases = np.tile(batch.base[:, None], (1, batch.count))
    torque = np.array(batch.functions.torque.map(batch.count)(q.T, bases, batch.force)).T
    return PostureSequence(
        q=q,
        reachable=batch.check_reached(q)[1],
        margin=np.minimum(batch.arm.upper_rad - q, q - batch.arm.lower_rad).min(axis=1),
        torque_fraction=(np.abs(torque) / batch.arm.torque_nm).max(axis=1),
        dexterity=np.array(batch.functions.dexterity.map(batch.count)(q.T, bases))[0],
        refined=refined,
    )
