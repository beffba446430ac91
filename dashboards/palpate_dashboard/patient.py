"""The patient about the abdomen, for display only: head, pillow, and a drape over chest, arms and legs with a window.

Nothing of it is simulated: neither the camera nor the arm meets it. Frame A; sizes follow the abdomen that lies there. The
drape is a height field: what a cloth does that is pulled over round bodies, smoothed, and hangs over the table's edges.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.ndimage import gaussian_filter, maximum_filter

from palpate_dashboard import palette
from palpate_dashboard.geometry import Array, Indices, VertexNormals

GRID_M: Final = 0.012
"""Distance of the drape's vertices."""
HEM_M: Final = 0.05
"""The window is so much larger than the examined region, on each side."""
HANG_M: Final = 0.13
"""So far the drape hangs over the table's edges."""
GAP_M: Final = 0.004
"""Between skin and drape."""
_FEET, _CHIN = -0.97, 0.56
"""Ends of the drape along y [m]: an adult of 1.8 m whose umbilicus is the origin."""


class Part(NamedTuple):
    """A mesh of the patient in A: vertices [m], outward triangles, unit normals, colour."""

    name: str
    vertices: NDArray[np.float32]
    triangles: Indices
    normals: NDArray[np.float32]
    color: palette.Rgba


class Bed(NamedTuple):
    """What the patient lies on, in A [m]."""

    height: float
    """z of the table's top face."""
    half_width: float
    """Half of the table's width, along x."""


def parts(surface: Array, bed: Bed, region_m: tuple[float, float], centre_m: tuple[float, float]) -> list[Part]:
    """Head, pillow and drape about an abdomen whose rest surface is `surface`, shape (n, 3), in A."""
    return [_drape(surface, bed, region_m, centre_m), *_head(bed)]


def window(surface: Array, region_m: tuple[float, float], centre_m: tuple[float, float]) -> tuple[float, float, float, float]:
    """The drape's opening as x and y from and to [m]: the examined region and a hem, within the abdomen."""
    low, high = surface[:, :2].min(axis=0) + 0.015, surface[:, :2].max(axis=0) - 0.015
    half, centre = np.array(region_m) / 2 + HEM_M, np.array(centre_m)
    a, b = np.maximum(centre - half, low), np.minimum(centre + half, high)
    return float(a[0]), float(b[0]), float(a[1]), float(b[1])


def _line(low: float, high: float, marks: tuple[float, float]) -> Array:
    """Places from `low` to `high` about `GRID_M` apart, `marks` among them."""
    ends = [low, *marks, high]
    pieces = [np.linspace(a, b, max(2, round((b - a) / GRID_M) + 1))[:-1] for a, b in pairwise(ends)]
    return np.concatenate((*pieces, [high]))


def _drape(surface: Array, bed: Bed, region_m: tuple[float, float], centre_m: tuple[float, float]) -> Part:
    x0, x1, y0, y1 = window(surface, region_m, centre_m)
    reach = bed.half_width + HANG_M
    u, y = _line(-reach, reach, (x0, x1)), _line(_FEET, _CHIN, (y0, y1))
    x_at = np.clip(u, -bed.half_width - 0.006, bed.half_width + 0.006)
    X, Y = np.meshgrid(x_at, y)
    body = maximum_filter(_body(X, Y, surface, bed), 3)
    cloth = np.maximum(gaussian_filter(body, 1.6, mode="nearest"), body) + GAP_M
    far = np.minimum(np.hypot(np.maximum(np.abs(X) - 0.15, 0), np.maximum(np.abs(Y) - 0.20, 0)) / 0.15, 1.0)
    cloth += 0.0025 * far * (np.sin(61 * Y + 17 * X) + np.sin(43 * X - 29 * Y + 1.0))
    cloth = np.maximum(cloth, GAP_M)
    over = np.maximum(np.abs(u) - bed.half_width, 0.0)
    Z = np.where(over > 0, bed.height + GAP_M - over, bed.height + cloth)
    billow = 0.006 * np.sin(38 * Y) * (over / HANG_M)
    vertices = np.stack((X + np.sign(u) * billow, Y, Z), axis=-1).reshape(-1, 3).astype(np.float32)
    used, triangles = np.unique(_cells(u, y, (x0, x1, y0, y1)), return_inverse=True)
    return _part("drape", vertices[used], triangles.reshape(-1, 3).astype(np.uint32), palette.DRAPE)


