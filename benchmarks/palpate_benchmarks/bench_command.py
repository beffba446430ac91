"""`palpate bench`: how fast."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from palpate.console import output_file
from palpate.run.options import DEFAULT_SCENARIO, Settings

GROUPS = ("parts", "runs")
"""What can be measured."""
WIDE = 160
"""Columns of the wide tables, where the terminal has fewer or there is none."""


def bench(
    scenario: Annotated[str, typer.Argument(help="The examination to time.")] = DEFAULT_SCENARIO,
    out: Annotated[Path, output_file("Output file.", "--out", "-o")] = Path("bench.json"),
    only: Annotated[list[str] | None, typer.Option(help=f"One of {', '.join(GROUPS)}; may be repeated. All by default.")] = None,
    settings: Settings = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print the tables only.")] = False,
) -> None:
    """Measure the speed of the parts, the bus and whole runs; print tables and write bench.json."""
    for group in only or ():
        if group not in GROUPS:
            raise typer.BadParameter(f"--only {group}: must be one of {', '.join(GROUPS)}")
    from palpate.run.inputs import usable
    from palpate_benchmarks.bench import bench as run_bench

    run_bench(usable(scenario, settings), out, Console(width=max(WIDE, Console().width)), only or GROUPS, quiet)
