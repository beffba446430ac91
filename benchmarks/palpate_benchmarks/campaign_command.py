"""`palpate faults`: the fault campaign, its table, and docs/faults.md."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape

from palpate.console import EXIT_FAILED, CaseDisplay, output_file, refuse
from palpate.report.files import docs_option, write_part, write_text
from palpate_benchmarks.fault_kinds import KINDS

if TYPE_CHECKING:
    from palpate_benchmarks.campaign import FaultFinding

WIDE = 200

Listed = Annotated[list[str] | None, typer.Option("--only", help="Only these roles and topics; may be repeated.")]


def faults(  # noqa: PLR0913 - the options of a command
    mode: Annotated[list[str] | None, typer.Option(help="lockstep, wallclock; both by default.")] = None,
    kind: Annotated[list[str] | None, typer.Option(help=f"Out of {', '.join(KINDS)}; all by default.")] = None,
    only: Listed = None,
    out: Annotated[Path, output_file("File for the outcomes; cases in it are not run again.", "--out", "-o")] = Path(
        "faults.csv"
    ),
    docs: Annotated[Path | None, docs_option("faults")] = None,
    again: Annotated[bool, typer.Option("--again", help="Run again what is already in the file.")] = False,
    limit: Annotated[int | None, typer.Option(min=0, help="Run at most N cases.")] = None,
    random: Annotated[int, typer.Option(metavar="N", min=0, help="In addition, N random cases.")] = 0,
    seed: Annotated[int, typer.Option(min=0, help="For --random.")] = 0,
) -> None:
    """Inject faults (kill, freeze, delay, drop, corrupt...) into every service and topic in contact, and print the outcomes."""
    from palpate_benchmarks.campaign import cases, forks, run_case
    from palpate_benchmarks.campaign_tables import csv_text, markdown, table
    from palpate_benchmarks.whole_cases import drawn, fixed, is_whole, run_whole

    console = Console(stderr=True, width=max(WIDE, Console().width))
    wanted_modes, wanted_kinds = mode or ["lockstep", "wallclock"], kind or list(KINDS)
    for name, given, known in (("--mode", wanted_modes, ("lockstep", "wallclock")), ("--kind", wanted_kinds, KINDS)):
        for value in given:
            if value not in known:
                refuse(f"{name} {value}: allowed are {', '.join(known)}")
    found = _load(out)
    todo = [*fixed(wanted_modes, wanted_kinds, only or ()), *cases(wanted_modes, wanted_kinds, only or ())]
    todo += drawn(random, seed, wanted_modes)
    if not todo:
        refuse(f"nothing to do: {', '.join(only or ())} is no role or topic of these kinds")
    if not again:
        done = {(f.kind, f.where, f.mode, f.at_s) for f in found}
        modes = {True: "wall clock", False: "lockstep"}
        todo = [case for case in todo if (case.kind, case.where, modes[case.wallclock], case.at_s) not in done]
    todo = todo[:limit]
    started_by = forks()
    with tempfile.TemporaryDirectory(prefix="palpate-faults-") as folder, CaseDisplay(console, False, "faults") as display:
        display.show(0, len(todo), "")
        for number, case in enumerate(todo, 1):
            finding = run_whole(case, Path(folder)) if is_whole(case) else run_case(case, Path(folder), started_by)
            same = (finding.kind, finding.where, finding.mode, finding.at_s)
            found = [f for f in found if (f.kind, f.where, f.mode, f.at_s) != same] + [finding]
            write_text(out, csv_text(found))
            mark = "[green]ok[/]" if finding.good else "[bold red]bad[/]"
            display.show(number, len(todo), f"{mark} {case.name}: {escape(finding.sign or finding.ended)}")
    Console(width=max(WIDE, Console().width)).print(table(found))
    if docs is not None:
        write_part(docs, "faults", markdown(found))
    if any(not finding.good for finding in found):
        raise typer.Exit(EXIT_FAILED)


def _load(path: Path) -> list[FaultFinding]:
    from palpate_benchmarks.campaign_tables import from_csv

    if not path.exists():
        return []
    try:
        found = from_csv(path.read_text(encoding="utf-8"))
    except ValueError as error:
        refuse(f"--out {path}: holds no findings of this command: {error}")
    return [finding for finding in found if finding.injected_s is not None]  # those that never began are tried again
