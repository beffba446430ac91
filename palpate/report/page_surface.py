"""The abdomen in 3-D for report.html: what the page's viewer (templates/surface.js) reads."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import LogNorm, Normalize, to_hex
from numpy.typing import NDArray

from palpate.report.evidence import map_of
from palpate.report.figures import FORCE_COLOURS, STIFFNESS_COLOURS, UNCERTAINTY_COLOURS
from palpate_models.numerics.band import half_width
from palpate_models.numerics.frames import Array
from palpate_models.numerics.level_lines import level_lines
from palpate_models.patient.mesh import vertex_normals

MAX_VERTICES = 65_535
"""The viewer's indices have 16 bits."""
_UNKNOWN = 0.80
ABOVE_SKIN_M = np.array((0.0, 0.0, 0.001))
"""The findings' outline is drawn so far above the surface."""
AXIS_M = 0.05
"""Length of the axes of the abdomen frame."""


@dataclass(frozen=True)
class Layer:
    """One way to look at the surface."""

    name: str
    colors: tuple[str, ...]
    """Colours of its scale, from low to high, as #rrggbb."""
    ticks: tuple[str, ...]
    """Words of the scale, evenly spaced from low to high."""


def surface(message: Any) -> tuple[list[Layer], dict[str, Any]] | None:
    """Layers and data of the viewer for a `palpation_msgs/StiffnessMap`; None when there is nothing to see."""
    mapped = map_of(message)
    triangles = np.asarray(message.triangles, dtype=np.int32).reshape(-1, 3)
    whole = mapped.scanned[triangles].all(axis=1)
    triangles = np.concatenate((triangles[whole], triangles[~whole]))
    if not mapped.scanned.any() or len(mapped.vertices) > MAX_VERTICES:
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
    layers: list[tuple[Layer, Array, Array, bool]] = []

    def add(name: str, positions: Array, values: Array, norm: Normalize, cmap: str, form: str, outlined: bool) -> None:
        scale = colormaps[cmap]
        colors = np.where(known[:, None], scale(norm(values))[:, :3], _UNKNOWN)
        stops = tuple(to_hex(scale(x)) for x in np.linspace(0, 1, 9))
        ticks = tuple(form.format(float(norm.inverse(x))) for x in np.linspace(0, 1, 5))
        layers.append((Layer(name, stops, ticks), positions, colors, outlined))

    add("stiffness on the skin", shape, ratio, LogNorm(low, high, clip=True), STIFFNESS_COLOURS, "{:.1f} ×", True)
    force_norm = Normalize(0.0, float(force[known].max()), clip=True)
    add("force as height", relief, force, force_norm, FORCE_COLOURS, "{:.1f} N", False)
    top = Normalize(0.0, float(np.quantile(half[known], 0.995)), clip=True)
    add("uncertainty on the skin", shape, half, top, UNCERTAINTY_COLOURS, "± {:.0f} %", True)
    outline = level_lines(shape, triangles, (mapped.finding >= 0).astype(np.float64), 0.5)
    data = {
        "radius": radius,
        "triangles": _text(triangles.astype(np.uint16)),
        **_labels(shape, known, middle),
        "outline": _text((outline + ABOVE_SKIN_M).astype(np.float32)),
        "layers": [
            {
                "positions": _text(positions.astype(np.float32)),
                "normals": _text(vertex_normals(positions, triangles[: None if outlined else whole.sum()]).astype(np.float32)),
                "colors": _text(np.round(255 * colors).astype(np.uint8)),
                "outlined": outlined,
                "corners": 3 * (len(triangles) if outlined else int(whole.sum())),
            }
            for _, positions, colors, outlined in layers
        ],
    }
    return [layer for layer, *_ in layers], data


def _labels(shape: Array, known: NDArray[np.bool_], middle: Array) -> dict[str, Any]:
    """Axes of the abdomen frame A at the corner of the scanned region, as segments, and words with their places.

    `shape`: vertices about `middle`, which is a point in A, shape (n, 3) [m]; x points to the patient's left, y to the head.
    """
    (left, feet, _), (right, head, _) = shape[known].min(axis=0), shape[known].max(axis=0)

    def on_skin(at_x: float, at_y: float) -> Array:
        nearest = int(np.argmin(np.hypot(shape[:, 0] - at_x, shape[:, 1] - at_y)))
        return np.array((at_x, at_y, shape[nearest, 2] + 0.002))

    beside = 0.16 * max(right - left, head - feet)
    x, y, _ = beside * np.eye(3)
    corner = on_skin(left, feet) - 0.3 * (x + y)
    ends = corner + AXIS_M * np.eye(3)
    words = {
        "head": on_skin(0.0, head) + y,
        "feet": on_skin(0.0, feet) - y,
        "patient's right": on_skin(left, 0.0) - x,
        "patient's left": on_skin(right, 0.0) + x,
        **{f"{name} {1e3 * AXIS_M:.0f} mm": end for name, end in zip("xyz", ends, strict=True)},
    }
    navel = -middle
    if left <= navel[0] <= right and feet <= navel[1] <= head:
        words["navel"] = on_skin(navel[0], navel[1])
    axes = np.array([(corner, end) for end in ends], dtype=np.float32)
    return {"axes": _text(axes), "words": [[word, *(round(float(v), 4) for v in place)] for word, place in words.items()]}


def _text(array: NDArray[Any]) -> str:
    little = array.astype(array.dtype.newbyteorder("<"))
    return base64.b64encode(np.ascontiguousarray(little).tobytes()).decode("ascii")
