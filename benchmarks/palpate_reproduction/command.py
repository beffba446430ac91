"""`palpate reproduce`: the seed paper's figures and claims from runs of our own, next to what the paper reports."""

from __future__ import annotations

from itertools import count
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from palpate.console import CaseDisplay, fail, output_file, output_folder, print_line, refuse
from palpate.run.options import Settings


def reproduce(
    out: Annotated[Path, output_folder("Folder of the runs; finished ones are kept.", "--out", "-o")] = Path("out/reproduction"),
    docs: Annotated[Path | None, output_file("The page; by default reproduction.md in the folder of the runs.")] = None,
    every: Annotated[
        bool, typer.Option("--all", help="Also run raster continuous and snake point, to see the gain of each.")
    ] = False,
    again: Annotated[bool, typer.Option("--again", help="Run finished ones again.")] = False,
    settings: Settings = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print the page's path only.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Reproduce the seed paper: figures 3, 5, 6, 7, 8 and what it claims, from our own runs. This takes about ten minutes."""
    from palpate.report.archive import EvidenceError, completed
    from palpate.run.inputs import usable
    from palpate_reproduction import reproduction
    from palpate_reproduction.runs import CASES, GRAPH, POINTS, SCENARIO, SNAKE, ReproductionError, perform, record_graph

    console = Console(stderr=True)
    quiet = quiet or as_json
    cases = CASES if every else (SNAKE, POINTS)
    chosen = tuple(settings or ())
    page = docs or out / "reproduction.md"
    images = page.parent / "images" / "reproduction"
    usable(SCENARIO, chosen)
    begun, steps = count(), len(cases) + 5
    try:
        with CaseDisplay(console, quiet, "steps") as display:

            def tell(words: str) -> None:
                display.show(next(begun), steps, words)

            for case in cases:
                if again or completed(out / case.name) is None:
                    tell(f"examining: {case.pattern}, {case.mode}")
                    perform(case, out / case.name, chosen)
            if again or not (out / "bus" / GRAPH).is_file():
                tell("starting a run on the bus, for its graph")
                record_graph(out / "bus")
            facts = reproduction.write(out, cases, page, images, chosen, tell)
    except (ReproductionError, EvidenceError) as error:
        fail(error)
    except OSError as error:
        refuse(error)
    if as_json:
        print_line(facts)
        return
    if not quiet:
        console.print(
            f"snake with continuous indentation covers {facts['factor']:.1f} times faster than raster with points; "
            f"map and model correlate with {facts['correlation']:.3f}",
            highlight=False,
        )
    print(page)
