"""The page docs/reproduction.md from finished runs: figures of the paper, and a comparison of the ways to cover."""

import json
import os
from collections.abc import Callable, Sequence
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from palpate.report.evidence import Evidence, read_evidence
from palpate.report.figures import INK, QUIET, Drawing, panel_title
from palpate.report.page import known_truth, read_report, sample_places
from palpate.report.page_figures import plain
from palpate.report.scoring import Truth
from palpate_bus.messages import ExamState
from palpate_dashboard.replay import recording_of
from palpate_models.numerics.frames import Array
from palpate_models.scenario.load import load_scenario
from palpate_reproduction.runs import GRAPH, SCENARIO, SNAKE, ReproductionCase, ReproductionError
from palpate_reproduction.scene import Moment, Stage, Viewpoint, deformation_mm, draw, moments
from palpate_validation import drop
from palpate_validation.check import write_figure

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


ROOM: Final = Viewpoint((1.60, -1.50, 1.95), (0.36, 0.02, 1.22), 40.0)
CLOSE: Final = Viewpoint((1.10, -0.62, 1.32), (0.54, -0.02, 0.96), 30.0)


def _blank(width: float, height: float) -> Figure:
    return Figure(figsize=(width, height), dpi=100, facecolor="white", layout="constrained")


_PLACES: Final = {
    "conductor": (0.0, 6.2), "recorder": (3.2, 6.2), "dashboard": (6.4, 6.2),
    "camera": (0.0, 4.4), "perception": (4.6, 4.4), "planning": (9.2, 4.4), "assessment": (13.4, 4.4),
    "supervisor": (12.4, 2.2), "tissue": (0.0, 0.0), "robot": (6.6, 0.0), "control": (13.4, 0.0),
}  # fmt: skip
"""Position of each node; other nodes are drawn in a row below."""
_BEND: Final = 0.13


def draw_graph(path: Path, rows: Sequence[dict[str, Any]], watching: Sequence[str]) -> tuple[int, int]:
    """Draw figure 5, nodes and topics of a live bus, without arrows of the `watching` nodes; return the number of both."""
    nodes = sorted({node for row in rows for node in (*row["publishers"], *row["subscribers"])})
    topics = [row for row in rows if not row["topic"].startswith("palpate/")]
    arrows: dict[tuple[str, str], list[str]] = {}
    for row in topics:
        for source, reader in product(row["publishers"][-1:], row["subscribers"]):
            if not {source, reader} & set(watching):
                arrows.setdefault((source, reader), []).append(row["topic"])
    beyond = [name for name in nodes if name not in _PLACES]
    places = _PLACES | {name: (3.2 * i, -1.6) for i, name in enumerate(beyond)}
    figure = _blank(13.0, 6.4)
    axes = figure.subplots()
    axes.set(xlim=(-1.2, 14.6), ylim=(-2.0 if beyond else -0.9, 6.6))
    axes.set_axis_off()
    patches = {}
    for name in nodes:
        x, y = places[name]
        color = "#e2e8f0" if name in watching else "#ccfbf1"
        patch = FancyBboxPatch((x - 0.85, y - 0.2), 1.7, 0.4, boxstyle="round,pad=0.08", fc=color, ec=INK, lw=1.0, zorder=3)
        axes.add_patch(patch)
        patches[name] = patch
        axes.text(x, y, f"/{name}", ha="center", va="center", fontsize=9.5, weight="bold", color=INK, zorder=4)
    for (source, target), names in arrows.items():
        a, b = np.array(places[source]), np.array(places[target])
        style = {"arrowstyle": "-|>", "color": "#64748b", "lw": 1.1, "connectionstyle": f"arc3,rad={_BEND}"}
        ends = {"patchA": patches[source], "patchB": patches[target], "shrinkA": 2, "shrinkB": 2}
        axes.annotate("", (b[0], b[1]), (a[0], a[1]), arrowprops={**style, **ends}, zorder=1)
        middle = (a + b) / 2 + np.array((b[1] - a[1], a[0] - b[0])) * _BEND / 2
        box = {"boxstyle": "round,pad=0.12", "fc": "white", "ec": "none", "alpha": 0.85}
        topic_list = "\n".join(sorted(names))
        axes.text(middle[0], middle[1], topic_list, fontsize=7.2, color=INK, ha="center", va="center", bbox=box, zorder=2.5)
    readers = ", ".join("/" + name for name in nodes if name in watching)
    axes.text(7.8, 6.2, f"{readers} read nearly\nall topics: their arrows are omitted", va="center", fontsize=9, color=QUIET)
    figure.savefig(path)
    return len(nodes), len(topics)


