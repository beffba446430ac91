"""The page docs/reproduction.md from finished runs: figures, comparison of the ways to cover, and the paper's limits."""

import json
import os
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from palpate.report.archive import Evidence, read_evidence
from palpate.report.page import known_truth, read_report, sample_places
from palpate_bus.messages import ExamState
from palpate_dashboard.replay import recording_of
from palpate_models.scenario.load import load_scenario
from palpate_reproduction import figures
from palpate_reproduction.runs import GRAPH, SCENARIO, SNAKE, ReproductionCase, ReproductionError
from palpate_reproduction.scene import Stage, deformation_mm, moments

WATCHING = ("conductor", "dashboard", "recorder")


class MeasuredWay(NamedTuple):
    """One way to cover the region, measured."""

    name: str
    total_s: float
    """Simulated time from home to home."""
    covering_s: float
    """Simulated time from first to last contact."""
    contact: float
    """Fraction of `covering_s` in contact [1]."""
    findings: str
    dice: str


def measure(case: ReproductionCase, folder: Path) -> tuple[MeasuredWay, Evidence]:
    """Return the figures and the evidence of a finished run. Raises ReproductionError if there was no contact."""
    report, evidence = read_report(folder), read_evidence(folder)
    states = evidence.states
    held = np.flatnonzero(states.in_contact)
    if not len(held):
        raise ReproductionError(f"{folder}: the tool was never in contact")
    first, last = held[0], held[-1]
    dice = "" if report.scores is None or report.scores.dice is None else f"{report.scores.dice:.2f}"
    found = ", ".join(f.quadrant for f in report.findings) or "none"
    return MeasuredWay(
        name=f"{case.pattern}, {case.mode}",
        total_s=report.sim_time_s,
        covering_s=float(states.time[last] - states.time[first]),
        contact=float(states.in_contact[first : last + 1].mean()),
        findings=found,
        dice=dice,
    ), evidence


def choose_moments(evidence: Evidence) -> list[tuple[str, float, bool]]:
    """Return title, time [s] and viewpoint (True: close) of the pictures of figure 6."""
    spans: dict[int, tuple[float, float]] = {}
    for phase, begin, end in evidence.phases():
        spans.setdefault(phase, (begin, end))
    wanted = [
        ("camera burst", ExamState.PHASE_LOOK, 0.9, False),
        ("approaching", ExamState.PHASE_APPROACH, 0.55, False),
        ("descending", ExamState.PHASE_INDENT, 0.9, True),
        ("scanning, start", ExamState.PHASE_SCAN, 0.12, True),
        ("scanning, on the stiff area", ExamState.PHASE_SCAN, None, True),
        ("scan complete, lifting", ExamState.PHASE_RETRACT, 0.8, False),
    ]
    chosen = []
    for title, phase, share, close in wanted:
        if phase not in spans:
            continue
        begin, end = spans[phase]
        time = float(evidence.states.time[np.argmax(evidence.states.force)]) if share is None else begin + share * (end - begin)
        chosen.append((title, time, close))
    return chosen


def write_page(
    runs: Path,
    cases: Sequence[ReproductionCase],
    page: Path,
    images: Path,
    settings: tuple[str, ...],
    show: Callable[[str], None],
) -> dict[str, Any]:
    """Draw the figures from the runs in `runs` and write `page`; return its numbers. `show` displays each step.

    Raises ReproductionError, EvidenceError or OSError if a run is incomplete.
    """
    images.mkdir(parents=True, exist_ok=True)
    folder = runs / SNAKE.name
    report = read_report(folder)
    scenario = load_scenario(str(folder / "scenario.yaml"))
    show("figure 3: transients")
    transients = figures.transients(images / "figure-3-transients.png")
    show("figure 5: the graph")
    rows = json.loads((runs / "bus" / GRAPH).read_text(encoding="utf-8"))
    nodes, topics = figures.graph(images / "figure-5-graph.png", rows, WATCHING)
    ways, evidence = zip(*(measure(case, runs / case.name) for case in cases), strict=True)
    show("figure 6: phases")
    chosen = choose_moments(evidence[0])
    recording = recording_of(folder)
    if not recording:
        raise ReproductionError(f"{folder}: no recording")
    rest, *seen = moments(recording, [min(0.2, chosen[0][1]), *(time for _, time, _ in chosen)])
    shown = [(title, moment, close) for (title, _, close), moment in zip(chosen, seen, strict=True)]
    figures.phases(images / "figure-6-phases.png", Stage(scenario, rest), shown)
    show("figures 7 and 8: maps")
    figures.force_map(images / "figure-7-force.png", evidence[0], sample_places(folder))
    correlation = figures.correlation(images / "figure-8-correlation.png", evidence[0], known_truth(scenario, evidence[0]))
    figures.coverage(images / "coverage.png", [way.name for way in ways], evidence)
    inside, outside, ratio = _forces(evidence[0])
    factor = next(way.covering_s for way in ways if way.name == "raster, point") / ways[0].covering_s
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
        deformation=max(deformation_mm(rest, moment) for moment in seen),
        peak_ratio=ratio,
    )
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(text, encoding="utf-8")
    return {**facts, "ways": [way._asdict() for way in ways], "run_hash": report.run_hash, "page": str(page)}


def _forces(evidence: Evidence) -> tuple[float, float, float]:
    """Return the median force at depth in and outside findings [N], and the largest over median apparent stiffness [1]."""
    message: Any = evidence.collected.stiffness_map
    scanned, member = np.asarray(message.scanned, dtype=np.bool_), np.asarray(message.finding) >= 0
    force, apparent = np.asarray(message.force), np.asarray(message.apparent)[scanned]
    inside = force[scanned & member]
    outside = float(np.median(force[scanned & ~member]))
    return float(np.median(inside)) if len(inside) else float("nan"), outside, float(apparent.max() / np.median(apparent))
