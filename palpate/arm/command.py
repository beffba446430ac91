"""`palpate arm`."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from palpate.run.options import DEFAULT_SCENARIO, Settings

if TYPE_CHECKING:
    from palpate_models.numerics.frames import Array
    from palpate_models.robot.chain import Arm
    from palpate_models.scenario.schema import Robot, Scenario
    from palpate_planning.motion.scene import CollisionScene

app = typer.Typer(name="arm", help="Check an arm, and find a place for its base.", no_args_is_help=True)
Name = Annotated[str, typer.Argument(help="Name of an arm, or a YAML file next to a URDF.")]


@app.command()
def check(arm: Name) -> None:
    """Say what an arm has, and what is missing or impossible, each with its link or joint. Starts nothing."""
    from rich.table import Table

    from palpate.console import SteadyConsole, say
    from palpate_errors import ExitStatus
    from palpate_models.robot.arm import check_arm

    found, faults = check_arm(arm)
    if found is not None and (pairs := _touching(arm, found.home_rad)):
        origin = f" ({sought})" if (sought := _sought(arm)) else ""
        faults = [f"home_rad: at {found.home_rad.tolist()}{origin} {'; '.join(pairs)} touch: {_advice(arm)}"]
        found = None
    for fault in faults:
        say(f"{arm}: {fault}")
    if found is None:
        raise typer.Exit(ExitStatus.BAD_INPUT)
    table = Table("joint", "range [rad]", "speed [rad/s]", "torque [N m]", "home [rad]", "link [kg]", box=None)
    limits = (found.lower_rad, found.upper_rad, found.velocity_radps, found.torque_nm, found.home_rad)
    for k, (name, low, high, speed, torque, home) in enumerate(zip(found.joint_names, *limits, strict=True)):
        mass = found.inertias[k + 1].mass
        table.add_row(name, f"{low:.2f} to {high:.2f}", f"{speed:.2f}", f"{torque:.0f}", f"{home:.2f}", f"{mass:.2f}")
    console = SteadyConsole()
    console.print(table)
    elbow, _ = found.elbow
    shapes = sum(map(len, found.capsules))
    mass = sum(inertia.mass for inertia in found.inertias[1:])
    parts = f"flange {found.link_names[-1]}, elbow {found.joint_names[elbow]}, {shapes} collision shapes"
    if sought := _sought(arm):
        console.print(f"home_rad: {found.home_rad.tolist()}  # {sought}: add this line to keep it, or change it", soft_wrap=True)
    if wrong := _turned(arm, found):
        console.print(wrong, soft_wrap=True)
    console.print(f"usable: {found.joints} joints, {mass:.1f} kg without its base, {parts}", soft_wrap=True)


@app.command()
def place(
    arm: Name,
    scenario: Annotated[str, typer.Argument(help="Scenario whose region is to be reached, by name or file.")] = DEFAULT_SCENARIO,
    out: Annotated[Path, typer.Option("--out", "-o", help="The picture, a PNG file.")] = Path("place.png"),
    settings: Settings = None,
) -> None:
    """Find where the base should stand to reach a scenario's region, and draw which targets it reaches."""
    import numpy as np

    from palpate.arm.placement import PLACEMENT, best_placement, describe, scan_targets
    from palpate.console import SteadyConsole, say
    from palpate.run.inputs import check_usable
    from palpate_models.robot.arm import arm_of
    from palpate_models.scenario.load import exam_input
    from palpate_planning.placement.redundancy import plan_redundancy
    from palpate_planning.strokes.plan import look_postures

    chosen = check_usable(scenario, [*(settings or ()), f"robot.arm={arm}"], None)
    console = SteadyConsole()
    with SteadyConsole(stderr=True).status("optimising: about a minute"):
        robot = best_placement(chosen)
        targets = [scan_targets(chosen, chosen.exam.spacing_m, raised=raised) for raised in (0.0, PLACEMENT.raised_m)]
        home = arm_of(robot).home_rad
        deep, raised = (plan_redundancy(robot, *pair, home) for pair in targets)
    console.print(f"pressed: {describe(robot, deep)}", soft_wrap=True)
    console.print(f"raised:  {describe(robot, raised)}", soft_wrap=True)
    x, y = robot.base_xy_m
    console.print(f"base_xy_m: [{x:g}, {y:g}]\nbase_height_m: {robot.base_height_m:g}")
    console.print(f"base_yaw_rad: {robot.base_yaw_rad:g}")
    _draw(out, chosen, targets[0][0], np.asarray(deep.reachable & raised.reachable), (x, y))
    touching = [pairs for q in deep.q[deep.reachable] if (pairs := _touching(arm, q))]
    if touching:
        named = "; ".join(sorted({pair for pairs in touching for pair in pairs}))
        advice = "write another home_rad, or as flange a link further out, in the YAML file"
        say(f"{arm}: {len(touching)} of {deep.reachable.sum()} postures touch: {named}: {advice}")
    at = chosen.model_copy(update={"robot": robot})
    if not look_postures(exam_input(at)):
        say(f"{arm}: home_rad: no posture to look from is free of collisions here: {_advice(arm, robot)}")
    console.print(f"drawn in {out}", soft_wrap=True)


