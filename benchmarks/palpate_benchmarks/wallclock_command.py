"""`palpate wallclock`: the examination in real time, its latencies, and whether it found what simulated time finds."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from palpate.command_line import fail, output_folder
from palpate.report.archive import read_figures
from palpate.report.marked import doc_option, write_part
from palpate.run.inputs import Settings, usable
from palpate_bus.settings import Settings as BusSettings

FAST = ("robot", "tissue", "control")
LEGS = (("state to controller", "control", "joint_states"), ("command to robot", "robot", "control/joint_torque"))
"""Ways of a message: what it is, who looks at it, topic."""
PARTS = ("p50", "p99", "max")


def _run(scenario: str, settings: list[str], folder: Path, rate: int, *options: str) -> dict[str, Any]:
    """The report of a run with the controller at `rate` [Hz]. Raises RuntimeError when it did not complete."""
    words = [word for setting in settings for word in ("--set", setting)]
    command = [sys.executable, "-m", "palpate", "run", scenario, "--quiet", "--no-record", "--out", str(folder)]
    environment = {**os.environ, **BusSettings.read().replaced(periods={"control": 1000 // rate}).to_env()}
    done = subprocess.run([*command, *options, *words], capture_output=True, text=True, check=False, env=environment)
    if done.returncode:
        raise RuntimeError(f"{rate} Hz {' '.join(options)}: status {done.returncode}\n{done.stderr}")
    report = read_figures(folder)
    planning = report["services"]["planning"]["facts"]
    if planning["phase"] != "DONE":
        raise RuntimeError(f"{rate} Hz {' '.join(options)}: {planning['message']} (load {os.getloadavg()[0]:.1f})")
    return report


def _row(*cells: object) -> str:
    return f"| {' | '.join(str(cell) for cell in cells)} |\n"


def latencies(reports: Mapping[int, dict[str, Any]]) -> str:
    """A Markdown table, one row a rate [Hz]: from a state to the command that acts, and how much of that is which way.

    A way is a message's age when its reader takes it up: transport, and waiting for the reader's next tick.
    """
    text = _row("control rate", *(f"{what}: p50, p99, largest [ms]" for what, _, _ in LEGS), "mean step of control [ms]",
                "together: sum of p50, of p99, of largest [ms]")  # fmt: skip
    text += _row(*["---"] * 5)
    for rate, report in reports.items():
        ways = [[report["services"][role]["age_ms"][topic][part] for part in PARTS] for _, role, topic in LEGS]
        computing = report["blame"]["control"]["compute"] / 1e3
        sums = [sum(part) + computing for part in zip(*ways, strict=True)]
        text += _row(f"{rate} Hz", *map(_three, ways), f"{computing:.2f}", _three(sums))
    return text


def _three(figures: Sequence[float]) -> str:
    return ", ".join(f"{value:.2f}" for value in figures)


def ticks(reports: Mapping[int, dict[str, Any]]) -> str:
    """A Markdown table of ticks that came late by more than a period in the fast loop, one row a rate [Hz]."""
    text = _row("control rate", *(f"{role}: late ticks, times skipped ahead" for role in FAST)) + _row(*["---"] * (1 + len(FAST)))
    for rate, report in reports.items():
        cells = []
        for role in FAST:
            counters, steps = report["services"][role], report["blame"][role]["steps"]
            late = counters["overruns"]
            cells.append(f"{late} of {steps} ({100 * late / max(steps, 1):.2f} %), {counters['skips']}")
        text += _row(f"{rate} Hz", *cells)
    return text


def comparison(reports: Mapping[str, dict[str, Any]]) -> str:
    """A Markdown table of what was found, and how hard and how deep it pressed, one row a runtime."""
    text = _row("runtime", "found, missed, false", "centre off [mm]", "Dice", "apparent stiffness", "largest force [N]",
                "depth RMS [mm]", "exam [s]", "wall [s]")  # fmt: skip
    text += _row(*["---"] * 9)
    for name, report in reports.items():
        scores = report["scores"]
        text += _row(
            name,
            f"{scores['matched']}, {scores['missed']}, {scores['false_findings']}",
            "" if scores["place_error_m"] is None else f"{1e3 * scores['place_error_m']:.1f}",
            "" if scores["dice"] is None else f"{scores['dice']:.2f}",
            ", ".join(f"{finding['ratio']:.2f} x" for finding in report["findings"]),
            f"{report['max_force_N']:.2f}",
            f"{1e3 * report['depth_rms_error_m']:.3f}",
            f"{report['sim_time_s']:.1f}",
            f"{report['wall_time_s']:.1f}",
        )
    return text


def wallclock(
    scenario: Annotated[str, typer.Argument(help="The examination.")] = "clean",
    rate: Annotated[list[int] | None, typer.Option(help="Of the controller [Hz]; may be repeated. 200, 500 and 1000.")] = None,
    settings: Settings = None,
    out: Annotated[Path | None, output_folder("Folder for the runs; by default they are thrown away.")] = None,
    doc: Annotated[Path | None, doc_option("wallclock")] = None,
) -> None:
    """Measure an examination in real time: age of states and commands, late ticks, and its findings beside lockstep's."""
    console = Console(stderr=True)
    rates = rate or [200, 500, 1000]
    if wrong := [value for value in rates if value < 1 or 1000 % value]:
        raise typer.BadParameter(f"--rate {wrong[0]}: a period must be a whole number of milliseconds")
    usable(scenario, settings)
    real, found = {}, {}
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory(prefix="palpate-wallclock-") as scratch:
        folder = out or Path(scratch)
        try:
            for value in rates:
                console.print(f"{value} Hz, in real time")
                real[value] = _run(scenario, settings or [], folder / f"wallclock_{value}", value, "--wallclock")
                found[f"wall clock, {value} Hz"] = real[value]
            for value in rates:
                console.print(f"{value} Hz, in lockstep")
                found[f"lockstep, {value} Hz"] = _run(scenario, settings or [], folder / f"lockstep_{value}", value, "--composed")
        except RuntimeError as error:
            fail(error)
    machine = real[rates[0]]["platform"]
    text = f"{machine['cpu']}, {machine['cores']} cores, load before the first run {load:.1f}\n\n"
    text += "\n".join((latencies(real), ticks(real), comparison(found)))
    typer.echo(text)
    if doc is not None:
        write_part(doc, "wallclock", text)
