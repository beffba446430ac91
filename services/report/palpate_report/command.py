"""`palpate reproduce`: the seed paper's figures and claims from runs of our own, next to what the paper reports."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from palpate_conductor.archive import EvidenceError, completed
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from palpate_report import reproduction
from palpate_report.runs import CASES, GRAPH, POINTS, SNAKE, RunError, perform, record_graph

EXIT_BAD_INPUT = 2
EXIT_FAILED = 3


def _fail(console: Console, status: int, message: str) -> NoReturn:
    console.print(f"[bold red]palpate:[/] {message}", highlight=False, soft_wrap=True)
    raise typer.Exit(status)


class _Steps:
    """A bar over the steps on a terminal, a line a step otherwise, nothing when quiet."""

    def __init__(self, console: Console, quiet: bool, total: int) -> None:
        self._console, self._quiet = console, quiet
        self._bar = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=quiet or not console.is_terminal,
        )
        self._task = self._bar.add_task("", total=total)
        self._begun = -1

    @property
    def bar(self) -> Progress:
        """To be entered."""
        return self._bar

    def tell(self, words: str) -> None:
        """A step begins."""
        self._begun += 1
        self._bar.update(self._task, description=words, completed=self._begun)
        if not self._quiet and not self._console.is_terminal:
            self._console.print(words, highlight=False)


def reproduce(
    out: Annotated[Path, typer.Option(help="Folder of the runs; finished ones are used again.")] = Path("out/reproduction"),
    docs: Annotated[Path | None, typer.Option(help="The page; by default reproduction.md in the folder of the runs.")] = None,
    every: Annotated[bool, typer.Option("--all", help="Also raster continuous and snake point, to see what each gains.")] = False,
    again: Annotated[bool, typer.Option("--again", help="Run what is finished again.")] = False,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="a.b=c", help="Overrides a field in all runs; may be repeated.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print the page's path only.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Reproduce the seed paper: figures 3, 5, 6, 7, 8 and what it claims, from our own runs. Takes some ten minutes."""
    console = Console(stderr=True)
    quiet = quiet or as_json
    cases = CASES if every else (SNAKE, POINTS)
    chosen = tuple(settings or ())
    page = docs or out / "reproduction.md"
    images = page.parent / "images" / "reproduction"
    steps = _Steps(console, quiet, len(cases) + 5)
    try:
        with steps.bar if not quiet else nullcontext():
            for case in cases:
                if again or completed(out / case.name) is None:
                    steps.tell(f"examining: {case.pattern}, {case.mode}")
                    perform(case, out / case.name, chosen)
            if again or not (out / "bus" / GRAPH).is_file():
                steps.tell("starting a run on the bus, for its graph")
                record_graph(out / "bus")
            facts = reproduction.write(out, cases, page, images, chosen, steps.tell)
    except (RunError, EvidenceError) as error:
        _fail(console, EXIT_FAILED, str(error))
    except OSError as error:
        _fail(console, EXIT_BAD_INPUT, str(error))
    if as_json:
        print(json.dumps(facts))
        return
    if not quiet:
        console.print(
            f"snake with continuous indentation covers {facts['factor']:.1f} times faster than raster with points; "
            f"map and model correlate with {facts['correlation']:.3f}",
            highlight=False,
        )
    print(page)
