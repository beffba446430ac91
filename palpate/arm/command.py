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
    from palpate.console import say, table, wide_console
    from palpate.run.clearance import advice, touching
    from palpate_errors import ExitStatus
    from palpate_models.robot.arm import check_arm
    from palpate_models.robot.urdf_arm import ignored_limits
    from palpate_models.scenario.load import exam_input, load_scenario
    from palpate_models.scenario.schema import DEFAULT_ARM, arm_file
    from palpate_planning.strokes.plan import look_postures

    found, faults = check_arm(arm)
    given = None if arm == DEFAULT_ARM else arm_file(arm)
    origin = "" if given is None or given.home_rad else "sought, as the YAML file has none"
    scenario = load_scenario(DEFAULT_SCENARIO, [f"robot.arm={arm}"])
    moves = given is not None and "base_xy_m" not in given.model_fields_set  # its base has no place yet
    if found is not None and (pairs := touching(found.home_rad, scenario.robot, itself=moves)):
        at = f"{found.home_rad.tolist()}{origin and f' ({origin})'}"
        found, faults = None, [f"home_rad: at {at} {'; '.join(pairs)} touch: {advice(scenario.robot, itself=moves)}"]
    for fault in faults:
        say(f"{arm}: {fault}")
    if found is None:
        raise typer.Exit(ExitStatus.BAD_INPUT)
    rows = table("joint", "range [rad]", "speed [rad/s]", "torque [N m]", "home [rad]", "link [kg]")
    limits = (found.lower_rad, found.upper_rad, found.velocity_radps, found.torque_nm, found.home_rad)
    masses = [inertia.mass for inertia in found.inertias[1:]]
    for name, low, high, speed, torque, home, mass in zip(found.joint_names, *limits, masses, strict=True):
        rows.add_row(name, f"{low:.2f} to {high:.2f}", f"{speed:.2f}", f"{torque:.0f}", f"{home:.2f}", f"{mass:.2f}")
    console = wide_console()
    console.print(rows)
    elbow, shapes = found.joint_names[found.elbow[0]], sum(map(len, found.capsules))
    parts = f"flange {found.link_names[-1]}, elbow {elbow}, {shapes} collision shapes"
    if origin:
        console.print(f"home_rad: {found.home_rad.tolist()}  # {origin}: add this line to keep it, or change it", soft_wrap=True)
    if given is not None and given.lower_rad is None:
        for name in filter(ignored_limits(arm).__contains__, found.joint_names):
            text = "is continuous, so its limits of position in the URDF have no effect: write lower_rad and upper_rad for others"
            console.print(f"{name}: {text}", soft_wrap=True)
    if not moves and not look_postures(exam_input(scenario), hidden=False):
        console.print("at home, and turned, the arm may hide the region from the camera: try another home_rad", soft_wrap=True)
    console.print(f"usable: {found.joints} joints, {sum(masses):.1f} kg without its base, {parts}", soft_wrap=True)


@app.command()
def place(
    arm: Name,
    scenario: Annotated[str, typer.Argument(help="Scenario whose region is to be reached, by name or file.")] = DEFAULT_SCENARIO,
    out: Annotated[Path, typer.Option("--out", "-o", help="The picture, a PNG file.")] = Path("place.png"),
    height: Annotated[float | None, typer.Option("--height", help="Height of the base to keep, in m.", min=0.3, max=1.4)] = None,
    settings: Settings = None,
) -> None:
    """Find where the base should stand to reach a scenario's region, and draw which targets it reaches."""
    from palpate.arm.placement import PLACEMENT, best_placement, describe, draw_reach
    from palpate.console import SteadyConsole, say
    from palpate.run.clearance import advice, clear_postures, scan_targets
    from palpate.run.inputs import check_usable
    from palpate_errors import RunError
    from palpate_models.scenario.load import exam_input
    from palpate_planning.strokes.plan import look_postures

    chosen = check_usable(scenario, [*(settings or ()), f"robot.arm={arm}"], None, elsewhere=True)
    console = SteadyConsole()
    with SteadyConsole(stderr=True).status("optimising: about a minute"):
        robot = best_placement(chosen, height_m=height)
        targets = [scan_targets(chosen, chosen.exam.spacing_m, raised=raised) for raised in (0.0, PLACEMENT.raised_m)]
        (deep, touched), (raised, _) = (clear_postures(robot, *pair, chosen.limits) for pair in targets)
    console.print(f"pressed: {describe(robot, deep)}", soft_wrap=True)
    console.print(f"raised:  {describe(robot, raised)}", soft_wrap=True)
    if not deep.reachable.any():
        raise RunError(f"{arm}: this is the best base found, and it reaches no target. {touched}")
    x, y = robot.base_xy_m
    console.print(f"base_xy_m: [{x:g}, {y:g}]\nbase_height_m: {robot.base_height_m:g}")
    console.print(f"base_yaw_rad: {robot.base_yaw_rad:g}")
    draw_reach(out, robot, targets[0][0], deep.reachable & raised.reachable)
    if touched:
        say(f"{arm}: {touched}")
    if not look_postures(exam_input(chosen.model_copy(update={"robot": robot}))):
        say(f"{arm}: home_rad: no posture to look from is free of collisions here: {advice(robot)}")
    console.print(f"drawn in {out}", soft_wrap=True)
