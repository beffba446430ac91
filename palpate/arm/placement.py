"""The place of an arm: where its base should stand.

The optimal pose of the base is its x, y, height and yaw, together with a posture for each of a grid of targets. They cover the
examined region of the abdomen and a border around it, in contact and raised along their normals, for approach and retreat, other
patients and registration errors.
"""

from itertools import accumulate
from operator import itemgetter
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from palpate.run.clearance import clear_postures, scan_targets
from palpate_errors import RunError
from palpate_models.numerics.frames import Array, Mask
from palpate_models.robot.arm import BASE_SIDE_M, TABLE, arm_of, link_transforms
from palpate_models.scenario.schema import Robot, Scenario
from palpate_planning.placement.redundancy import POSTURES, PostureSequence, arm, base_of, casadi, plan_redundancy, surface_frames


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


def best_placement(scenario: Scenario, spacing: float = 0.06, height_m: float | None = None) -> Robot:
    """Return the robot on the base placement with the lowest cost over the scenario's region.

    It is rounded to centimetres and hundredths of a radian. A placement counts whose targets inverse kinematics reaches and
    where no shapes touch, as in an examination. `height_m` is that of a base whose height cannot change. Raises RunError with the
    best attempt if there is none.
    """
    contact = scan_targets(scenario, spacing, PLACEMENT.border_m)
    raised = scan_targets(scenario, spacing, PLACEMENT.border_m, PLACEMENT.raised_m)
    positions, normals = (np.concatenate(pair) for pair in zip(contact, raised, strict=True))
    starts = [base_of(scenario.robot), *map(np.array, STARTS)]
    if height_m is not None:
        for start in starts:
            start[2] = height_m
    attempts = [_optimise(scenario.robot, positions, normals, start, height_m) for start in starts]
    tried = []
    converged = [pair for pair in attempts if pair[0] < np.inf]
    for _, robot in sorted(converged or attempts, key=itemgetter(0)):
        postures, touched = clear_postures(robot, positions, normals, scenario.limits)
        if converged and postures.reachable.all():
            return robot
        tried.append((robot, postures, touched))
    robot, postures, touched = max(tried, key=lambda one: one[1].reachable.sum())
    if converged and postures.reachable.any():
        return robot
    change = "The robot's base_xy_m, base_height_m and base_yaw_rad are tried first: give others, or a smaller exam.region_m"
    raise RunError(
        f"no base placement found, tried on {len(positions)} sampled targets; the best attempt is at "
        f"{describe(robot, postures)}. {touched or change}"
    )


def _optimise(robot: Robot, positions: Array, normals: Array, start: Array, height_m: float | None) -> tuple[float, Robot]:
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
    if height_m is not None:
        sides[0][2] = sides[1][2] = height_m
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
    base_found = np.round(np.array(result["x"])[:4, 0], 2)
    if height_m is not None:
        base_found[2] = height_m
    return float(result["f"]) if solver.stats()["success"] else np.inf, _standing(robot, base_found)


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


def draw_reach(path: Path, robot: Robot, positions: Array, reached: Mask) -> None:
    """Draw the arm at home and the targets in world [m], shape (n, 3), seen from above, and which are `reached`, shape (n,)."""
    figure = Figure(figsize=(6.5, 6.5), dpi=110, layout="constrained")
    axes = figure.add_subplot()
    width, length = TABLE.x_m[1] - TABLE.x_m[0], TABLE.y_m[1] - TABLE.y_m[0]
    axes.add_patch(Rectangle((TABLE.x_m[0], TABLE.y_m[0]), width, length, fill=False, color="#7a8c94", label="table"))
    corner = np.array(robot.base_xy_m) - BASE_SIDE_M / 2
    axes.add_patch(Rectangle((corner[0], corner[1]), BASE_SIDE_M, BASE_SIDE_M, color="#c9d1d4", label="base"))
    frames = accumulate((X for *_, X in link_transforms(arm_of(robot).home_rad, robot)), np.matmul)
    axes.plot(*np.array([X[:2, 3] for X in frames]).T, "o-", lw=4, alpha=0.6, color="#264653", label="links at home")
    for chosen, colour, label in ((reached, "#2a9d8f", "reached"), (np.logical_not(reached), "#d07000", "not reached")):
        if chosen.any():
            axes.plot(*positions[chosen, :2].T, "o", ms=4, color=colour, label=label)
    title = f"{robot.arm}: {reached.sum()} of {len(reached)} targets"
    axes.set(xlabel="x [m]", ylabel="y [m]", title=title, aspect="equal", ylim=(-0.6, 0.6))
    axes.legend()
    figure.savefig(path)
