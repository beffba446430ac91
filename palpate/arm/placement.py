"""The place of an arm: where its base should stand, and what its shapes touch.

The optimal pose of the base is its x, y, height and yaw, together with a posture for each of a grid of targets. They cover the
examined region of the abdomen and a border around it, in contact and raised along their normals, for approach and retreat, other
patients and registration errors.
"""

from functools import cache
from operator import itemgetter
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from palpate_errors import RunError
from palpate_models.numerics.frames import Array, Mask, apply, matrix
from palpate_models.patient.phantom import build_phantom
from palpate_models.robot.arm import arm_of
from palpate_models.robot.chain import Arm
from palpate_models.robot.fitting import ready_postures
from palpate_models.robot.table import BASE_SIDE_M, TABLE, boxes
from palpate_models.robot.urdf_arm import flange_advice, home_advice
from palpate_models.scenario.arm_file import DEFAULT_ARM, arm_file, arm_path
from palpate_models.scenario.load import true_pose
from palpate_models.scenario.schema import Exam, Limits, Robot, Scenario
from palpate_planning.motion.kinematics import ArmKinematics
from palpate_planning.motion.scene import CollisionScene
from palpate_planning.placement.redundancy import POSTURES, PostureSequence, plan_redundancy
from palpate_planning.placement.symbolic import arm, base_of, casadi, surface_frames


class PlacementTuning(NamedTuple):
    """Settings of the search for a place of the base."""

    border_m: float = 0.005
    """Border about the examined region that is served too: turns between scan lines bulge over it."""
    raised_m: float = 0.035
    """Rise of the indenter from its depth along the normal that is served too: 25 mm above the surface."""
    clearance_m: float = 0.05
    """Between base and table (assumed)."""
    mean_weight: float = 0.3
    """Weight of the mean cost next to the worst target's."""
    margin_rad: float = 0.05
    ipopt_steps: int = 300


PLACEMENT: Final = PlacementTuning()
BOUNDS: tuple[Array, Array] = (np.array([-0.6, -0.4, 0.3, -0.3]), np.array([0.3, 0.4, 1.4, 0.3]))
"""Minimum and maximum x, y and height [m] and yaw [rad] of the base; yaw as far from the robot's own where that is beyond."""
STARTS: tuple[tuple[float, float, float, float], ...] = ((0.0, 0.0, 0.6, 0.0), (0.0, 0.0, 1.1, 0.0), (0.0, 0.1, 1.1, 0.0))
"""Placements to start from, after the robot's own; the best result counts, as the problem is not convex."""


def scan_targets(scenario: Scenario, spacing: float, border: float = 0.0, raised: float = 0.0) -> tuple[Array, Array]:
    """Return origins of the indenter [m] at `exam.depth_m` below the surface and outward normals, in world, shapes (n, 3).

    They lie in snake order on a grid of at most `spacing` over the examined region widened by `border`; `raised` lifts
    them along their normals. Normals are averaged over the indenter's footprint.
    """
    exam: Exam = scenario.exam
    model = build_phantom(scenario.phantom, scenario.seed)
    X_WA = matrix(true_pose(scenario))
    front = model.normals[:, 2] > 0.2
    vertices, normals = model.vertices[front], model.normals[front]
    half = np.asarray(exam.region_m) / 2 + border
    x, y = (np.linspace(c - h, c + h, int(np.ceil(2 * h / spacing)) + 1) for c, h in zip(exam.centre_m, half, strict=True))
    xy = np.array([(a, b) for i, b in enumerate(y) for a in (x if i % 2 == 0 else x[::-1])])
    distance = np.linalg.norm(vertices[None, :, :2] - xy[:, None], axis=2)
    weight = np.exp(-0.5 * (distance / (scenario.robot.indenter_radius_m / 2)) ** 2)
    n = weight @ normals
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    z = (weight @ vertices[:, 2]) / weight.sum(axis=1)
    offset = scenario.robot.indenter_radius_m - exam.depth_m + raised
    return apply(X_WA, np.column_stack((xy, z)) + offset * n), n @ X_WA[:3, :3].T