def _cells(u: Array, y: Array, opening: tuple[float, float, float, float]) -> Indices:
    """Triangles of the grid without those of the opening."""
    index = np.arange(len(u) * len(y)).reshape(len(y), len(u))
    a, b, c, d = (k.ravel() for k in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    mid_u, mid_y = np.meshgrid((u[1:] + u[:-1]) / 2, (y[1:] + y[:-1]) / 2)
    x0, x1, y0, y1 = opening
    keep = ~((mid_u > x0) & (mid_u < x1) & (mid_y > y0) & (mid_y < y1)).ravel()
    return np.concatenate((np.column_stack((a, b, d))[keep], np.column_stack((a, d, c))[keep])).astype(np.uint32)


def _body(X: Array, Y: Array, surface: Array, bed: Bed) -> Array:
    """Height of what lies under the drape, above the table [m], at X, Y."""
    width, top = float(np.ptp(surface[:, 0])), float(surface[:, 2].max()) - bed.height
    front = surface[surface[:, 2] > bed.height + 0.01]
    inside = LinearNDInterpolator(front[:, :2], front[:, 2])(X, Y)
    nearest = NearestNDInterpolator(front[:, :2], front[:, 2])(X, np.clip(Y, front[:, 1].min(), front[:, 1].max()))
    along = np.interp(Y, (-0.45, -0.30, 0.30, 0.46, 0.56), (0.35, 0.80, 1.0, 0.80, 0.25))
    half = np.interp(Y, (-0.45, -0.30, 0.40, 0.50, 0.56), (0.42, 0.52, 0.56, 0.50, 0.25)) * width
    trunk = along * top * (1 - np.minimum(np.abs(X) / half, 1.0) ** 3) ** (1 / 2.2)
    beside = np.abs(X) <= width / 2
    ends = np.where(beside & (np.abs(Y) < np.abs(front[:, 1]).max() + 0.05), nearest - bed.height, 0.0)
    height = np.maximum(trunk, np.where(np.isnan(inside), ends * (np.abs(Y) < 0.26), inside - bed.height))
    for side in (-1.0, 1.0):
        leg = side * np.interp(Y, (-0.97, -0.35), (0.11, 0.095))
        girth = np.interp(Y, (-0.97, -0.75, -0.62, -0.35), (0.042, 0.052, 0.060, 0.085))
        height = np.maximum(height, _tube(X - leg, girth) * (Y < -0.28))
        foot = np.hypot((X - leg) / 0.055, (Y + 0.885) / 0.075)
        height = np.maximum(height, 0.17 * np.maximum(1 - foot**3, 0) ** 0.5)
        arm = np.interp(Y, (-0.34, -0.30, -0.18, 0.42, 0.50), (0.0, 0.022, 0.028, 0.038, 0.0))
        height = np.maximum(height, _tube(X - side * (width / 2 + 0.045), arm))
    return np.asarray(np.maximum(height, 0.0))


def _tube(x: Array, r: Array) -> Array:
    """Height of a lying tube of radius r at distance x from its axis."""
    return np.asarray(np.where(np.abs(x) < r, r + np.sqrt(np.maximum(r**2 - x**2, 0)), 0.0))


def _head(bed: Bed) -> list[Part]:
    skull = _ball((0.0, 0.755, bed.height + 0.145), (0.076, 0.095, 0.098))
    jaw = _ball((0.0, 0.700, bed.height + 0.162), (0.058, 0.075, 0.074))
    neck = _ball((0.0, 0.620, bed.height + 0.112), (0.056, 0.125, 0.058))
    nose = _ball((0.0, 0.725, bed.height + 0.236), (0.010, 0.020, 0.016))
    ears = [_ball((side * 0.075, 0.745, bed.height + 0.14), (0.012, 0.018, 0.028)) for side in (-1.0, 1.0)]
    shapes = [skull, jaw, neck, nose, *ears]
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in shapes)])
    vertices = np.concatenate([vertices for vertices, _ in shapes])
    triangles = np.concatenate([cells + start for (_, cells), start in zip(shapes, offsets, strict=False)])
    cushion, cells = _ball((0.0, 0.765, bed.height + 0.032), (0.20, 0.135, 0.045), square=0.45)
    return [_part("head", vertices, triangles, palette.SKIN), _part("pillow", cushion, cells, palette.LINEN)]


def _ball(
    centre: tuple[float, float, float], radii: tuple[float, float, float], square: float = 1.0
) -> tuple[NDArray[np.float32], Indices]:
    """An ellipsoid; `square` below 1 makes it a cushion (superellipsoid)."""
    rows, columns = 20, 32
    latitude = np.linspace(-np.pi / 2, np.pi / 2, rows)[:, None]
    longitude = np.linspace(-np.pi, np.pi, columns, endpoint=False)[None]

    def bent(value: Array) -> Array:
        return np.asarray(np.sign(value) * np.abs(value) ** square)

    flat = np.cos(latitude)
    unit = np.stack((flat * bent(np.cos(longitude)), flat * bent(np.sin(longitude)), np.sin(latitude) + 0 * longitude), axis=-1)
    vertices = (np.array(centre) + unit * radii).reshape(-1, 3).astype(np.float32)
    index = np.arange(rows * columns).reshape(rows, columns)
    beside = np.roll(index, -1, axis=1)
    a, b, c, d = (k.ravel() for k in (index[:-1], beside[:-1], index[1:], beside[1:]))
    return vertices, np.concatenate((np.column_stack((a, b, d)), np.column_stack((a, d, c)))).astype(np.uint32)


def _part(name: str, vertices: NDArray[np.float32], triangles: Indices, color: palette.Rgba) -> Part:
    normals = VertexNormals(triangles, len(vertices))(vertices)
    return Part(name, vertices, triangles, normals, color)
