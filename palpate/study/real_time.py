"""real_time.md: delays of messages and ticks in wall-clock mode, and a comparison with the same examinations in lockstep."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from palpate.report.files import write_text
from palpate.report.rows import Report
from palpate.study.folder import Outcome

FILE: Final = "real_time.md"
FAST: Final = ("robot", "tissue", "control")
LEGS: Final = (("state to controller", "control", "joint_states"), ("command to robot", "robot", "control/joint_torque"))
"""Transfers of messages: name, receiving role, topic."""
PARTS: Final = ("p50", "p99", "max")

Named = Sequence[tuple[str, Report]]
"""Reports with their names in the tables."""


def write_real_time(folder: Path, outcomes: Sequence[Outcome]) -> None:
    """Write real_time.md into the folder of a study if it has examinations in wall-clock mode."""
    named = [(outcome.case.label, outcome.report) for outcome in outcomes if outcome.report is not None]
    clocked = [(name, report) for name, report in named if report.runtime == "wallclock" and report.failure is None]
    if clocked:
        machine = clocked[0][1].platform
        tables = (_latencies(clocked), _ticks(clocked), _comparison(named))
        write_text(folder / FILE, f"{machine['cpu']}, {machine['cores']} cores\n\n" + "\n".join(tables))


def _row(*cells: object) -> str:
    return f"| {' | '.join(str(cell) for cell in cells)} |\n"


def _latencies(reports: Named) -> str:
    """Return a table of the delay from a state to the command that results, by transfer.

    The delay of a transfer is the age of a message when it is read: transport, and waiting for the reader's next tick.
    """
    text = _row("examination", *(f"{what}: p50, p99, largest [ms]" for what, _, _ in LEGS), "mean step of control [ms]",
                "together: sum of p50, of p99, of largest [ms]")  # fmt: skip
    text += _row(*["---"] * 5)
    for name, report in reports:
        delays = [[report.services[role]["age_ms"][topic][part] for part in PARTS] for _, role, topic in LEGS]
        computing = report.blame["control"]["compute"] / 1e3
        sums = [sum(part) + computing for part in zip(*delays, strict=True)]
        text += _row(name, *map(_three, delays), f"{computing:.2f}", _three(sums))
    return text


def _three(figures: Sequence[float]) -> str:
    return ", ".join(f"{value:.2f}" for value in figures)


def _ticks(reports: Named) -> str:
    """Return a table of the ticks of the fast loop that were late by more than a period."""
    text = _row("examination", *(f"{role}: late ticks, times skipped ahead" for role in FAST)) + _row(*["---"] * (1 + len(FAST)))
    for name, report in reports:
        cells = []
        for role in FAST:
            counters, steps = report.services[role], report.blame[role]["steps"]
            late = counters["overruns"]
            cells.append(f"{late} of {steps} ({100 * late / max(steps, 1):.2f} %), {counters['skips']}")
        text += _row(name, *cells)
    return text


def _comparison(reports: Named) -> str:
    """Return a table of findings, forces, depths and durations."""
    text = _row("examination", "found, missed, false", "centre off [mm]", "Dice", "apparent stiffness", "largest force [N]",
                "depth RMS [mm]", "exam [s]", "wall [s]")  # fmt: skip
    text += _row(*["---"] * 9)
    for name, report in reports:
        scores = report.scores
        text += _row(
            name,
            "" if scores is None else f"{scores.matched}, {scores.missed}, {scores.false_findings}",
            "" if scores is None else _figure(scores.place_error_m, 1e3, ".1f"),
            "" if scores is None else _figure(scores.dice),
            ", ".join(f"{finding.ratio:.2f} x" for finding in report.findings),
            _figure(report.max_force_N),
            _figure(report.depth_rms_error_m, 1e3, ".3f"),
            f"{report.sim_time_s:.1f}",
            f"{report.wall_time_s:.1f}",
        )
    return text


def _figure(value: float | None, scale: float = 1.0, form: str = ".2f") -> str:
    return "" if value is None else format(scale * value, form)