def best_placement(scenario: Scenario, spacing: float = 0.06) -> Robot:
    """Return the robot on the base placement with the lowest cost over the scenario's region.

    It is rounded to centimetres and hundredths of a radian. A placement counts whose targets inverse kinematics reaches, as an
    examination has to. Raises RunError with the best attempt if there is none.
    """
    contact = scan_targets(scenario, spacing, PLACEMENT.border_m)
    raised = scan_targets(scenario, spacing, PLACEMENT.border_m, PLACEMENT.raised_m)
    positions, normals = (np.concatenate(pair) for pair in zip(contact, raised, strict=True))
    starts = (base_of(scenario.robot), *map(np.array, STARTS))
    attempts = [_optimise(scenario.robot, positions, normals, start) for start in starts]
    home, tried = arm_of(scenario.robot).home_rad, []
    converged = [pair for pair in attempts if pair[0] < np.inf]
    for _, robot in sorted(converged or attempts, key=itemgetter(0)):
        postures = plan_redundancy(robot, positions, normals, home)
        if converged and postures.reachable.all():
            return robot
        tried.append((robot, postures))
    robot, postures = max(tried, key=lambda pair: pair[1].reachable.sum())
    if converged and postures.reachable.any():
        return robot
    best = describe(robot, postures)
    raise RunError(
        f"no base placement found; the best attempt is at {best}. The robot's base_xy_m, base_height_m and base_yaw_rad are "
        "tried first: give others, or a smaller exam.region_m"
    )


def _optimise(robot: Robot, positions: Array, normals: Array, start: Array) -> tuple[float, Robot]:
    """Return the cost [1] before rounding, infinite without convergence, and the placed robot from one start by Ipopt."""
    ca = casadi()
    count = len(positions)
    model, functions = arm_of(robot), arm(robot)
    guess = plan_redundancy(
        _standing(robot, start), positions, normals, model.home_rad, joint_margin_rad=2 * PLACEMENT.margin_rad
    ).q

    base, Q, worst = ca.MX.sym("base", 4), ca.MX.sym("q", model.joints, count), ca.MX.sym("worst")
    bases = ca.repmat(base, 1, count)
    costs = functions.cost.map(count)(Q, bases, POSTURES.pressing_force_n)[0]
    turn = start[3] if abs(start[3]) > BOUNDS[1][3] else 0.0  # the user's own: not every arm faces its base's x
    sides = [bound + np.array((0.0, 0.0, 0.0, turn)) for bound in BOUNDS]
    objective = worst + PLACEMENT.mean_weight * ca.sum2(costs) / count + 0.1 * (ca.sumsqr(base[1]) + ca.sumsqr(base[3] - turn))
    first = functions.cost.map(count)(guess.T, np.tile(start[:, None], (1, count)), POSTURES.pressing_force_n)[0]
    residual = functions.task.map(count)(Q, bases, positions.T, np.hstack(list(surface_frames(normals))))[0]
    corner = base[0] + BASE_SIDE_M / 2 * (ca.cos(base[3]) + ca.sqrt(ca.sin(base[3]) ** 2 + 1e-6))
    limited = ca.vertcat(ca.vec(residual), corner, costs.T - worst)
    problem = {"x": ca.vertcat(base, ca.vec(Q), worst), "f": objective, "g": limited}
    ipopt = {"max_iter": PLACEMENT.ipopt_steps, "tol": 1e-4, "print_level": 0, "sb": "yes", "max_wall_time": 1e6}
    solver = ca.nlpsol("placement", "ipopt", problem, {"ipopt": ipopt, "print_time": False})
    lower, upper = np.tile(model.lower_rad + PLACEMENT.margin_rad, count), np.tile(model.upper_rad - PLACEMENT.margin_rad, count)
    zeros = np.zeros(5 * count)
    result = solver(
        x0=np.concatenate((start, guess.ravel(), [float(np.array(first).max())])),
        lbx=np.concatenate((sides[0], lower, [-np.inf])),
        ubx=np.concatenate((sides[1], upper, [np.inf])),
        lbg=np.concatenate((zeros, np.full(1 + count, -np.inf))),
        ubg=np.concatenate((zeros, [TABLE.x_m[0] - PLACEMENT.clearance_m], np.zeros(count))),
    )
    solution = np.array(result["x"])[:, 0]
    return float(result["f"]) if solver.stats()["success"] else np.inf, _standing(robot, np.round(solution[:4], 2))


