"""`palpate fuzz`."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from palpate.console import EXIT_FAILED, CaseDisplay, refuse


def fuzz(
    names: Annotated[list[str] | None, typer.Argument(help="Targets or patterns, e.g. 'codec:*'; all by default.")] = None,
    inputs: Annotated[int, typer.Option(min=1, help="Total number of inputs.")] = 100_000,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same inputs.")] = 0,
) -> None:
    """Feed invalid bytes to everything that reads from the bus, and check that all are rejected."""
    from palpate.fuzz.fuzz import campaign, choose

    console = Console(stderr=True)
    try:
        chosen = choose(names or [])
    except ValueError as error:
        refuse(error)
    with CaseDisplay(console, False, "targets") as display:
        done = campaign(chosen, inputs, seed, display.show)
    for find in done.finds:
        console.print(f"[red]{find.target}[/] {escape(find.error)}\n  {find.data.hex()}", highlight=False, soft_wrap=True)
    rate = sum(done.inputs.values()) / done.seconds
    print(f"{sum(done.inputs.values())} inputs, {len(chosen)} targets, seed {seed}: {len(done.finds)} finds, {rate:.0f} inputs/s")
    raise typer.Exit(EXIT_FAILED if done.finds else 0)
