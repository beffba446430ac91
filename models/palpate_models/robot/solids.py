"""Smooth solids as signed distance fields, and triangle meshes of them.

A field maps points [m], shape (n, 3), to signed distances [m], shape (n,), negative inside. Fields combine by minimum
(union), maximum (cut) and a smooth minimum that rounds the seam. `mesh` extracts the surface by naive surface nets
(Gibson 1998), then moves every vertex onto the field's zero.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from palpate_models.numerics.frames import Array

Field = Callable[[Array], Array]
Triangles = NDArray[np.int32]
Point = Sequence[float]

Y = (0.0, 1.0, 0.0)
Z = (0.0, 0.0, 1.0)


def cone(start: Point, end: Point, r_start: float, r_end: float) -> Field:
    """Return a capsule from `start` to `end` whose radius varies linearly between the two spheres."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    axis = b - a

    def field(p: Array) -> Array:
        s = np.clip((p - a) @ axis / (axis @ axis), 0.0, 1.0)
        nearest = a + s[:, None] * axis
        return np.asarray(np.linalg.norm(p - nearest, axis=1) - (r_start + s * (r_end - r_start)))

    return field


def cylinder(axis: Point, low: Point, length: float, radius: float, rounding: float = 0.0) -> Field:
    """Return a cylinder from `low` along the unit vector `axis`, its edges rounded."""
    u = np.asarray(axis, float)
    centre = np.asarray(low, float) + u * length / 2

    def field(p: Array) -> Array:
        along = (p - centre) @ u
        across = np.linalg.norm(p - centre - along[:, None] * u, axis=1) - radius + rounding
        along = np.abs(along) - length / 2 + rounding
        outside = np.hypot(np.maximum(across, 0.0), np.maximum(along, 0.0))
        return np.asarray(outside + np.minimum(np.maximum(across, along), 0.0) - rounding)

    return field


def box(centre: Point, size: Point, rounding: float) -> Field:
    """Return a box with rounded edges."""
    middle, half = np.asarray(centre, float), np.asarray(size, float) / 2 - rounding

    def field(p: Array) -> Array:
        d = np.abs(p - middle) - half
        inside = np.minimum(d.max(axis=1), 0.0)
        return np.asarray(np.linalg.norm(np.maximum(d, 0.0), axis=1) + inside - rounding)

    return field


def half_space(axis: Point, offset: float) -> Field:
    """Return the half space `axis . p < offset`."""
    u = np.asarray(axis, float)
    return lambda p: np.asarray(p @ u - offset)


def blend(width: float, *fields: Field) -> Field:
    """Union with seams rounded over about `width` [m] (polynomial smooth minimum, Quilez)."""

    def field(p: Array) -> Array:
        distance = fields[0](p)
        for other in fields[1:]:
            d = other(p)
            h = np.maximum(width - np.abs(distance - d), 0.0) / width
            distance = np.minimum(distance, d) - h * h * width / 4
        return distance

    return field


def inverse(field: Field) -> Field:
    """Return the complement of `field`."""
    return lambda p: -field(p)


def cut(width: float, field: Field, *limits: Field) -> Field:
    """Return the intersection of `field` with all `limits`, edges rounded over about `width` [m]."""
    return inverse(blend(width, inverse(field), *(inverse(limit) for limit in limits)))


def mirrored(field: Field) -> Field:
    """Return the mirror image in the xz plane."""
    return lambda p: field(p * np.array((1.0, -1.0, 1.0)))


def _gradient(field: Field, p: Array, h: float = 1e-5) -> Array:
    steps = h * np.eye(3)
    return np.stack([(field(p + e) - field(p - e)) / (2 * h) for e in steps], axis=1)


def mesh(field: Field, low: Point, high: Point, edge: float) -> tuple[Array, Triangles]:
    """Vertices [m], shape (n, 3), and triangles, shape (m, 3), outward, of the surface inside the box [low, high].

    `edge` [m] is about the triangles' edge length. The surface must not leave the box.
    """
    axes = [np.arange(a - edge, b + 2 * edge, edge) for a, b in zip(low, high, strict=True)]
    shape = tuple(len(axis) for axis in axes)
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    value = field(grid.reshape(-1, 3)).reshape(shape)
    inside = value < 0
    total = np.zeros((*(n - 1 for n in shape), 3))
    count = np.zeros(total.shape[:3], dtype=int)
    crossings = []
    for axis in range(3):
        first = tuple(slice(None, -1) if i == axis else slice(None) for i in range(3))
        second = tuple(slice(1, None) if i == axis else slice(None) for i in range(3))
        crossed = np.argwhere(inside[first] != inside[second])
        a, b = value[first][tuple(crossed.T)], value[second][tuple(crossed.T)]
        point = grid[tuple(crossed.T)].copy()
        point[:, axis] += edge * a / (a - b)
        j, k = (axis + 1) % 3, (axis + 2) % 3
        ring = []
        for dj, dk in ((1, 1), (0, 1), (0, 0), (1, 0)):  # the four cells about a grid edge, in turn
            cell = crossed.copy()
            cell[:, j] -= dj
            cell[:, k] -= dk
            np.add.at(total, tuple(cell.T), point)
            np.add.at(count, tuple(cell.T), 1)
            ring.append(cell)
        crossings.append((np.stack(ring, axis=1), a < 0))
    number = np.full(count.shape, -1)
    number[count > 0] = np.arange(np.count_nonzero(count))
    vertices = total[count > 0] / count[count > 0][:, None]
    quads = np.concatenate(
        [np.where(out[:, None], (q := number[tuple(np.moveaxis(ring, 2, 0))]), q[:, ::-1]) for ring, out in crossings]
    )
    for _ in range(4):
        slope = _gradient(field, vertices)
        step = field(vertices)[:, None] * slope / np.maximum((slope**2).sum(axis=1, keepdims=True), 0.25)
        vertices = vertices - np.clip(step, -edge / 2, edge / 2)
    triangles = np.concatenate((quads[:, [0, 1, 2]], quads[:, [0, 2, 3]])).astype(np.int32)
    return vertices, triangles


def revolve(profile: Array, axis: Point = Z, origin: Point = (0.0, 0.0, 0.0), segments: int = 48) -> tuple[Array, Triangles]:
    """Return a profile of (radius, height) rows, from the low end of the axis to its high end, turned about `axis`.

    Closed where the profile begins and ends on the axis (radius 0). Vertices [m], shape (n, 3), and outward triangles.
    """
    u = np.asarray(axis, float)
    e = np.array((1.0, 0.0, 0.0)) if abs(u[0]) < 0.9 else np.array((0.0, 1.0, 0.0))
    f = np.cross(u, e)
    angle = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    circle = np.cos(angle)[:, None] * e + np.sin(angle)[:, None] * f
    vertices = profile[:, None, :1] * circle + profile[:, None, 1:] * u + np.asarray(origin, float)
    i, j = np.meshgrid(np.arange(len(profile) - 1), np.arange(segments), indexing="ij")
    a, b = i * segments + j, i * segments + (j + 1) % segments
    triangles = np.stack((a, b, b + segments, a, b + segments, a + segments), axis=-1).reshape(-1, 3)
    radius = np.repeat(profile[:, 0], segments)
    corners = radius[triangles] > 0
    triangles = triangles[corners.sum(axis=1) > 1]  # without those that the axis makes empty
    return vertices.reshape(-1, 3), triangles.astype(np.int32)
