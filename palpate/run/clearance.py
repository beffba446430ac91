"""Shapes that an arm touches where it stands, and advice for its YAML file against it."""

from functools import cache

import numpy as np

from palpate_errors import UserError
from palpate_models.numerics.frames import Array, apply, matrix
from palpate_models.patient.phantom import build_phantom
from palpate_models.robot.arm import arm_of, boxes
from palpate_models.robot.fitting import ready_postures
from palpate_models.robot.urdf_arm import home_advice
from palpate_models.scenario.load import exam_input, true_pose
from palpate_models.scenario.schema import DEFAULT_ARM, Limits, Robot, Scenario
from palpate_planning.motion.kinematics import ArmKinematics, CollisionScene
from palpate_planning.placement.redundancy import Batch, PostureSequence, plan_redundancy
from palpate_planning.strokes.plan import look_postures

_TOOL = {"ft_sensor": "Palpate's stand-off", "indenter": "Palpate's indenter", "robot_base": "the pedestal under the base"}
"""Shapes that a URDF does not have, in messages."""
_FURTHER_OUT = "name as flange a link further out"


def touching(q: Array, robot: Robot, *, itself: bool = False) -> list[str]:
    """Return the pairs of shapes, tool included, that are too close at `q` [rad]; with `itself` only those of the arm."""
    pairs = [pair.split(" and ") for pair in _scene(robot).collisions(q)]
    around = [box.name for box in boxes(robot)] if itself else []
    return [" and ".join(_TOOL.get(name, name) for name in pair) for pair in pairs if pair[-1] not in around]


@cache
def _scene(robot: Robot) -> CollisionScene:
    return CollisionScene(ArmKinematics(robot, Limits()), robot)


def advice(robot: Robot, *, itself: bool = False) -> str:
    """Return what to write where an arm touches itself or its surroundings at home."""
    if robot.arm == DEFAULT_ARM:
        return "move the base by hand"
    found = arm_of(robot)
    pairs = [(home, touching(home, robot, itself=itself)) for home in ready_postures(found)]
    if clear := [home for home, touched in pairs if not touched]:
        return f"write `home_rad: {clear[0].tolist()}`, which is clear, in the YAML file"
    if all(any("Palpate's" in pair for pair in touched) for _, touched in pairs):
        return f"no home_rad helps: {_FURTHER_OUT}"
    return home_advice(found)


def scan_targets(scenario: Scenario, spacing: float, border: float = 0.0, raised: float = 0.0) -> tuple[Array, Array]:
    """Return origins of the indenter [m] at `exam.depth_m` below the surface and outward normals, in world, shapes (n, 3).

    They lie in snake order on a grid of at most `spacing` over the examined region widened by `border`; `raised` lifts
    them along their normals. Normals are averaged over the indenter's footprint.
    """
    exam, model = scenario.exam, build_phantom(scenario.phantom, scenario.seed)
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


def clear_postures(robot: Robot, p: Array, n: Array, limits: Limits) -> tuple[PostureSequence, str]:
    """Return the postures planned from home at targets in world, those that touch as not reached, and what they touch."""
    home, margin, force = arm_of(robot).home_rad, limits.joint_margin_rad, limits.force_working_n
    found = plan_redundancy(robot, p, n, home, joint_margin_rad=margin, force_n=force)
    touched = [touching(q, robot) if reached else [] for q, reached in zip(found.q, found.reachable, strict=True)]
    clear = found.reachable & np.array([not pairs for pairs in touched], dtype=bool)
    named = "; ".join(sorted({pair for pairs in touched for pair in pairs}))
    change = "write another home_rad, or stand the base elsewhere"
    if "Palpate's" in named:
        change = f"{_FURTHER_OUT}, or {change}"
    text = f"{(found.reachable & ~clear).sum()} of {len(p)} postures touch: {named}: {change}" if named else ""
    return found._replace(reachable=clear), text


def check_clear(scenario: Scenario) -> None:
    """Raise UserError if an arm has no posture to look from, or touches something wherever it reaches 9 places of the region."""
    robot, arm, limits = scenario.robot, arm_of(scenario.robot), scenario.limits
    if not look_postures(exam_input(scenario)):
        pairs = "; ".join(touching(arm.home_rad, robot))
        raise UserError(f"robot.arm: {robot.arm}: no posture to look from is clear: at home {pairs} touch: {advice(robot)}")
    targets, margin = scan_targets(scenario, max(scenario.exam.region_m) / 2), limits.joint_margin_rad
    batch = Batch(robot, *targets, (arm.lower_rad + margin, arm.upper_rad - margin), limits.force_working_n)
    q = batch.from_one(arm.home_rad)
    if any(not touching(posture, robot) for posture in q[batch.check_reached(q)[1]]):
        return  # inverse kinematics from home takes a tenth of the time of the plan's
    postures, text = clear_postures(robot, *targets, limits)
    if text and not postures.reachable.any():
        raise UserError(f"robot.arm: {robot.arm}: {text}; or stand elsewhere: palpate arm place {robot.arm}")
