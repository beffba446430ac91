"""`palpate faults`: runs the fault campaign and shows its results; `make docs` makes docs/fault-tables.md from its CSV files."""

import tempfile
from collections.abc import Sequence
from hashlib import sha256
from itertools import chain
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from palpate.console import CaseDisplay, SteadyConsole, output_file, refuse, wide_console
from palpate.report.files import write_text
from palpate.run.options import Settings
from palpate_benchmarks.fault_cases import KINDS, LIE, CaseResult, csv_text, from_csv, in_order
from palpate_errors import ExitStatus

MODES = ("lockstep", "wallclock")
COLUMNS = ("mode", "fault", "target", "after", "first sign", "arm", "force", "end")


def faults(  # noqa: PLR0913 - the options of a command
    context: typer.Context,
    mode: Annotated[list[str] | None, typer.Option(help=f"{', '.join(MODES)}; both by default.")] = None,
    kind: Annotated[list[str] | None, typer.Option(help=f"One of {', '.join(KINDS)}; all but {LIE} by default.")] = None,
    only: Annotated[list[str] | None, typer.Option("--only", help="Only these roles and topics; may be repeated.")] = None,
    out: Annotated[Path, output_file("File for the results; cases in it by the present code are skipped.", "--out", "-o")] = Path(
        "faults.csv"
    ),
    again: Annotated[bool, typer.Option("--again", help="Repeat cases that are in the file.")] = False,
    limit: Annotated[int | None, typer.Option(min=0, help="Run at most N cases.")] = None,
    random: Annotated[int, typer.Option(metavar="N", min=0, help="In addition, N random cases.")] = 0,
    seed: Annotated[int, typer.Option(min=0, help="For --random.")] = 0,
    settings: Settings = None,
) -> None:
    """Inject faults (kill, freeze, delay, drop, corrupt...) into every service and topic in contact, and print the results.

    `--kind lie`: services that send wrong values.
    """
    from palpate.run.folder import lock_output
    from palpate.study.folder import code_digest
    from palpate_benchmarks import lies
    from palpate_benchmarks.campaign import cases, draw_cases, run_case
    from palpate_benchmarks.injection import examination

    console = SteadyConsole(stderr=True, width=wide_console(200).width)
    modes, kinds = mode or MODES, kind or [name for name in KINDS if name != LIE]
    for name, given, known in (("--mode", modes, MODES), ("--kind", kinds, KINDS)):
        for value in given:
            if value not in known:
                refuse(f"{name} {value}: allowed are {', '.join(known)}")
    context.with_resource(lock_output(out))
    found = _load(out)
    todo = list(cases(modes, kinds, only or ()))
    if LIE in kinds:
        todo += [*lies.cases(modes, only or ()), *lies.draw_lies(random, seed, modes)]
    else:
        todo += draw_cases(random, seed, modes)
    todo = list(dict.fromkeys(todo))
    if not todo:
        refuse(f"--only {', '.join(only or ())}: no role or topic of this name has a fault of these kinds")
    changed = tuple(settings or ())
    examination(changed)  # a setting that does not fit ends the command here
    code = sha256("\n".join((code_digest(), *changed)).encode()).hexdigest()[:8]
    done = {result.identity: result.code for result in found if result.injected_s is not None}
    if not again:
        todo = [case for case in todo if done.get(case.result().identity) != code]
    todo = sorted(todo, key=lambda case: case.result().identity in done)[:limit]
    with tempfile.TemporaryDirectory(prefix="palpate-faults-") as folder, CaseDisplay(console, False, "faults") as display:
        display.show(0, len(todo), "")
        results = (run_case(case, Path(folder), changed) for case in todo if case.kind != LIE)
        lying = [case for case in todo if case.kind == LIE]
        lied = lies.run_lies(lying, Path(folder), changed) if lying else ()
        for number, result in enumerate(chain(results, lied), 1):
            result.code = code
            found = [f for f in found if f.identity != result.identity] + [result]
            write_text(out, csv_text(found))
            display.show(number, len(todo), f"{'ok' if result.passed else 'bad'} {result.target}: {result.sign or result.ended}")
    wide_console(200).print(table(found))
    if any(not result.passed for result in found):
        raise typer.Exit(ExitStatus.FAILED)


def _load(path: Path) -> list[CaseResult]:
    """Return the results in a file."""
    if not path.exists():
        return []
    try:
        return from_csv(path.read_text(encoding="utf-8"))
    except ValueError as error:
        refuse(f"--out {path}: holds no results of this command: {error}")


def table(results: Sequence[CaseResult]) -> Table:
    """Return the table for a terminal, one row per case."""
    shown = Table(*COLUMNS, box=None)
    for result in in_order(results):
        shown.add_row(*_row(result), style=None if result.passed else "bold red")
    return shown


def _row(result: CaseResult) -> tuple[str, ...]:
    after = "" if result.detected_ms is None else f"{result.detected_ms:.0f} ms"
    peak = "not measured" if result.peak_force_n is None else f"{result.peak_force_n:.1f} N"
    force = f"{result.peak_force_before_n:.1f}, {peak}"
    return (result.mode, result.kind, result.target, after, result.sign, result.reaction, force, result.ended)