def _standing(robot: Robot, base: Array) -> Robot:
    """Return `robot` on the base placement `base`, shape (4,)."""
    x, y, height, yaw = (float(value) + 0.0 for value in base)  # + 0.0 makes no -0.0 of a zero
    return robot.model_copy(update={"base_xy_m": (x, y), "base_height_m": height, "base_yaw_rad": yaw})


def describe(robot: Robot, postures: PostureSequence) -> str:
    """Return a line on a placement: how much of the targets it reaches, and the worst margins."""
    reached: Mask = postures.reachable
    x, y, height, yaw = base_of(robot)
    head = f"x {x:6.2f} m  y {y:5.2f} m  height {height:4.2f} m  yaw {yaw:5.2f} rad"
    if not reached.any():
        return f"{head}: reaches none of {len(reached)} targets"
    return (
        f"{head}: reaches {reached.sum()} of {len(reached)} targets; "
        f"minimum joint margin {np.rad2deg(postures.margin[reached].min()):.1f} deg, "
        f"largest torque {100 * postures.torque_fraction[reached].max():.0f} % of its limit, "
        f"minimum dexterity {postures.dexterity[reached].min():.2f}"
    )


def home_origin(name: str) -> str:
    """Return a text on a home posture that the arm's file does not have; empty if it has one."""
    missing = name != DEFAULT_ARM and arm_file(name).home_rad is None
    return f"sought, as {arm_path(name).name} has none" if missing else ""


def flange_note(name: str, found: Arm) -> str:
    """Return what to write if the flange's z does not point out of the arm; empty if it does."""
    if name == DEFAULT_ARM:
        return ""
    return flange_advice(found, arm_file(name), arm_path(name).name)


def advice(name: str, robot: Robot | None = None) -> str:
    """Return what to write where an arm touches itself at home, or the surroundings of `robot`."""
    found = arm_of(robot or Robot(arm=name))
    if name == DEFAULT_ARM:
        return "move the base by hand"
    if wrong := flange_note(name, found):
        return wrong
    for home in ready_postures(found):
        if not touching(name, home, robot):
            return f"write `home_rad: {home.tolist()}` in {arm_path(name).name}, which is clear"
    return home_advice(found, arm_file(name), arm_path(name).name)


def touching(name: str, q: Array, at: Robot | None = None) -> list[str]:
    """Return the pairs of shapes of an arm, tool included, that are too close at `q` [rad], wherever its base stands.

    With `at`, also those of the arm and the table or base there.
    """
    robot = at or Robot(arm=name)
    found = _scene(robot).collisions(q)
    return [pair for pair in found if at is not None or not any(pair.endswith(box.name) for box in boxes(robot))]


@cache
def _scene(robot: Robot) -> CollisionScene:
    return CollisionScene(ArmKinematics(robot, Limits()), robot)


def draw_reach(path: Path, scenario: Scenario, positions: Array, reached: Array, base_xy: tuple[float, float]) -> None:
    """Draw the targets in world [m], shape (n, 3), seen from above, and which are `reached`, shape (n,)."""
    figure = Figure(figsize=(6.5, 6.5), dpi=110, layout="constrained")
    axes = figure.add_subplot()
    width, length = TABLE.x_m[1] - TABLE.x_m[0], TABLE.y_m[1] - TABLE.y_m[0]
    axes.add_patch(Rectangle((TABLE.x_m[0], TABLE.y_m[0]), width, length, fill=False, color="#7a8c94", label="table"))
    corner = (base_xy[0] - BASE_SIDE_M / 2, base_xy[1] - BASE_SIDE_M / 2)
    axes.add_patch(Rectangle(corner, BASE_SIDE_M, BASE_SIDE_M, color="#c9d1d4", label="base"))
    for chosen, colour, label in ((reached, "#2a9d8f", "reached"), (np.logical_not(reached), "#d07000", "out of reach")):
        if chosen.any():
            axes.plot(*positions[chosen, :2].T, "o", ms=4, color=colour, label=label)
    title = f"{scenario.robot.arm}: {reached.sum()} of {len(reached)} targets"
    axes.set(xlabel="x [m]", ylabel="y [m]", title=title, aspect="equal", ylim=(-0.6, 0.6))
    axes.legend()
    figure.savefig(path)
