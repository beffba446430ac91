"""`palpate arm`."""

from pathlib import Path
from typing import Annotated

import typer

from palpate.run.options import DEFAULT_SCENARIO, Settings

app = typer.Typer(name="arm", help="Check an arm, and find a place for its base.", no_args_is_help=True)
Name = Annotated[str, typer.Argument(help="Name of an arm, or a YAML file next to a URDF.")]


@app.command()
def check(arm: Name) -> None:
    """Say what an arm has, and what is missing or impossible, each with its link or joint. Starts nothing."""
    from rich.table import Table

    from palpate.arm.placement import advice, flange_note, home_origin, touching
    from palpate.console import SteadyConsole, say
    from palpate_errors import ExitStatus
    from palpate_models.robot.arm import check_arm

    found, faults = check_arm(arm)
    if found is not None and (pairs := touching(arm, found.home_rad)):
        origin = f" ({sought})" if (sought := home_origin(arm)) else ""
        faults = [f"home_rad: at {found.home_rad.tolist()}{origin} {'; '.join(pairs)} touch: {advice(arm)}"]
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
    if sought := home_origin(arm):
        console.print(f"home_rad: {found.home_rad.tolist()}  # {sought}: add this line to keep it, or change it", soft_wrap=True)
    if wrong := flange_note(arm, found):
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

    from palpate.arm.placement import PLACEMENT, advice, best_placement, describe, draw_reach, scan_targets, touching
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
    draw_reach(out, chosen, targets[0][0], np.asarray(deep.reachable & raised.reachable), (x, y))
    if touched := [pairs for q in deep.q[deep.reachable] if (pairs := touching(arm, q))]:
        named = "; ".join(sorted({pair for pairs in touched for pair in pairs}))
        change = "write another home_rad, or as flange a link further out, in the YAML file"
        say(f"{arm}: {len(touched)} of {deep.reachable.sum()} postures touch: {named}: {change}")
    at = chosen.model_copy(update={"robot": robot})
    if not look_postures(exam_input(at)):
        say(f"{arm}: home_rad: no posture to look from is free of collisions here: {advice(arm, robot)}")
    console.print(f"drawn in {out}", soft_wrap=True)
