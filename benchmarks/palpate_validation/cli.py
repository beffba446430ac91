"""`palpate validate`: validation of the physics against independent references."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from palpate.console import CaseDisplay, SteadyConsole, output_folder, refuse, wide_console
from palpate_errors import ExitStatus

if TYPE_CHECKING:
    from palpate_validation.check import PageSection

SECTIONS = (
    "hertz", "elastic", "mesh", "people", "population", "buried", "guarding", "relaxation", "energy", "breathing", "drop",
)  # fmt: skip
"""Sections in the order of the report."""
MODULES = {"elastic": "hertz", "mesh": "meshes"}
"""Module that measures a section, if it has another name."""

app = typer.Typer(name="validate", help="Measure the physics against independent references.", invoke_without_command=True)


def run_section(name: str) -> PageSection:
    """Measure a section by name."""
    module = importlib.import_module(f"palpate_validation.{MODULES.get(name, name)}")
    section: PageSection = module.elastic_section() if name == "elastic" else module.section()
    return section


@app.callback()
def validate(
    out: Annotated[Path, output_folder("Folder for validate.json and the plots.", "--out", "-o")] = Path("out/validation"),
    only: Annotated[list[str] | None, typer.Option("--only", metavar="SECTION", help=f"One of: {', '.join(SECTIONS)}.")] = None,
) -> None:
    """Measure the physics against Hertz, measured people, DART and theory. The exit status is 3 if a bound is missed."""
    from palpate_validation.check import failures, table, write

    console = SteadyConsole(stderr=True)
    unknown = [name for name in only or () if name not in SECTIONS]
    if unknown:
        refuse(f"--only {unknown[0]}: sections are {', '.join(SECTIONS)}")
    sections = []
    wanted = [name for name in SECTIONS if not only or name in only]
    with CaseDisplay(console, False, "sections") as display:
        for number, name in enumerate(wanted):
            display.show(number, len(wanted), f"measuring {name}")
            sections.append(run_section(name))
            write(sections, out)  # an error or Ctrl-C in a later section keeps these
    wide_console(150).print(table(sections))
    console.print(f"plots and figures in {out}")
    missed = failures(sections)
    if missed:
        console.print(f"{len(missed)} outside their bounds: {'; '.join(c.name for c in missed)}", style="bold red")
        raise typer.Exit(ExitStatus.FAILED)
