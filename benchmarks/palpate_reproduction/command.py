"""`palpate reproduce`: figures and claims of the original paper from new runs, compared with the paper."""

from itertools import count
from pathlib import Path
from typing import Annotated

import typer

from palpate.console import CaseDisplay, SteadyConsole, fail, output_file, output_folder, print_line, refuse
from palpate.run.options import Settings


def reproduce(
    out: Annotated[Path, output_folder("Folder of the runs; finished ones are kept.", "--out", "-o")] = Path("out/reproduction"),
    docs: Annotated[Path | None, output_file("The page; by default reproduction.md in the folder of the runs.")] = None,
    every: Annotated[bool, typer.Option("--all", help="Also run raster continuous and snake point.")] = False,
    again: Annotated[bool, typer.Option("--again", help="Repeat finished runs.")] = False,
    settings: Settings = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print the page's path only.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Reproduce figures 3, 5, 6, 7 and 8 and the claims of the original paper from new runs. This takes about ten minutes."""
    from palpate.report.evidence import EvidenceError, read_completed
    from palpate.run.inputs import check_usable
    from palpate_reproduction.page import write_page
    from palpate_reproduction.runs import CASES, GRAPH, POINTS, SCENARIO, SNAKE, ReproductionError, perform, record_graph

    console = SteadyConsole(stderr=True)
    quiet = quiet or as_json
    cases = CASES if every else (SNAKE, POINTS)
    chosen = tuple(settings or ())
    page = docs or out / "reproduction.md"
    images = page.parent / "images" / "reproduction"
    check_usable(SCENARIO, chosen)
    begun, steps = count(), len(cases) + 5
    try:
        with CaseDisplay(console, quiet, "steps") as display:

            def show(step: str) -> None:
                display.show(next(begun), steps, step)

            for case in cases:
                if again or read_completed(out / case.name) is None:
                    show(f"examining: {case.pattern}, {case.mode}")
                    perform(case, out / case.name, chosen)
            if again or not (out / "bus" / GRAPH).is_file():
                show("starting a run on the bus, for its graph")
                record_graph(out / "bus")
            facts = write_page(out, cases, page, images, chosen, show)
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
            f"map and model have a correlation of {facts['correlation']:.3f}"
        )
    print(page)
