"""Figures of docs/reproduction.md: 3, 5, 6, 7 and 8 of the paper, from our runs. Each function writes one PNG."""

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from numpy.typing import NDArray
from PIL import Image

from palpate.report.archive import Evidence
from palpate.report.figures import INK, QUIET, Drawing, colour_bar, panel_title
from palpate.report.scoring import Truth
from palpate_reproduction.scene import Moment, Stage, Viewpoint, draw
from palpate_validation import drop
from palpate_validation.check import PageSection

COLOURS: Final = 192
"""Size of the colour palette, which keeps the files small."""
ROOM: Final = Viewpoint((1.60, -1.50, 1.95), (0.36, 0.02, 1.22), 40.0)
CLOSE: Final = Viewpoint((1.10, -0.62, 1.32), (0.54, -0.02, 0.96), 30.0)


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    figure.set_layout_engine("constrained", w_pad=0.06, h_pad=0.06)
    return figure


def _save(figure: Figure, path: Path) -> None:
    """Write a PNG with a colour palette."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.canvas.draw()
    canvas: Any = figure.canvas
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])
    image.quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)


def transients(path: Path) -> PageSection:
    """Draw figure 3, a tool dropped on soft and rigid surfaces; return the measurements."""
    section = drop.section()
    figure = _figure(9.0, 4.6)
    if section.draw is not None:
        section.draw(figure)
    _save(figure, path)
    return section


_PLACES: Final = {
    "conductor": (0.0, 6.2), "recorder": (3.2, 6.2), "dashboard": (6.4, 6.2),
    "camera": (0.0, 4.4), "perception": (4.6, 4.4), "planning": (9.2, 4.4), "assessment": (13.4, 4.4),
    "supervisor": (12.4, 2.2), "tissue": (0.0, 0.0), "robot": (6.6, 0.0), "control": (13.4, 0.0),
}  # fmt: skip
"""Position of each node; other nodes are drawn in a row below."""
_BEND: Final = 0.13


def graph(path: Path, rows: Sequence[dict[str, Any]], watching: Sequence[str]) -> tuple[int, int]:
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
    figure = _figure(13.0, 6.4)
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
    _save(figure, path)
    return len(nodes), len(topics)


def phases(path: Path, stage: Stage, shown: Sequence[tuple[str, Moment, bool]]) -> None:
    """Draw figure 6, the scene in the phases of an examination: (title, moment, True for a close view)."""
    figure = _figure(12.0, 2.9 * -(-len(shown) // 3))
    grid = figure.subplots(-(-len(shown) // 3), 3, squeeze=False).ravel()
    for axes in grid:
        axes.set_axis_off()
    for axes, (title, moment, close) in zip(grid, shown, strict=False):
        draw(axes, stage.bodies(moment), CLOSE if close else ROOM)
        axes.set_title(f"{title}, {moment.time_s:.1f} s", fontsize=9.5, color=INK)
    _save(figure, path)


def force_map(path: Path, evidence: Evidence, samples_xy: NDArray[np.float64]) -> None:
    """Draw figure 7, normal force over the surface, in the plane and in 3-D."""
    drawing = Drawing(evidence.collected.stiffness_map, evidence.collected.findings, None)
    layer = drawing.force_layer
    figure = _figure(10.5, 4.6)
    grid = figure.add_gridspec(1, 2)
    flat = figure.add_subplot(grid[0, 0])
    image = drawing.plane(flat, layer)
    flat.plot(samples_xy[:, 0] * 1e3, samples_xy[:, 1] * 1e3, ".", ms=1.4, color="white", alpha=0.5)
    panel_title(flat, "a", f"Normal force at {drawing.depth * 1e3:.0f} mm", f"{len(samples_xy)} samples (dots)")
    colour_bar(image, flat, layer.label)
    solid = figure.add_subplot(grid[0, 1], projection="3d")
    drawing.space(solid, drawing.force, layer, layer.label)
    panel_title(solid, "b", "The same in 3-D", "height and colour are force")
    _save(figure, path)


def correlation(path: Path, evidence: Evidence, truth: Truth | None) -> float:
    """Draw figure 8, the model with its stiff area and the map measured by palpation; return their correlation [1].

    The correlation is that of the logarithms of true and estimated apparent stiffness over the scanned surface.
    """
    drawing = Drawing(evidence.collected.stiffness_map, evidence.collected.findings, truth)
    if drawing.true is None:
        raise ValueError("the run has no truth to compare with")
    figure = _figure(10.5, 4.6)
    left, right = figure.subplots(1, 2)
    small = f"true apparent stiffness; {drawing.truth_legend}"
    drawing.panel(left, drawing.stiffness_layer(drawing.true), "a", "The model", small, truth=True)
    small = f"estimated apparent stiffness; {drawing.outlined}"
    drawing.panel(right, drawing.stiffness_layer(drawing.map.apparent), "b", "The palpation", small, labels=True)
    _save(figure, path)
    known = drawing.map.scanned & np.isfinite(drawing.true)
    return float(np.corrcoef(np.log(drawing.true[known]), np.log(drawing.map.apparent[known]))[0, 1])


def coverage(path: Path, names: Sequence[str], evidence: Sequence[Evidence]) -> None:
    """Draw the covered part of the region over simulated time since first contact, for each way to cover."""
    figure = _figure(7.5, 3.4)
    axes = figure.subplots()
    for name, record in zip(names, evidence, strict=True):
        states = record.states
        begin = states.time[np.argmax(states.in_contact)]
        axes.plot(states.time - begin, 100 * states.visited / max(record.target_count, 1), lw=1.6, label=name)
    axes.set_xlabel("simulated time since first contact [s]", fontsize=9, color=INK)
    axes.set_ylabel("targets reached [%]", fontsize=9, color=INK)
    axes.set_xlim(0, None)
    axes.grid(color="#e5e9ec", lw=0.7)
    axes.legend(fontsize=8.5, frameon=False)
    _save(figure, path)