def draw_phases(path: Path, stage: Stage, shown: Sequence[tuple[str, Moment, bool]]) -> None:
    """Draw figure 6, the scene in the phases of an examination: (title, moment, True for a close view)."""
    figure = _blank(12.0, 2.9 * -(-len(shown) // 3))
    grid = figure.subplots(-(-len(shown) // 3), 3, squeeze=False).ravel()
    for axes in grid:
        axes.set_axis_off()
    for axes, (title, moment, close) in zip(grid, shown, strict=False):
        draw(axes, stage.bodies(moment), CLOSE if close else ROOM)
        axes.set_title(f"{title}, {moment.time_s:.1f} s", fontsize=9.5, color=INK)
    figure.savefig(path)


def draw_force_map(path: Path, evidence: Evidence, samples_xy: Array) -> None:
    """Draw figure 7, normal force over the surface, in the plane and in 3-D."""
    drawing = Drawing(evidence.collected.stiffness_map, evidence.collected.findings, None)
    layer = drawing.force_layer
    figure = _blank(10.5, 4.6)
    grid = figure.add_gridspec(1, 2)
    flat = figure.add_subplot(grid[0, 0])
    flat.plot(samples_xy[:, 0] * 1e3, samples_xy[:, 1] * 1e3, ".", ms=1.4, color="white", alpha=0.5)
    drawing.panel(flat, layer, "a", f"Normal force at {drawing.depth * 1e3:.0f} mm", f"{len(samples_xy)} samples (dots)")
    solid = figure.add_subplot(grid[0, 1], projection="3d")
    drawing.space(solid, drawing.force, layer, layer.label)
    panel_title(solid, "b", "The same in 3-D", "height and colour are force")
    figure.savefig(path)


def draw_correlation(path: Path, evidence: Evidence, truth: Truth | None) -> float:
    """Draw figure 8, the model with its stiff area and the map measured by palpation; return their correlation [1].

    The correlation is that of the logarithms of true and estimated apparent stiffness over the scanned surface.
    """
    drawing = Drawing(evidence.collected.stiffness_map, evidence.collected.findings, truth)
    if drawing.true is None:
        raise ValueError("the run has no truth to compare with")
    figure = _blank(10.5, 4.6)
    left, right = figure.subplots(1, 2)
    small = f"true apparent stiffness; {drawing.truth_legend}"
    drawing.panel(left, drawing.stiffness_layer(drawing.true), "a", "The model", small, truth=True)
    small = f"estimated apparent stiffness; {drawing.outlined}"
    drawing.panel(right, drawing.stiffness_layer(drawing.map.apparent), "b", "The palpation", small, labels=True)
    figure.savefig(path)
    known = drawing.map.scanned & np.isfinite(drawing.true)
    return float(np.corrcoef(np.log(drawing.true[known]), np.log(drawing.map.apparent[known]))[0, 1])


def draw_coverage(path: Path, names: Sequence[str], evidence: Sequence[Evidence]) -> None:
    """Draw the covered part of the region over simulated time since first contact, for each way to cover."""
    figure = _blank(7.5, 3.4)
    axes = figure.subplots()
    for name, record in zip(names, evidence, strict=True):
        states = record.states
        begin = states.time[np.argmax(states.in_contact)]
        axes.plot(states.time - begin, 100 * states.visited / max(record.target_count, 1), lw=1.6, label=name)
    plain(axes, "targets reached [%]", "simulated time since first contact [s]")
    axes.set_xlim(0, None)
    axes.legend(fontsize=8.5, frameon=False)
    figure.savefig(path)


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
    transients = drop.section()
    if transients.draw is not None:
        write_figure(transients.draw, images / "figure-3-transients.png", (9.0, 4.6))
    show("figure 5: the graph")
    rows = json.loads((runs / "bus" / GRAPH).read_text(encoding="utf-8"))
    nodes, topics = draw_graph(images / "figure-5-graph.png", rows, WATCHING)
    ways, evidence = zip(*(measure(case, runs / case.name) for case in cases), strict=True)
    show("figure 6: phases")
    chosen = choose_moments(evidence[0])
    recording = recording_of(folder)
    if not recording:
        raise ReproductionError(f"{folder}: no recording")
    rest, *seen = moments(recording, [min(0.2, chosen[0][1]), *(time for _, time, _ in chosen)])
    shown = [(title, moment, close) for (title, _, close), moment in zip(chosen, seen, strict=True)]
    draw_phases(images / "figure-6-phases.png", Stage(scenario, rest), shown)
    show("figures 7 and 8: maps")
    draw_force_map(images / "figure-7-force.png", evidence[0], sample_places(folder))
    correlation = draw_correlation(images / "figure-8-correlation.png", evidence[0], known_truth(scenario, evidence[0]))
    draw_coverage(images / "coverage.png", [way.name for way in ways], evidence)
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