def _sought(arm: str) -> str:
    """Return a text on a home posture that the arm's file does not have; empty if it has one."""
    from palpate_models.scenario.arm_file import DEFAULT_ARM, arm_file, arm_path

    missing = arm != DEFAULT_ARM and arm_file(arm).home_rad is None
    return f"sought, as {arm_path(arm).name} has none" if missing else ""


def _turned(arm: str, found: Arm) -> str:
    """Return what to write if the flange's z does not point out of the arm; empty if it does."""
    from palpate_models.robot.urdf_arm import flange_advice
    from palpate_models.scenario.arm_file import DEFAULT_ARM, arm_file, arm_path

    if arm == DEFAULT_ARM:
        return ""
    return flange_advice(found, arm_file(arm)).replace("the YAML file", arm_path(arm).name)


def _advice(arm: str, robot: Robot | None = None) -> str:
    """Return what to write where an arm touches itself at home, or the surroundings of `robot`."""
    from palpate_models.robot.arm import arm_of
    from palpate_models.robot.fitting import ready_postures
    from palpate_models.robot.urdf_arm import home_advice
    from palpate_models.scenario.arm_file import DEFAULT_ARM, arm_file, arm_path
    from palpate_models.scenario.schema import Robot

    found = arm_of(robot or Robot(arm=arm))
    if arm == DEFAULT_ARM:
        return "move the base by hand"
    if wrong := _turned(arm, found):
        return wrong
    for home in ready_postures(found):
        if not _touching(arm, home, robot):
            return f"write `home_rad: {home.tolist()}` in {arm_path(arm).name}, which is clear"
    return home_advice(found, arm_file(arm)).replace("the YAML file", arm_path(arm).name)


def _touching(arm: str, q: Array, at: Robot | None = None) -> list[str]:
    """Return the pairs of shapes of an arm, tool included, that are too close at `q` [rad], wherever its base stands.

    With `at`, also those of the arm and the table or base there.
    """
    from palpate_models.robot.table import boxes
    from palpate_models.scenario.schema import Robot

    robot = at or Robot(arm=arm)
    found = _scene(robot).collisions(q)
    return [pair for pair in found if at is not None or not any(pair.endswith(box.name) for box in boxes(robot))]


@cache
def _scene(robot: Robot) -> CollisionScene:
    from palpate_models.scenario.schema import Limits
    from palpate_planning.motion.kinematics import ArmKinematics
    from palpate_planning.motion.scene import CollisionScene

    return CollisionScene(ArmKinematics(robot, Limits()), robot)


def _draw(path: Path, scenario: Scenario, positions: Array, reached: Array, base_xy: tuple[float, float]) -> None:
    """Draw the targets in world [m], shape (n, 3), seen from above, and which are `reached`, shape (n,)."""
    import numpy as np
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    from palpate_models.robot.table import BASE_SIDE_M, TABLE

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
