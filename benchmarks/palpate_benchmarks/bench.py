"""`palpate bench`: what the parts (the bus is one) and whole runs cost, as a table and as bench.json.

Machines differ and are noisy, so what counts are ratios within one call: simulated over wall time, our bus over raw zenoh, the
parts of a tick.
"""

from __future__ import annotations

import json
import platform
import tempfile
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from palpate.case_display import CaseDisplay
from palpate.report.files import write_text
from palpate.report.platforms import fingerprint
from palpate.run.composed import run_composed
from palpate.run.distributed import run_distributed
from palpate.run.placement import placement
from palpate.run.roles import OBSERVERS, workers
from palpate_conductor.result import RunResult
from palpate_models.scenario.schema import Scenario


def _figures(result: RunResult) -> dict[str, Any]:
    return {
        "sim_time_s": result.sim_time_s,
        "wall_time_s": result.wall_time_s,
        "real_time_factor": result.sim_time_s / max(result.wall_time_s, 1e-9),
        "command_to_first_tick_s": result.start_time_s,
        "run_hash": result.run_hash,
        "failure": result.failure,
        "blame": result.blame,
    }


PARTS = {
    "codec": "palpate_benchmarks.codec",
    "fmu": "palpate_benchmarks.fmu",
    "tissue": "palpate_benchmarks.tissue",
    "tissue, elastic": "palpate_benchmarks.elastic",
}
"""The modules that measure the parts; each has a function `measure()`."""


Save = Callable[[dict[str, Any]], None]


def _distributed(scenario: Scenario) -> dict[str, Callable[[Path], RunResult]]:
    """Runs of services on processes: one process each, and the loop at 1 kHz in one process; without observers and with them."""
    loop = ["robot,tissue,control"]

    def runs(observers: tuple[str, ...], together: Sequence[str]) -> Callable[[Path], RunResult]:
        groups = placement((*workers(scenario), *observers), together, None)
        return lambda out: run_distributed(scenario, out, lambda _: None, observers, groups=groups)

    return {
        "distributed": runs((), ()),
        "1 kHz loop in one process": runs((), loop),
        "distributed, recorder and viewer": runs(OBSERVERS, ()),
        "1 kHz loop in one process, recorder and viewer": runs(OBSERVERS, loop),
    }


def measure(scenario: Scenario, display: CaseDisplay, groups: Sequence[str], save: Save) -> dict[str, Any]:
    """The figures of some groups (see `bench_command.GROUPS`), by name.

    `save` gets what there is after each: an interrupted call leaves its part.
    """
    figures: dict[str, Any] = {"platform": fingerprint(), "parts": {}, "runs": {}}
    parts = PARTS if "parts" in groups else {}
    cases = {"composed": lambda out: run_composed(scenario, out, lambda _: None, ()), **_distributed(scenario)}
    names = list(cases) if "runs" in groups else []
    total = len(parts) + len(names)
    for done, (part, module) in enumerate(parts.items()):
        display.tell(done, total, f"{part}: cost of a step")
        figures["parts"][part] = import_module(module).measure()
        save(figures)
    for done, name in enumerate(names, len(parts)):
        display.tell(done, total, f"{scenario.name}, {name}")
        with tempfile.TemporaryDirectory(prefix="palpate-bench-") as folder:
            result = cases[name](Path(folder))
        if result.interrupted:
            raise KeyboardInterrupt
        figures["runs"][name] = _figures(result)
        save(figures)
    return figures


def tables(figures: dict[str, Any]) -> list[Table]:
    """The figures as tables."""
    runs = Table(
        "run",
        "sim [s]",
        "wall [s]",
        "real-time factor",
        "to first tick [s]",
        "run hash",
        title="Whole examinations",
        title_justify="left",
    )
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
    blame = Table("run", "service", *columns, "waits most for", title="Blame: mean wall time a step [us]", title_justify="left")
    for name, run in figures["runs"].items():
        for role, row in run["blame"].items():
            if row:
                most = next(iter(row["waited_for"]), "")
                blame.add_row(name, role, *(f"{row[column]:.0f}" for column in columns), most)
    small = Table("what", "figure", "value", title="Parts", title_justify="left")
    for group, values in figures["parts"].items():
        for figure, value in values.items():
            small.add_row(group, figure, f"{value:.4g}" if isinstance(value, int | float) else str(value))
    return [table for table in (runs, blame, small) if table.row_count]


def bench(scenario: Scenario, out: Path, console: Console, groups: Sequence[str], quiet: bool = False) -> None:
    """Measures, prints the tables and writes bench.json; shows on a terminal how far it is, unless `quiet`."""

    def save(figures: dict[str, Any]) -> None:
        write_text(out, json.dumps(figures, indent=2))

    screen = Console(stderr=True)
    with CaseDisplay(screen, quiet or not screen.is_terminal, "benchmarks") as display:
        figures = measure(scenario, display, groups, save)
    for table in tables(figures):
        console.print(table)
    console.print(f"{platform.platform()}, written to {out}", highlight=False)
