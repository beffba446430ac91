"""The stiffness map from above, in the abdomen frame A: mean and uncertainty, findings, true outlines, legend."""

from collections.abc import Iterable
from typing import Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from palpate_dashboard import palette
from palpate_dashboard.arrays import Floats, Indices
from palpate_dashboard.sinks import TIMELINE

LAYERS: Final = ("mean", "band")


class MapView:
    """Draws the map seen from above: positions are in A [m], z is dropped."""

    def __init__(self, recording: rr.RecordingStream, region_m: tuple[float, float], centre_m: tuple[float, float]) -> None:
        """`region_m`: width and height of the examined region around `centre_m`."""
        self._recording = recording
        self._shape: tuple[NDArray[np.float32], Indices] | None = None
        (w, h), (x, y) = region_m, centre_m
        self._corner = np.array((x + w / 2 + 0.012, y - h / 2, 0.0))
        self._height = h
        recording.log("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._frame(w, h, x, y)
        self._legend("mean", [f"{r:g} ×" for r in palette.LEGEND], palette.stiffness_colors(np.array(palette.LEGEND)))
        spreads = np.array((0.1, 0.2, 0.4, 0.6))
        self._legend("band", [f"± {100 * s:.0f} %" for s in spreads], palette.spread_colors(spreads))

    def _frame(self, w: float, h: float, x: float, y: float) -> None:
        left, right, low, high = x - w / 2, x + w / 2, y - h / 2, y + h / 2
        strips = [[(left, low, 0.002), (right, low, 0.002), (right, high, 0.002), (left, high, 0.002), (left, low, 0.002)]]
        if left < 0 < right:
            strips.append([(0, low, 0.002), (0, high, 0.002)])
        if low < 0 < high:
            strips.append([(left, 0, 0.002), (right, 0, 0.002)])
        lines = rr.LineStrips3D(strips, colors=[(150, 150, 150, 255)], radii=[rr.Radius.ui_points(0.7)])
        quadrants = {"RUQ": (-1, 1), "LUQ": (1, 1), "RLQ": (-1, -1), "LLQ": (1, -1)}
        here = {name: (a, b) for name, (a, b) in quadrants.items() if max(a * left, a * right) > 0 < max(b * low, b * high)}
        places = [(x + 0.42 * a * w, y + 0.42 * b * h, 0.003) for a, b in here.values()]
        names = rr.Points3D(places, labels=list(here), radii=[0.0001], colors=[palette.TARGETS], show_labels=True)
        for layer in LAYERS:
            self._recording.log(f"map/{layer}/frame", lines, static=True)
            self._recording.log(f"map/{layer}/quadrants", names, static=True)

    def _legend(self, layer: str, labels: list[str], colors: NDArray[np.uint32]) -> None:
        step = self._height / len(labels)
        places = self._corner + np.outer((np.arange(len(labels)) + 0.5) * step, (0.0, 1.0, 0.0))
        swatches = rr.Boxes3D(centers=places, half_sizes=[(0.006, step / 2, 0.0005)], colors=colors, fill_mode="solid")
        self._recording.log(f"map/{layer}/legend", swatches, static=True)
        label_places = places + np.array((0.034, 0.0, 0.0))
        names = rr.Points3D(label_places, labels=labels, radii=[0.0001], colors=[palette.TARGETS], show_labels=True)
        self._recording.log(f"map/{layer}/legend/labels", names, static=True)

    def update(
        self, t: int, vertices: NDArray[np.float32], triangles: Indices, ratio: Floats, spread: Floats, scanned: NDArray[np.bool_]
    ) -> None:
        """Draw stiffness over background [1] and half width of the 90 % band over the mean [1], at the vertices."""
        self._recording.set_time(TIMELINE, duration=np.timedelta64(t, "ns"))
        flat = vertices * np.array((1, 1, 0), dtype=np.float32)
        shape = self._shape
        if shape is None or not (np.array_equal(shape[0], flat) and np.array_equal(shape[1], triangles)):
            self._shape = (flat, triangles)
            for layer in LAYERS:
                mesh = rr.Mesh3D.from_fields(vertex_positions=flat, triangle_indices=triangles)
                self._recording.log(f"map/{layer}/surface", mesh)
        unknown = palette.packed((70, 72, 78, 255))
        for layer, colors in (("mean", palette.stiffness_colors(ratio)), ("band", palette.spread_colors(spread))):
            mesh = rr.Mesh3D.from_fields(vertex_colors=np.where(scanned, colors, unknown).astype(np.uint32))
            self._recording.log(f"map/{layer}/surface", mesh)

    def lesions(self, segments: Iterable[Floats]) -> None:
        """Draw true lesion outlines, one (k, 2, 3) array of segments each."""
        strips = [segment * (1, 1, 0) + (0, 0, 0.003) for outline in segments for segment in outline]
        shape = rr.LineStrips3D(strips, colors=[palette.TRUTH], radii=[rr.Radius.ui_points(1.5)])
        self._recording.log("map/mean/truth", shape, static=True)

    def findings(self, t: int, centroids: Floats, labels: list[str]) -> None:
        """Draw centroids of the findings, shape (n, 3)."""
        self._recording.set_time(TIMELINE, duration=np.timedelta64(t, "ns"))
        places = centroids * (1, 1, 0) + (0, 0, 0.004)
        shape = rr.Points3D(places, colors=[palette.FINDING], radii=[0.003], labels=labels, show_labels=True)
        self._recording.log("map/mean/findings", shape)
