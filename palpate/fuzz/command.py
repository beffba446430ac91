"""`palpate fuzz`."""

from typing import Annotated

import typer

from palpate.console import EXIT_FAILED, CaseDisplay, SteadyConsole, refuse, table, wide_console


def fuzz(
    names: Annotated[list[str] | None, typer.Argument(help="Targets or patterns, e.g. 'codec:*'; all by default.")] = None,
    inputs: Annotated[int, typer.Option(min=1, help="Greatest number of inputs of each target.")] = 100_000,
    seconds: Annotated[float, typer.Option(min=1, help="Greatest processor time of each target, in seconds.")] = 3600.0,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same inputs.")] = 0,
) -> None:
    """Feed invalid bytes to everything that reads from the bus or from files, and check that all are refused."""
    from palpate.fuzz.fuzz import FuzzPlan, campaign, choose

    console = SteadyConsole(stderr=True)
    try:
        chosen = choose(names or [])
    except ValueError as error:
        refuse(error)
    with CaseDisplay(console, False, "targets") as display:
        done = campaign(chosen, FuzzPlan(inputs, seed, seconds), display.show)
    for find in done.finds:
        console.print(f"{find.target} {find.error}\n  {find.data.hex()}", highlight=False, soft_wrap=True)
    figures = table("target", ">inputs", ">refused", ">finds", ">processor s", ">peak MB")
    for name, result in done.targets.items():
        rest = (result.inputs, result.refused, result.found, round(result.seconds), result.peak_mb)
        figures.add_row(name, *map(str, rest))
    wide_console().print(figures)
    total = sum(result.inputs for result in done.targets.values())
    print(f"{total} inputs, {len(chosen)} targets, seed {seed}: {len(done.finds)} kinds of finds, {done.seconds:.0f} s")
    raise typer.Exit(EXIT_FAILED if done.finds else 0)
