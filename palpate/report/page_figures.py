"""The figures of report.html: PNG images, and the data of its three-dimensional viewer. Only `truth` draws the truth."""

import base64
import io
from typing import Any, Final, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize, to_hex
from matplotlib.figure import Figure
from numpy.typing import NDArray

from palpate.report import figures
from palpate.report.evidence import Evidence, map_of
from palpate.report.scoring import Truth
from palpate_bus.messages import ExamState
from palpate_models.numerics.frames import Array, Mask
from palpate_models.numerics.maps import half_width, level_lines
from palpate_models.patient.mesh import vertex_normals

MEASURED: Final = "#c2410c"
LIMIT: Final = "#b91c1c"
GRID: Final = "#e5e9ec"
_PHASE_TINTS: Final = {
    ExamState.PHASE_LOOK: ("look", "#dbeafe"),
    ExamState.PHASE_PLAN: ("plan", "#ede9fe"),
    ExamState.PHASE_APPROACH: ("approach", "#e2e8f0"),
    ExamState.PHASE_INDENT: ("indent", "#fef3c7"),
    ExamState.PHASE_SCAN: ("scan", "#ffedd5"),
    ExamState.PHASE_RETRACT: ("retract", "#e2e8f0"),
    ExamState.PHASE_ASSESS: ("assess", "#dcfce7"),
    ExamState.PHASE_ABORTED: ("aborted", "#fecaca"),
}


class FigureTuning(NamedTuple):
    """Ranges and limits of the figures."""

    free_mm: float = -20.0
    """Depth below which the tool is clear of the surface; not drawn."""
    min_depth_mm: float = -5.0
    """Minimum depth in figures of the contact."""
    vertices: int = 65_535
    """The viewer's indices have 16 bits."""
    unknown_grey: float = 0.80
    axis_m: float = 0.05
    """Length of the axes of the abdomen frame."""


SHOWN: Final = FigureTuning()


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), dpi=110, facecolor="white")
    figure.set_layout_engine("constrained", w_pad=0.08, h_pad=0.08)
    return figure


def _png(figure: Figure) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", pil_kwargs={"optimize": True})
    return stream.getvalue()


def plain(axes: Axes, ylabel: str, xlabel: str = "") -> None:
    """Draw labels and a light grid."""
    axes.set_ylabel(ylabel, color=figures.INK, fontsize=9)
    axes.set_xlabel(xlabel, color=figures.INK, fontsize=9)
    axes.tick_params(labelsize=8.5, colors=figures.INK)
    axes.grid(color=GRID, lw=0.7)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def maps(evidence: Evidence, samples_xy: Array, skipped_xy: Array, abdomen: bool = True) -> bytes | None:
    """Return force, stiffness and uncertainty seen from the front, with samples and skipped targets in A [m].

    None if there is no map.
    """
    message = evidence.collected.stiffness_map
    if message is None or not figures.is_drawable(message):
        return None
    drawing = figures.Drawing(message, evidence.collected.findings, None, abdomen)
    figure = _figure(15.5, 5.0)
    left, middle, right = figure.subplots(1, 3)
    left.plot(samples_xy[:, 0] * 1e3, samples_xy[:, 1] * 1e3, ".", ms=1.6, color="white", alpha=0.55)
    left.plot(skipped_xy[:, 0] * 1e3, skipped_xy[:, 1] * 1e3, "x", ms=6, mew=1.6, color="#f43f5e")
    skipped = f", {len(skipped_xy)} targets skipped (crosses)" if len(skipped_xy) else ""
    small = f"{len(samples_xy)} samples (dots){skipped}"
    drawing.panel(left, drawing.force_layer, "a", f"Normal force at {drawing.depth * 1e3:.3g} mm", small)
    small = f"times the background; {drawing.outlined}"
    drawing.panel(middle, _ratio_layer(drawing), "b", "Apparent stiffness", small, labels=True)
    drawing.panel(right, drawing.spread_layer, "c", "Uncertainty", "half width of the 90 % band of the apparent stiffness")
    return _png(figure)


def _ratio_layer(drawing: figures.Drawing) -> figures.MapQuantity:
    """Return the layer of apparent stiffness relative to the background."""
    ratio = drawing.map.apparent / drawing.background
    low, high = np.quantile(ratio[drawing.map.scanned], (0.002, 0.998))
    return figures.MapQuantity(ratio, figures.STIFFNESS_COLOURS, LogNorm(float(low), max(2.0, float(high))), "times background")


