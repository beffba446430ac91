"""`palpate bench`: the cost of the parts and of whole runs, as tables and as bench.json.

Machines differ and are noisy; compare ratios within one call: simulated over wall time, and the parts of a tick.
"""

from __future__ import annotations

import json
import platform
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from palpate.console import CaseDisplay, output_file
from palpate.run.options import DEFAULT_SCENARIO, Settings

if TYPE_CHECKING:
    from palpate_conductor.outcome import RunResult
    from palpate_models.scenario.schema import Scenario

GROUPS = ("parts", "runs")
WIDTH = 160
"""Least width of the tables [characters], also where the output is not a terminal."""


def bench(
    scenario: Annotated[str, typer.Argument(help="The examination to time.")] = DEFAULT_SCENARIO,
    out: Annotated[Path, output_file("Output file.", "--out", "-o")] = Path("bench.json"),
    only: Annotated[list[str] | None, typer.Option(help=f"One of {', '.join(GROUPS)}; may be repeated. All by default.")] = None,
    settings: Settings = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print the tables only.")] = False,
) -> None:
    """Measure the speed of the parts and of whole runs; print tables and write bench.json."""
    for group in only or ():
        if group not in GROUPS:
            raise typer.BadParameter(f"--only {group}: must be one of {', '.join(GROUPS)}")
    from palpate.report.files import fingerprint
    from palpate.run.inputs import usable

    screen, console = Console(stderr=True), Console(width=max(WIDTH, Console().width))
    chosen = usable(scenario, settings)
    figures: dict[str, Any] = {"platform": fingerprint(), "parts": {}, "runs": {}}
    try:
        with CaseDisplay(screen, quiet or not screen.is_terminal, "benchmarks") as display:
            measure(chosen, display, only or GROUPS, out, figures)
    finally:  # an error or Ctrl-C keeps what was measured
        for table in tables(figures):
            console.print(table)
        if out.is_file():
            console.print(f"{platform.platform()}, written to {out}", highlight=False)


def measure(scenario: Scenario, display: CaseDisplay, groups: Sequence[str], out: Path, figures: dict[str, Any]) -> None:
    """Measure the cases of the chosen groups into `figures`; write `out` after each."""
    from palpate.report.files import write_text

    cases: list[tuple[str, str, Callable[[], dict[str, Any]]]] = []
    if "parts" in groups:
        cases += [("parts", name, part) for name, part in PARTS.items()]
    if "runs" in groups:
        cases += [("runs", name, run) for name, run in run_cases(scenario).items()]
    for done, (group, name, case) in enumerate(cases):
        display.show(done, len(cases), name)
        figures[group][name] = case()
        write_text(out, json.dumps(figures, indent=2))


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


def codec_cost(repeats: int = 2000) -> dict[str, float]:
    """Return the median time to encode and to decode a joint state [us]."""
    from palpate_bus.messages import JointState, codec
    from palpate_bus.messages.stamps import header

    kind, values = "sensor_msgs/msg/JointState", np.arange(7.0)
    message = JointState(header(1), [f"joint_{i}" for i in range(1, 8)], values, values, values)
    encode, decode = codec.encoder(kind), codec.decoder(kind)
    payload = encode(message)
    return {
        "encode_us": _median_us(lambda _: encode(message), repeats),
        "decode_us": _median_us(lambda _: decode(payload), repeats),
    }


def tissue_cost(tier: str, steps: int = 2000) -> dict[str, float]:
    """Return the median cost of a step [us] of a tissue tier, `surface` or `elastic`.

    The indenter, 15 mm in radius, slides over the default abdomen at 30 mm/s and 10 mm depth.
    """
    from palpate_models.patient.phantom import build_phantom
    from palpate_models.patient.schema import Phantom
    from palpate_tissue.backend import TissueBackend
    from palpate_tissue.backends.elastic.compliance import compliance
    from palpate_tissue.backends.elastic.tissue import ElasticTissue
    from palpate_tissue.backends.winkler.tissue import WinklerTissue
    from palpate_tissue.surface import SkinSurface

    radius_m, depth_m, velocity, phantom = 0.015, 0.010, np.array((0.03, 0.0, 0.0)), Phantom()
    model = build_phantom(phantom, seed=0)
    surface = SkinSurface(model)
    body: TissueBackend = (
        WinklerTissue(model, phantom.stiffness)
        if tier == "surface"
        else ElasticTissue(model, compliance(model, ()), phantom.stiffness)
    )
    under = [surface.nearest(np.array((-0.03, 0.01, 0.0)) + velocity * body.dt * k) for k in range(steps)]
    path = [place.position + (radius_m - depth_m) * place.normal for place in under]
    cost = _median_us(lambda k: body.step(k * body.dt, path[k], velocity, radius_m, np.zeros(3)), steps)
    return {"vertices": len(model.vertices), "contacts": len(body.contacts), "step_us": cost}


def _median_us(call: Callable[[int], object], repeats: int) -> float:
    costs = np.empty(repeats)
    for k in range(repeats):
        begin = time.perf_counter_ns()
        call(k)
        costs[k] = time.perf_counter_ns() - begin
    return float(np.median(costs)) / 1e3


PARTS: dict[str, Callable[[], dict[str, Any]]] = {
    "codec": codec_cost,
    "tissue": lambda: tissue_cost("surface"),
    "tissue, elastic": lambda: tissue_cost("elastic"),
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
                most = next(iter(row["waited_for"]), "")
                blame.add_row(name, role, *(f"{row[column]:.0f}" for column in columns), most)
    parts = Table("part", "figure", "value", title="Parts", title_justify="left")
    for group, values in figures["parts"].items():
        for figure, value in values.items():
            parts.add_row(group, figure, f"{value:.4g}")
    return [table for table in (runs, blame, parts) if table.row_count]
