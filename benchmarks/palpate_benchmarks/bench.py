"""`palpate bench`: the cost of whole runs, as tables and as bench.json. Micro-benchmarks are in `asv/`.

Machines differ and are noisy; compare ratios within one call: simulated over wall time, and the parts of a tick.
"""

from __future__ import annotations

import json
import platform
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from palpate.console import CaseDisplay, SteadyConsole, output_file, wide_console
from palpate.run.options import DEFAULT_SCENARIO, Settings

if TYPE_CHECKING:
    from palpate_conductor.outcome import RunResult
    from palpate_models.scenario.schema import Scenario


def bench(
    scenario: Annotated[str, typer.Argument(help="The examination to time.")] = DEFAULT_SCENARIO,
    out: Annotated[Path, output_file("Output file.", "--out", "-o")] = Path("bench.json"),
    settings: Settings = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print the tables only.")] = False,
) -> None:
    """Measure the speed of whole runs; print tables and write bench.json."""
    from palpate.report.files import fingerprint, write_text
    from palpate.run.inputs import check_usable

    screen, console = SteadyConsole(stderr=True), wide_console(160)
    cases = run_cases(check_usable(scenario, settings))
    figures: dict[str, Any] = {"platform": fingerprint(), "runs": {}}
    try:
        with CaseDisplay(screen, quiet or not screen.is_terminal, "benchmarks") as display:
            for done, (name, case) in enumerate(cases.items()):
                display.show(done, len(cases), name)
                figures["runs"][name] = case()
                write_text(out, json.dumps(figures, indent=2))
    finally:  # an error or Ctrl-C keeps what was measured
        for table in tables(figures):
            console.print(table)
        if figures["runs"]:
            console.print(f"{platform.platform()}, written to {out}")


def run_cases(scenario: Scenario) -> dict[str, Callable[[], dict[str, Any]]]:
    """Return a function for each way to run the scenario: composed or distributed, by processes and observers."""
    from palpate.run.composed import run_composed
    from palpate.run.distributed import run_distributed
    from palpate.run.group import placement
    from palpate.run.roles import OBSERVERS, workers

    loop = ["robot,tissue,control"]

    def distributed(observers: tuple[str, ...], together: Sequence[str]) -> Callable[[], dict[str, Any]]:
        groups = placement((*workers(scenario), *observers), together, None)
        return lambda: _run_figures(lambda out: run_distributed(scenario, out, lambda _: None, observers, groups=groups))

    return {
        "composed": lambda: _run_figures(lambda out: run_composed(scenario, out, lambda _: None, ())),
        "distributed": distributed((), ()),
        "1 kHz loop in one process": distributed((), loop),
        "distributed, recorder and viewer": distributed(OBSERVERS, ()),
        "1 kHz loop in one process, recorder and viewer": distributed(OBSERVERS, loop),
    }


def _run_figures(run: Callable[[Path], RunResult]) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="palpate-bench-") as folder:
        result = run(Path(folder))
    if result.interrupted:
        raise KeyboardInterrupt
    return {
        "sim_time_s": result.sim_time_s,
        "wall_time_s": result.wall_time_s,
        "real_time_factor": result.sim_time_s / max(result.wall_time_s, 1e-9),
        "command_to_first_tick_s": result.start_time_s,
        "run_hash": result.run_hash,
        "failure": None if result.failure is None else result.failure.text,
        "blame": result.blame,
    }


def tables(figures: dict[str, Any]) -> list[Table]:
    """Return the figures as tables."""
    columns = ("run", "sim [s]", "wall [s]", "real-time factor", "to first tick [s]", "run hash")
    runs = Table(*columns, title="Whole examinations", title_justify="left")
    for name, run in figures["runs"].items():
        runs.add_row(
            name,
            f"{run['sim_time_s']:.1f}",
            f"{run['wall_time_s']:.1f}",
            f"{run['real_time_factor']:.2f}",
            f"{run['command_to_first_tick_s']:.1f}",
            (run["run_hash"] or run["failure"] or "")[:12],
        )
    columns = ("compute", "decode", "encode", "send", "transport", "wait")
    blame = Table("run", "service", *columns, "waits most for", title="Mean wall time of a step [us]", title_justify="left")
    for name, run in figures["runs"].items():
        for role, row in run["blame"].items():
            if row:
                longest = next(iter(row["waited_for"]), "")
                blame.add_row(name, role, *(f"{row[column]:.0f}" for column in columns), longest)
    return [table for table in (runs, blame) if table.row_count]
