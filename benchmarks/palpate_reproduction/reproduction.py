"""docs/reproduction.md from finished runs: figures, comparison of the ways to cover, table of limits."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from palpate.report.archive import Evidence, read_evidence
from palpate.report.page import known_truth, read_report, sample_places
from palpate_bus.messages import ExamState
from palpate_dashboard.replay import recording_of
from palpate_models.scenario.load import load_scenario
from palpate_reproduction import figures
from palpate_reproduction.limits import limits
from palpate_reproduction.runs import GRAPH, SCENARIO, SNAKE, ReproductionCase, ReproductionError
from palpate_reproduction.scene import Moment, Stage, deformation_mm, moments

WATCHING = ("conductor", "dashboard", "recorder")


@dataclass(frozen=True)
class MeasuredWay:
    """One way to cover the region, measured."""

    name: str
    total_s: float
    """Simulated, from home to home."""
    covering_s: float
    """From first to last contact."""
    contact: float
    """Part of that in contact [1]."""
    findings: str
    dice: str


def way(case: ReproductionCase, folder: Path) -> tuple[MeasuredWay, Evidence]:
    """What a finished run says of its way to cover."""
    report, evidence = read_report(folder), read_evidence(folder)
    held = np.flatnonzero(evidence.in_contact)
    if not len(held):
        raise ReproductionError(f"{folder}: the tool never touched anything")
    first, last = held[0], held[-1]
    dice = "" if report.scores is None or report.scores.dice is None else f"{report.scores.dice:.2f}"
    found = ", ".join(f.quadrant for f in report.findings) or "none"
    return MeasuredWay(
        name=f"{case.pattern}, {case.mode}",
        total_s=report.sim_time_s,
        covering_s=float(evidence.time[last] - evidence.time[first]),
        contact=float(evidence.in_contact[first : last + 1].mean()),
        findings=found,
        dice=dice,
    ), evidence


def chosen_moments(evidence: Evidence) -> list[tuple[str, float, bool]]:
    """Words, time [s] and whether from close by, of the pictures of figure 6."""
    spans: dict[int, tuple[float, float]] = {}
    for phase, begin, end in evidence.phases():
        spans.setdefault(phase, (begin, end))
    wanted = [
        ("looking", ExamState.PHASE_LOOK, 0.9, False),
        ("approaching", ExamState.PHASE_APPROACH, 0.55, False),
        ("descending", ExamState.PHASE_INDENT, 0.9, True),
        ("scanning, begun", ExamState.PHASE_SCAN, 0.12, True),
        ("scanning, on the stiff area", ExamState.PHASE_SCAN, None, True),
        ("scanned, lifting", ExamState.PHASE_RETRACT, 0.8, False),
    ]
    chosen = []
    for words, phase, share, close in wanted:
        if phase not in spans:
            continue
        begin, end = spans[phase]
        time = float(evidence.time[np.argmax(evidence.force)]) if share is None else begin + share * (end - begin)
        chosen.append((words, time, close))
    return chosen


def write(
    runs: Path,
    cases: Sequence[ReproductionCase],
    page: Path,
    images: Path,
    settings: tuple[str, ...],
    tell: Callable[[str], None],
) -> dict[str, Any]:
    """Draws everything from the runs in `runs` and writes `page`; returns the figures it quotes.

    Raises ReproductionError, EvidenceError or OSError when a run lacks what is needed.
    """
    images.mkdir(parents=True, exist_ok=True)
    folder = runs / SNAKE.name
    report = read_report(folder)
    scenario = load_scenario(str(folder / "scenario.yaml"))
    tell("figure 3: transients")
    transients = figures.transients(images / "figure-3-transients.png")
    tell("figure 5: the graph")
    rows = json.loads((runs / "bus" / GRAPH).read_text(encoding="utf-8"))
    nodes, topics = figures.graph(images / "figure-5-graph.png", rows, WATCHING)
    ways, evidence = zip(*(way(case, runs / case.name) for case in cases), strict=True)
    tell("figure 6: phases")
    chosen = chosen_moments(evidence[0])
    recording = recording_of(folder)
    if not recording:
        raise ReproductionError(f"{folder}: it has no recording")
    rest, *seen = moments(recording, [min(0.2, chosen[0][1]), *(time for _, time, _ in chosen)])
    shown = [(words, moment, close) for (words, _, close), moment in zip(chosen, seen, strict=True)]
    figures.phases(images / "figure-6-phases.png", Stage(scenario, rest), shown)
    tell("figures 7 and 8: maps")
    figures.force_map(images / "figure-7-force.png", evidence[0], sample_places(folder))
    correlation = figures.correlation(images / "figure-8-correlation.png", evidence[0], known_truth(scenario, evidence[0]))
    figures.coverage(images / "coverage.png", [one.name for one in ways], evidence)
    inside, outside, ratio = _forces(evidence[0])
    factor = next(one.covering_s for one in ways if one.name == "raster, point") / ways[0].covering_s
    environment = Environment(
        loader=PackageLoader("palpate_reproduction"), undefined=StrictUndefined, keep_trailing_newline=True, trim_blocks=True
    )
    facts: dict[str, Any] = {
        "correlation": correlation,
        "nodes": nodes,
        "topics": topics,
        "factor": factor,
        "force_in": inside,
        "force_out": outside,
        "depth_m": scenario.exam.depth_m,
    }
    text = environment.get_template("reproduction.md.j2").render(
        **facts,
        scenario=SCENARIO,
        settings=settings,
        report=report,
        version=version("palpate"),
        images=Path(os.path.relpath(images, page.parent)).as_posix(),
        transients=transients,
        ways=ways,
        limits=limits(report, _pressed(rest, seen), ratio),
    )
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(text, encoding="utf-8")
    return {**facts, "ways": [vars(one) for one in ways], "run_hash": report.run_hash, "page": str(page)}


def _pressed(rest: Moment, seen: Sequence[Moment]) -> float:
    return max(deformation_mm(rest, moment) for moment in seen)


def _forces(evidence: Evidence) -> tuple[float, float, float]:
    """Median force at depth in the findings and outside of them [N], and the highest over the median apparent stiffness [1]."""
    message: Any = evidence.stiffness_map
    scanned, member = np.asarray(message.scanned, dtype=np.bool_), np.asarray(message.finding) >= 0
    force, apparent = np.asarray(message.force), np.asarray(message.apparent)[scanned]
    inside = force[scanned & member]
    outside = float(np.median(force[scanned & ~member]))
    return float(np.median(inside)) if len(inside) else float("nan"), outside, float(apparent.max() / np.median(apparent))
