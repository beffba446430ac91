"""`palpate swaps`: every swap examined, and the table of docs/swaps.md."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from palpate.command_line import fail, output_folder, refuse
from palpate.report.marked import doc_option, write_part
from palpate.run.inputs import usable
from palpate.run.processes import ProcessListError, compose_file
from palpate_benchmarks.swaps import measure, read_swaps, table


def swaps(
    scenario: Annotated[str, typer.Argument(help="The examination.")] = "clean",
    only: Annotated[list[str] | None, typer.Option(help="A swap; may be repeated. All by default.")] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="a.b=c", help="Overrides a field in every run; may be repeated.")
    ] = None,
    out: Annotated[Path, output_folder("Folder for the runs.")] = Path("out/swaps"),
    keep: Annotated[bool, typer.Option("--keep", help="Do not run again what is in the folder.")] = False,
    doc: Annotated[Path | None, doc_option("swaps")] = None,
) -> None:
    """Measure what each swap of `compose/` changes in the findings; print the table. A minute or two a swap."""
    console = Console(stderr=True)
    usable(scenario, settings)
    try:
        known = read_swaps(compose_file().parent / "compose")
        unknown = [name for name in only or () if name not in known]
        if unknown:
            raise ProcessListError(f"--only {', '.join(unknown)}: there are {', '.join(known)}")
        chosen = [known[name] for name in only or known]
        reports = measure(scenario, settings or (), chosen, out, keep, lambda name: console.print(f"examining: {name}"))
    except ProcessListError as error:
        refuse(error)
    except RuntimeError as error:
        fail(error)
    text = table(chosen, reports)
    typer.echo(text)
    if doc is not None:
        write_part(doc, "swaps", text)
