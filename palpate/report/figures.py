"""map.png: measured force, estimated stiffness and the truth (figures 7 and 8 of the paper).

The view is from the front with the patient's head up: the patient's right is on the viewer's left, as in clinical drawings.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from matplotlib.tri import Triangulation

from palpate.report import rows
from palpate.report.evidence import map_of
from palpate.report.scoring import Map, Truth
from palpate_models.numerics.frames import Array
from palpate_models.numerics.maps import half_width

INK = "#1b2a33"
QUIET = "#6b7a83"
FORCE_COLOURS, STIFFNESS_COLOURS, UNCERTAINTY_COLOURS = "viridis", "inferno", "cividis"
_FINDING, _TRUE = "#18e0d0", "#ffffff"
_SMALL = 8.5
APPARENT = "force of the standard press"
_LOG_TICKS = [m * 10.0**e for e in range(-1, 3) for m in (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8)]


def is_drawable(message: Any) -> bool:
    """Return True if a `palpation_msgs/StiffnessMap` has a scanned triangle."""
    triangles = np.asarray(message.triangles, dtype=np.int64).reshape(-1, 3)
    return bool(np.asarray(message.scanned, dtype=bool)[triangles].all(axis=1).any())


class MapQuantity(NamedTuple):
    """A quantity over the map."""

    values: Array
    """At the nodes, shape (n,); NaN where unknown."""
    cmap: str
    norm: Normalize
    label: str
    """Label of its colour bar."""


class Drawing:
    """Draws one map on axes, with triangulations of the scanned part in millimetres."""

    def __init__(self, message: Any, findings: Any | None, truth: Truth | None, abdomen: bool = True) -> None:
        """`abdomen`: False for another body, which has no quadrants."""
        self.abdomen = abdomen
        self.map: Map = map_of(message)
        self.force = np.asarray(message.force, dtype=np.float64)
        self.depth = float(message.common_depth)
        self.background = float(message.background)
        self.findings = [] if findings is None else list(findings.findings)
        self.outlined = "findings outlined" if self.findings else "no finding"
        xyz = self.map.vertices * 1e3
        triangles = np.asarray(message.triangles, dtype=np.int64).reshape(-1, 3)
        triangles = triangles[self.map.scanned[triangles].all(axis=1)]
        self.xyz, self.triangles = xyz, triangles
        self.tri = Triangulation(xyz[:, 0], xyz[:, 1], triangles)
        self.true: Array | None = None
        """True apparent stiffness at the touched places [N], shape (n,)."""
        self.lump: Array | None = None
        """1 in the areas of lumps, shape (n,)."""
        if truth is not None:
            places = truth.touched.places(self.map.vertices[:, :2])
            self.true = truth.felt.force(places)
            self.lump = truth.felt.in_lump(places).astype(float)
        lump = "dashed: where a lump is felt" if self.lump is not None and self.lump.any() else "no lump"
        self.truth_legend = f"{lump}; {'solid: finding' if self.findings else self.outlined}"

    @property
    def apparent_norm(self) -> LogNorm:
        """Common colour scale of estimate and truth [N]."""
        shown = [self.map.apparent[self.map.scanned]]
        if self.true is not None:
            shown.append(self.true[self.map.scanned & np.isfinite(self.true)])
        values = np.concatenate(shown)
        return LogNorm(float(np.quantile(values, 0.002)), float(np.quantile(values, 0.998)))

    @property
    def force_layer(self) -> MapQuantity:
        """Normal force at the common depth."""
        norm = Normalize(0.0, float(self.force[self.map.scanned].max()))
        return MapQuantity(self.force, FORCE_COLOURS, norm, "force [N]")

    @property
    def spread_layer(self) -> MapQuantity:
        """Half width of the 90 % band of the apparent stiffness, relative to its middle."""
        half = 100 * half_width(self.map.lower, self.map.upper)
        norm = Normalize(0.0, float(np.quantile(half[self.map.scanned], 0.995)))
        return MapQuantity(half, UNCERTAINTY_COLOURS, norm, "± [%]")

    def stiffness_layer(self, values: Array) -> MapQuantity:
        """Return the layer of the apparent stiffness [N], estimated or true."""
        return MapQuantity(values, STIFFNESS_COLOURS, self.apparent_norm, "[N]")

    def panel(
        self, axes: Axes, layer: MapQuantity, letter: str, title: str, small: str, *, truth: bool = False, labels: bool = False
    ) -> None:
        """Draw a quantity seen from the front, with the outlines of findings, a title and a colour bar."""
        image = self.plane(axes, layer)
        self.outlines(axes, truth, labels)
        panel_title(axes, letter, title, small)
        colour_bar(image, axes, layer.label)

    def plane(self, axes: Axes, layer: MapQuantity) -> ScalarMappable:
        """Draw a quantity, where known, seen from the front, with quadrants."""
        values, cmap, norm, _ = layer
        known = np.isfinite(values)[self.triangles].all(axis=1)
        tri = Triangulation(self.xyz[:, 0], self.xyz[:, 1], self.triangles[known])
        image = axes.tripcolor(tri, np.nan_to_num(values), cmap=cmap, norm=norm, shading="gouraud", rasterized=True)
        low, high = self.xyz[self.triangles].reshape(-1, 3).min(axis=0), self.xyz[self.triangles].reshape(-1, 3).max(axis=0)
        if self.abdomen:
            self._quadrants(axes, low, high)
        axes.set_aspect("equal")
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        for label, direction, text in ((axes.set_xlabel, "x", "to the patient's left"), (axes.set_ylabel, "y", "to the head")):
            label(f"{direction}, {text} [mm]" if self.abdomen else f"{direction} [mm]", fontsize=_SMALL, color=INK)
        axes.tick_params(labelsize=_SMALL, colors=INK)
        return image

    @staticmethod
    def _quadrants(axes: Axes, low: Array, high: Array) -> None:
        """Draw umbilicus, midline and names of quadrants; `low` and `high` corner of the view [mm]."""
        axes.axhline(0, color="white", lw=0.8, alpha=0.55)
        axes.axvline(0, color="white", lw=0.8, alpha=0.55)
        axes.plot(0, 0, "o", ms=5, mfc="none", mec="white", mew=1.1)
        for name, x, y in (("RUQ", 0, 1), ("LUQ", 1, 1), ("RLQ", 0, 0), ("LLQ", 1, 0)):
            if not ((high[0] > 0 if x else low[0] < 0) and (high[1] > 0 if y else low[1] < 0)):
                continue  # it lies outside the view
            place: Any = {"transform": axes.transAxes, "ha": "right" if x else "left", "va": "top" if y else "bottom"}
            look: Any = {"color": "white", "weight": "bold", "path_effects": [withStroke(linewidth=2, foreground=INK)]}
            axes.text(0.03 + 0.94 * x, 0.03 + 0.94 * y, name, fontsize=10, **place, **look)

    def smooth(self, member: Array) -> Array:
        """Return membership averaged over neighbours, so that its half level is a smooth outline."""
        edges = np.concatenate((self.triangles[:, [0, 1]], self.triangles[:, [1, 2]], self.triangles[:, [2, 0]]))
        for _ in range(3):
            total, count = 2.0 * member, np.full(len(member), 2.0)
            for a, b in (edges.T, edges.T[::-1]):
                np.add.at(total, a, member[b])
                np.add.at(count, a, 1.0)
            member = total / count
        return member

    def outlines(self, axes: Axes, truth: bool, labels: bool = False) -> None:
        """Draw the outlines of findings and, with `truth`, of true lumps if known."""
        for i, f in enumerate(self.findings):
            member = (self.map.finding == i).astype(float)
            if not member.any():
                continue
            contour = axes.tricontour(self.tri, self.smooth(member), levels=[0.5], colors=[_FINDING], linewidths=2.0)
            contour.set_path_effects([withStroke(linewidth=3.6, foreground=INK)])
            x, y = f.centroid.x * 1e3, f.centroid.y * 1e3
            axes.plot(x, y, "+", color=_FINDING, ms=9, mew=2, path_effects=[withStroke(linewidth=3.6, foreground=INK)])
            if labels:
                axes.annotate(
                    f"{f.ratio:.1f} ×\n{f.area * 1e4:.0f} cm²",
                    (x, y),
                    xytext=(0, 12),
                    textcoords="offset points",
                    ha="center",
                    fontsize=9,
                    weight="bold",
                    color="white",
                    path_effects=[withStroke(linewidth=2.5, foreground=INK)],
                )
        if truth and self.lump is not None and self.lump.max() > 0.5:
            contour = axes.tricontour(
                self.tri, self.smooth(self.lump), levels=[0.5], colors=[_TRUE], linewidths=1.6, linestyles="--"
            )
            contour.set_path_effects([withStroke(linewidth=2.8, foreground=INK)])

    def space(self, axes: Any, height: Array, layer: MapQuantity, label: str) -> None:
        """Draw the map as a surface in space: `height` above the xy plane, coloured by a quantity."""
        look = {"cmap": layer.cmap, "norm": layer.norm, "linewidth": 0, "edgecolor": "none", "antialiased": False}
        surface = axes.plot_trisurf(Triangulation(self.xyz[:, 0], self.xyz[:, 1], self.triangles), height, **look)
        surface.set_array(layer.values[self.triangles].mean(axis=1))
        axes.view_init(elev=30, azim=-62)
        axes.zaxis.set_major_locator(MaxNLocator(4))
        axes.set_xlabel("x [mm]", fontsize=_SMALL, labelpad=-2)
        axes.set_ylabel("y [mm]", fontsize=_SMALL, labelpad=-2)
        axes.set_zlabel(label, fontsize=_SMALL, labelpad=0)
        axes.tick_params(labelsize=7.5, pad=-1)
        for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
            axis.pane.set_facecolor("#f4f6f7")
            axis.pane.set_edgecolor("#d5dbde")
            axis._axinfo["grid"].update(color="#dfe5e8", linewidth=0.6)


def draw_map(
    path: Path,
    message: Any,
    findings: Any | None,
    samples_xy: Array,
    truth: Truth | None,
    title: str,
    run: str = "",
    abdomen: bool = True,
) -> None:
    """Draw `palpation_msgs/StiffnessMap` and `Findings` (in A), with the truth if known, into a PNG file.

    `samples_xy`: places of the samples [m], shape (m, 2). The file's metadata has the name of the run. Writes nothing for a map
    that is not `is_drawable`.
    """
    if not is_drawable(message):
        return
    drawing = Drawing(message, findings, truth, abdomen)
    figure = Figure(figsize=(16.5, 10.2), dpi=130, facecolor="white")
    figure.set_layout_engine("constrained", w_pad=0.12, h_pad=0.12, wspace=0.02, hspace=0.03)
    grid = figure.add_gridspec(2, 3)
    _draw_force(figure, grid, drawing, samples_xy)
    _draw_stiffness(figure, grid, drawing)
    figure.suptitle(f"{title}: {_summary(drawing)}", fontsize=15, weight="bold", color=INK)
    figure.supxlabel("white in the maps: not assessed", fontsize=_SMALL, color=QUIET)
    figure.savefig(path, metadata={"Title": title, "Comment": f"run {run}"})


def _draw_force(figure: Figure, grid: Any, drawing: Drawing, samples_xy: Array) -> None:
    layer = drawing.force_layer
    flat = figure.add_subplot(grid[0, 0])
    flat.plot(samples_xy[:, 0] * 1e3, samples_xy[:, 1] * 1e3, ".", ms=1.6, color="white", alpha=0.55)
    depth_mm, count = drawing.depth * 1e3, len(samples_xy)
    drawing.panel(flat, layer, "a", f"Normal force at {depth_mm:.3g} mm depth", f"{count} samples (dots)")
    solid = figure.add_subplot(grid[0, 1], projection="3d")
    drawing.space(solid, drawing.force, layer, layer.label)
    solid.set_box_aspect((1, 1, 0.72), zoom=1.0)
    panel_title(solid, "b", "Normal force in 3-D", "height and colour are force")
    spread = figure.add_subplot(grid[0, 2])
    drawing.panel(spread, drawing.spread_layer, "c", "Uncertainty of the apparent stiffness", "half width of the 90 % band")


def _draw_stiffness(figure: Figure, grid: Any, drawing: Drawing) -> None:
    layer = drawing.stiffness_layer(drawing.map.apparent)
    flat = figure.add_subplot(grid[1, 0])
    small = f"{APPARENT}; background {drawing.background:.1f} N; {drawing.outlined}"
    drawing.panel(flat, layer, "d", "Apparent stiffness, estimated", small, labels=True)
    solid = figure.add_subplot(grid[1, 1], projection="3d")
    drawing.space(solid, drawing.xyz[:, 2], layer, "z [mm]")
    solid.set_box_aspect((1, 1, 0.45), zoom=1.0)
    panel_title(solid, "e", "The same on the surface", "of the abdomen as perceived" if drawing.abdomen else "the unpressed skin")
    true = figure.add_subplot(grid[1, 2])
    if drawing.true is None:
        true.set_axis_off()
        true.text(0.5, 0.5, "truth unknown", ha="center", va="center", color=QUIET, fontsize=13)
        return
    drawing.panel(true, drawing.stiffness_layer(drawing.true), "f", "Apparent stiffness, true", drawing.truth_legend, truth=True)


def panel_title(axes: Any, letter: str, title: str, small: str) -> None:
    """Write the title of a panel with a note in small letters below it."""
    axes.set_title(f"({letter}) {title}\n", fontsize=12, weight="bold", color=INK, loc="left")
    place = axes.text2D if hasattr(axes, "text2D") else axes.text
    place(0.0, 1.02, small, transform=axes.transAxes, fontsize=9, color=QUIET)


def colour_bar(image: ScalarMappable, axes: Axes, label: str) -> None:
    """Draw a colour bar next to `axes`, with round numbers on a logarithmic scale."""
    figure = axes.get_figure()
    assert figure is not None
    round_numbers: Any = {"ticks": _LOG_TICKS, "format": "%g"} if isinstance(image.norm, LogNorm) else {}
    bar = figure.colorbar(image, ax=axes, fraction=0.046, pad=0.02, **round_numbers)
    bar.set_label(label, fontsize=_SMALL, color=INK)
    if round_numbers:
        bar.minorticks_off()
    bar.ax.tick_params(labelsize=_SMALL, colors=INK)
    bar.outline.set_visible(False)


def _summary(drawing: Drawing) -> str:
    if not drawing.findings:
        return "no finding"
    return "; ".join(
        f"{f.quadrant + ', ' if f.quadrant else ''}{f.ratio:.1f} times as stiff "
        f"({f.ratio_lower:.1f} to {f.ratio_upper:.1f}), confidence {rows.confidence(f)}"
        for f in drawing.findings
    )
