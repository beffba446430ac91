"""`palpate wallclock`: the examination in real time, its latencies, and whether it found what simulated time finds."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from palpate_conductor.swaps import read_report

FAST = ("robot", "tissue", "control")
LEGS = (("state to controller", "control", "joint_states"), ("command to robot", "robot", "control/joint_torque"),
        ("state to tissue", "tissue", "sim/tool_state"), ("contact force to robot", "robot", "sim/contact_wrench"))  # fmt: skip
"""Ways of a message: what it is, who looks at it, topic."""


def _run(scenario: str, settings: list[str], folder: Path, *options: str) -> dict[str, Any]:
    words = [word for setting in settings for word in ("--set", setting)]
    command = [sys.executable, "-m", "palpate_conductor", "run", scenario, "--quiet", "--no-record", "--out", str(folder)]
    done = subprocess.run([*command, *options, *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(options)}: status {done.returncode}\n{done.stderr}")
    return read_report(folder)


def _row(*cells: object) -> str:
    return f"| {' | '.join(str(cell) for cell in cells)} |\n"


def latencies(report: dict[str, Any]) -> str:
    """A Markdown table of how old messages were when they were looked at, transport and the reader's own tick included."""
    text = _row("way", "p50 [ms]", "p99 [ms]", "largest [ms]") + _row(*["---"] * 4)
    sums = [0.0, 0.0, 0.0]
    for what, role, topic in LEGS:
        age = report["services"][role]["age_ms"][topic]
        figures = [age["p50"], age["p99"], age["max"]]
        text += _row(what, *(f"{value:.2f}" for value in figures))
        if topic in ("joint_states", "control/joint_torque"):
            sums = [total + value for total, value in zip(sums, figures, strict=True)]
    computing = report["blame"]["control"]["compute"] / 1e3
    sums = [total + computing for total in sums]
    return text + _row("state to command acted on (both, and the controller's mean step)", *(f"{value:.2f}" for value in sums))


def ticks(report: dict[str, Any]) -> str:
    """A Markdown table of ticks that came late in the fast loop."""
    text = _row("role", "ticks", "late by more than a period", "clock set anew", "mean step [ms]") + _row(*["---"] * 5)
    for role in FAST:
        counters, blame = report["services"][role], report["blame"][role]
        late = f"{counters['overruns']} ({100 * counters['overruns'] / max(blame['steps'], 1):.2f} %)"
        text += _row(role, blame["steps"], late, counters["resyncs"], f"{blame['compute'] / 1e3:.2f}")
    return text


def comparison(reports: dict[str, dict[str, Any]]) -> str:
    """A Markdown table of what was found, and how hard and how deep it pressed, one row a runtime."""
    text = _row("runtime", "found, missed, false", "centre off [mm]", "Dice", "stiffness", "largest force [N]",
                "depth RMS [mm]", "exam [s]", "wall [s]")  # fmt: skip
    text += _row(*["---"] * 9)
    for name, report in reports.items():
        scores = report["scores"]
        text += _row(
            name,
            f"{scores['matched']}, {scores['missed']}, {scores['false_positives']}",
            "" if scores["localisation_error_m"] is None else f"{1e3 * scores['localisation_error_m']:.1f}",
            "" if scores["dice"] is None else f"{scores['dice']:.2f}",
            ", ".join(f"{finding['stiffness_ratio']:.2f} x" for finding in report["findings"]),
            f"{report['max_force_N']:.2f}",
            f"{1e3 * report['depth_rms_error_m']:.3f}",
            f"{report['sim_time_s']:.1f}",
            f"{report['wall_time_s']:.1f}",
        )
    return text


def wallclock(
    scenario: Annotated[str, typer.Argument(help="The examination.")] = "rlq_guarding",
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="a.b=c", help="Overrides a field; may be repeated.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the two runs; by default they are thrown away.")] = None,
) -> None:
    """Measure an examination in real time: ages of states and commands, late ticks, and its findings beside those in lockstep."""
    console = Console(stderr=True)
    with tempfile.TemporaryDirectory(prefix="palpate-wallclock-") as scratch:
        folder = out or Path(scratch)
        before = os.getloadavg()[0]
        try:
            console.print("in real time")
            real = _run(scenario, settings or [], folder / "wallclock", "--wallclock")
            console.print("in lockstep")
            lockstep = _run(scenario, settings or [], folder / "lockstep", "--composed")
        except RuntimeError as error:
            console.print(f"[bold red]palpate:[/] {error}", highlight=False, soft_wrap=True)
            raise typer.Exit(3) from error
    machine = real["platform"]
    typer.echo(f"{machine['cpu']}, {machine['cores']} cores, load before the run {before:.1f}\n")
    typer.echo(latencies(real))
    typer.echo(ticks(real))
    typer.echo(comparison({"wall clock": real, "lockstep": lockstep}))