def record(evidence: Evidence, limit_n: float | None) -> bytes | None:
    """Return force and depth over simulated time with the phases in the background; None without exam states."""
    states = evidence.states
    if not len(states):
        return None
    figure = _figure(15.5, 5.2)
    force, depth = figure.subplots(2, 1, sharex=True)
    labelled: set[str] = set()
    for phase, begin, end in evidence.phases():
        name, tint = _PHASE_TINTS.get(phase, ("", ""))
        if name:
            for axes in (force, depth):
                axes.axvspan(begin, end, color=tint, lw=0, label="_" if name in labelled or axes is depth else name)
            labelled.add(name)
    force.plot(states.time, states.force, color=MEASURED, lw=0.7, label="measured force")
    if limit_n is not None:
        force.axhline(limit_n, color=LIMIT, lw=1, ls="--", label=f"working limit {limit_n:g} N")
    if states.force_limited.any():
        at = states.force_limited
        force.plot(states.time[at], states.force[at], ".", ms=2, color=LIMIT, label="depth yields to the limit")
    plain(force, "normal force [N]")
    measured = np.where(states.depth * 1e3 > SHOWN.free_mm, states.depth * 1e3, np.nan)
    wanted = np.where(states.setpoint * 1e3 > SHOWN.free_mm, states.setpoint * 1e3, np.nan)
    depth.plot(states.time, wanted, color=figures.QUIET, lw=1.4, label="set-point")
    depth.plot(states.time, measured, color=MEASURED, lw=0.7, label="measured depth")
    plain(depth, "depth [mm]", "simulated time [s]")
    depth.set_ylim(SHOWN.min_depth_mm, None)
    for axes in (force, depth):
        axes.legend(fontsize=8.5, ncols=9, loc="lower left", bbox_to_anchor=(0, 1.0), frameon=False)
    force.set_xlim(states.time[0], states.time[-1])
    return _png(figure)


def truth(evidence: Evidence, known: Truth | None) -> bytes | None:
    """Return true apparent stiffness with outlines of findings, and the error of the estimate; None if either is unknown."""
    message = evidence.collected.stiffness_map
    if known is None or message is None or not figures.is_drawable(message):
        return None
    drawing = figures.Drawing(message, evidence.collected.findings, known)
    if drawing.true is None:
        return None
    figure = _figure(10.4, 5.0)
    left, right = figure.subplots(1, 2)
    drawing.panel(left, drawing.stiffness_layer(drawing.true), "d", "Apparent stiffness, true", drawing.truth_legend, truth=True)
    error = 100 * (drawing.map.apparent / drawing.true - 1)
    reach = float(np.nanquantile(np.abs(error[drawing.map.scanned]), 0.99))
    layer = figures.MapQuantity(error, "RdBu_r", Normalize(-reach, reach), "[%]")
    small = "estimated over true apparent stiffness, minus one"
    drawing.panel(right, layer, "e", "Error of the estimate", small, truth=True)
    return _png(figure)


ABOVE_SURFACE_M = np.array((0.0, 0.0, 0.001))
"""Offset of the findings' outline above the surface."""


def surface(message: Any, abdomen: bool = True) -> tuple[list[dict[str, Any]], dict[str, Any]] | None:
    """Return scales and data of the viewer for a `palpation_msgs/StiffnessMap`; None if there is nothing to show.

    A scale has the name of a colouring of the surface, its colours from low to high as #rrggbb, and evenly spaced ticks.
    """
    mapped = map_of(message)
    triangles = np.asarray(message.triangles, dtype=np.int32).reshape(-1, 3)
    whole = mapped.scanned[triangles].all(axis=1)
    triangles = np.concatenate((triangles[whole], triangles[~whole]))
    if not mapped.scanned.any() or len(mapped.vertices) > SHOWN.vertices:
        return None
    middle = mapped.vertices[mapped.scanned].mean(axis=0)
    shape = mapped.vertices - middle
    radius = 0.8 * float(np.linalg.norm(shape[:, :2], axis=1).max())
    force = np.asarray(message.force, dtype=np.float64)
    ratio = mapped.apparent / float(message.background)
    known = mapped.scanned
    half = 100 * half_width(mapped.lower, mapped.upper)
    low, high = float(np.quantile(ratio[known], 0.01)), max(2.0, float(np.quantile(ratio[known], 0.99)))
    relief = np.column_stack((shape[:, :2], np.where(known, force, 0.0) * (0.7 * radius / max(force[known].max(), 1e-9))))
    relief[:, 2] -= relief[known, 2].mean()
    scales: list[dict[str, Any]] = []
    layers: list[dict[str, Any]] = []

    def add(name: str, positions: Array, values: Array, norm: Normalize, cmap: str, form: str, outlined: bool) -> None:
        scale = colormaps[cmap]
        colors = np.where(known[:, None], scale(norm(values))[:, :3], SHOWN.unknown_grey)
        stops = [to_hex(scale(x)) for x in np.linspace(0, 1, 9)]
        ticks = [form.format(float(norm.inverse(x))) for x in np.linspace(0, 1, 5)]
        shown = triangles if outlined else triangles[: whole.sum()]
        scales.append({"name": name, "colors": stops, "ticks": ticks})
        layers.append({
            "positions": _text(positions.astype(np.float32)),
            "normals": _text(vertex_normals(positions, shown).astype(np.float32)),
            "colors": _text(np.round(255 * colors).astype(np.uint8)),
            "outlined": outlined,
            "corners": 3 * len(shown),
        })  # fmt: skip

    add("stiffness on the skin", shape, ratio, LogNorm(low, high, clip=True), figures.STIFFNESS_COLOURS, "{:.1f} ×", True)
    force_norm = Normalize(0.0, float(force[known].max()), clip=True)
    add("force as height", relief, force, force_norm, figures.FORCE_COLOURS, "{:.1f} N", False)
    top = Normalize(0.0, float(np.quantile(half[known], 0.995)), clip=True)
    add("uncertainty on the skin", shape, half, top, figures.UNCERTAINTY_COLOURS, "± {:.0f} %", True)
    outline = level_lines(shape, triangles, (mapped.finding >= 0).astype(np.float64), 0.5)
    data = {
        "radius": radius,
        "triangles": _text(triangles.astype(np.uint16)),
        **_labels(shape, known, middle, abdomen),
        "outline": _text((outline + ABOVE_SURFACE_M).astype(np.float32)),
        "layers": layers,
    }
    return scales, data


def _labels(shape: Array, known: Mask, middle: Array, abdomen: bool) -> dict[str, Any]:
    """Return the axes of the abdomen frame A at the corner of the scanned region, as segments, and labels with positions.

    `shape`: vertices about `middle`, which is a point in A, shape (n, 3) [m]; x points to the patient's left, y to the head.
    """
    (left, feet, _), (right, head, _) = shape[known].min(axis=0), shape[known].max(axis=0)

    def on_surface(at_x: float, at_y: float) -> Array:
        nearest = int(np.argmin(np.hypot(shape[:, 0] - at_x, shape[:, 1] - at_y)))
        return np.array((at_x, at_y, shape[nearest, 2] + 0.002))

    x, y, _ = 0.16 * max(right - left, head - feet) * np.eye(3)
    corner = on_surface(left, feet) - 0.3 * (x + y)
    ends = corner + SHOWN.axis_m * np.eye(3)
    words = {f"{name} {1e3 * SHOWN.axis_m:.0f} mm": end for name, end in zip("xyz", ends, strict=True)}
    if abdomen:
        words |= {"head": on_surface(0.0, head) + y, "feet": on_surface(0.0, feet) - y}
        words |= {"patient's right": on_surface(left, 0.0) - x, "patient's left": on_surface(right, 0.0) + x}
    navel = -middle
    if abdomen and left <= navel[0] <= right and feet <= navel[1] <= head:
        words["navel"] = on_surface(navel[0], navel[1])
    axes = np.array([(corner, end) for end in ends], dtype=np.float32)
    return {"axes": _text(axes), "words": [[word, *(round(float(v), 4) for v in place)] for word, place in words.items()]}


def _text(array: NDArray[Any]) -> str:
    little = array.astype(array.dtype.newbyteorder("<"))
    return base64.b64encode(np.ascontiguousarray(little).tobytes()).decode("ascii")
