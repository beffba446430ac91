"""Parametric surface of the abdomen, with costal arch and iliac crests."""

from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial import Delaunay

from palpate_models.numerics.frames import Array, Indices, Ints32, Mask
from palpate_models.patient.field import smoothstep
from palpate_models.patient.mesh import orient, vertex_normals
from palpate_models.patient.schema import Anatomy, Skeleton


class BodyShape(NamedTuple):
    """Relief of the parametric abdomen, and its mesh."""

    costal_edge_m: float = 0.04
    """Width of the transition from belly to rib cage."""
    umbilicus_m: tuple[float, float] = (0.0015, 0.009)
    """Depth and radius (standard deviation) of the umbilicus; its radius of curvature is 54 mm."""
    costal_rise_m: float = 0.004
    """Rise of the rib cage above the costal arch."""
    iliac_rise_m: float = 0.005
    """Rise of the iliac crests."""
    examined_half_m: float = 0.106
    """Half width and length of the finely meshed region: 0.10 m and a margin."""
    growth: float = 0.23
    """Growth of the edge length with distance from the examined region."""


SHAPE: Final = BodyShape()


def _in_skeleton(x: Array, y: Array, skeleton: Skeleton) -> tuple[Array, Array]:
    """Return the coordinates in the frame in which the skeleton is symmetric [m]."""
    aside = x - skeleton.lateral_m
    return aside, y - skeleton.tilt * aside


def above_costal_arch(x: Array, y: Array, skeleton: Skeleton) -> Array:
    """Return the height [m] of points above the costal arch, negative on the belly."""
    x, y = _in_skeleton(x, y, skeleton)
    return np.asarray(y - skeleton.costal_arch_m + skeleton.costal_slope * np.abs(x))


def iliac_bump(x: Array, y: Array, skeleton: Skeleton) -> Array:
    """Return the relative rise over the iliac spines, 1 at each."""
    across, along = skeleton.iliac_crest_m
    x, y = _in_skeleton(x, y, skeleton)
    square = (np.abs(x) - across) ** 2 + (y - along) ** 2
    return np.asarray(np.exp(-square / (2 * skeleton.iliac_radius_m**2)))


def bone_share(x: Array, y: Array, skeleton: Skeleton) -> Array:
    """Return the share of bone under the wall, from 0 on the belly to 1."""
    ribs = smoothstep(above_costal_arch(x, y, skeleton) / SHAPE.costal_edge_m)
    return np.maximum(ribs, smoothstep(2 * iliac_bump(x, y, skeleton) - 0.5))


class Shape(NamedTuple):
    """A closed surface in A: vertices (n, 3) [m], triangles (m, 3), outward normals (n, 3), fixed vertices (n,)."""

    vertices: Array
    triangles: Ints32
    normals: Array
    fixed: Mask


class _Body:
    """Maps (s, y) to the surface: s is the arc length from the crown along the middle section, positive to the left."""

    def __init__(self, size_m: tuple[float, float, float], anatomy: Anatomy) -> None:
        width, length, self.height = size_m
        self.half_length = length / 2
        self._dome, self._skeleton = anatomy.dome_m, anatomy.skeleton
        a, c, power = width / 2, self.height / 2, 2 / anatomy.exponent
        theta = np.linspace(0, np.pi / 2, 2001)
        front_x, front_z = a * np.sin(theta) ** power, c * (np.cos(theta) ** power - 1)
        # Below its widest line the section is a taller superellipse, cut by the table.
        back_x, back_z = a * np.cos(theta[1:]) ** power, -c - 1.25 * c * np.sin(theta[1:]) ** power
        on_body = back_z > -self.height
        cut = np.interp(self.height, -back_z, back_x)
        self._x = np.concatenate((front_x, back_x[on_body], [cut]))
        self._z = np.concatenate((front_z, back_z[on_body], [-self.height]))
        self._s = np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(self._x), np.diff(self._z)))))
        self.half_arc = float(self._s[-1])

    def arc(self, x: float) -> float:
        """Arc length [m] at which the front of the middle section reaches `x` [m]."""
        widest = int(np.argmax(self._x))
        return float(np.interp(x, self._x[: widest + 1], self._s[: widest + 1]))

    def __call__(self, s: Array, y: Array) -> Array:
        """Points (n, 3) [m] in A."""
        eta = y / self.half_length
        waist = 1 - 0.05 * np.exp(-(((eta - 0.15) / 0.45) ** 2))
        waist /= 1 - 0.05 * np.exp(-((0.15 / 0.45) ** 2))
        x = np.sign(s) * np.interp(np.abs(s), self._s, self._x) * waist
        share = 1 + np.interp(np.abs(s), self._s, self._z) / self.height
        depth, sigma = SHAPE.umbilicus_m
        relief = -self._dome * eta**2 + depth * (1 - np.exp(-(x**2 + y**2) / (2 * sigma**2)))
        relief += SHAPE.costal_rise_m * smoothstep(above_costal_arch(x, y, self._skeleton) / SHAPE.costal_edge_m)
        relief += SHAPE.iliac_rise_m * iliac_bump(x, y, self._skeleton)
        return np.column_stack((x, y, -self.height + share * (self.height + relief)))


def lattice(half_s: float, half_y: float, edge: float) -> Array:
    """Hexagonal lattice with a point at the origin in a rectangle, shape (n, 2)."""
    rows = int(half_y / (edge * np.sqrt(3) / 2))
    columns = int(half_s / edge) + 1
    j, i = np.mgrid[-rows : rows + 1, -columns : columns + 1]
    points = np.column_stack(((i + (j % 2) / 2).ravel() * edge, j.ravel() * edge * np.sqrt(3) / 2))
    return np.asarray(points[np.abs(points[:, 0]) <= half_s])


def rings(half_s: float, half_y: float, outer: tuple[float, float], edge: float) -> Array:
    """Points on offset curves of the inner rectangle, ever coarser, kept inside the outer one; shape (n, 2)."""
    rings: list[Array] = []
    offset = 0.9 * edge
    while offset < np.hypot(outer[0] - half_s, outer[1] - half_y):
        size = edge + SHAPE.growth * offset
        quarter = np.array([2 * half_y, offset * np.pi / 2, 2 * half_s, offset * np.pi / 2])
        at = np.linspace(0, 2 * quarter.sum(), round(2 * quarter.sum() / size), endpoint=False)
        bends = np.concatenate(([0.0], np.cumsum(np.tile(quarter, 2))))
        side = np.searchsorted(bends, at, side="right") - 1
        along = at - bends[side]
        turn = (side // 2) * np.pi / 2 + np.where(side % 2, along / offset, 0.0)
        corner = np.array([[half_s, -half_y], [half_s, half_y], [half_s, half_y], [-half_s, half_y]])
        corner = np.concatenate((corner, -corner))[side]
        tangent = np.column_stack((-np.sin(turn), np.cos(turn)))
        normal = np.column_stack((np.cos(turn), np.sin(turn)))
        points = corner + offset * normal + np.where(side % 2, 0.0, along)[:, None] * tangent
        inside = (np.abs(points) < np.asarray(outer) - 0.5 * size).all(axis=1)
        rings.append(points[inside])
        offset += 0.95 * size
    return np.concatenate(rings)


def _grade(half: float, other_distance: float, inner: float, edge: float) -> Array:
    """Coordinates from 0 to `half` along a border, spaced like the rings that end there; shape (k,)."""
    x = np.linspace(0, half, 2001)
    size = edge + SHAPE.growth * np.hypot(np.maximum(x - inner, 0), other_distance)
    count = np.concatenate(([0.0], np.cumsum(np.diff(x) / size[1:])))
    return np.interp(np.linspace(0, count[-1], max(3, round(count[-1]) + 1)), count, x)


def _strip(left: Indices, right: Indices) -> Ints32:
    """Triangles between two chains of as many vertices; chains may share their first vertex."""
    quads = np.column_stack((left[:-1], right[:-1], right[1:], left[1:]))
    triangles = np.concatenate((quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]))
    degenerate = (triangles[:, 0] == triangles[:, 1]) | (triangles[:, 1] == triangles[:, 2])
    return np.asarray(triangles[~degenerate], dtype=np.int32)


def _plan(body: _Body, edge: float) -> tuple[Array, int]:
    """Points in (s, y), shape (n, 2), the border's last, and how many are within the border."""
    half_s = body.arc(min(SHAPE.examined_half_m, 0.8 * float(body._x.max())))
    half_y = min(SHAPE.examined_half_m, 0.8 * body.half_length)
    outer = (body.half_arc, body.half_length)
    inside = np.concatenate((lattice(half_s, half_y, edge), rings(half_s, half_y, outer, edge)))
    end = _grade(outer[0], outer[1] - half_y, half_s, edge)
    side = _grade(outer[1], outer[0] - half_s, half_y, edge)[:-1]
    s_end = np.concatenate((-end[:0:-1], end))
    y_side = np.concatenate((-side[:0:-1], side))
    border = [np.column_stack((s_end, np.full_like(s_end, sign * outer[1]))) for sign in (-1, 1)]
    border += [np.column_stack((np.full_like(y_side, sign * outer[0]), y_side)) for sign in (-1, 1)]
    return np.concatenate((inside, *border)), len(inside)


def _close(plan: Array, inner: int, outer: tuple[float, float]) -> Ints32:
    """Triangles of both ends and of the back, shape (k, 3)."""
    index = np.arange(inner, len(plan))
    s, y = plan[inner:].T

    def chain(mask: Mask, key: Array) -> Indices:
        return np.asarray(index[mask][np.argsort(key[mask])], dtype=np.intp)

    parts = [_strip(chain((y == end) & (s <= 0), -s), chain((y == end) & (s >= 0), s)) for end in (-outer[1], outer[1])]
    parts.append(_strip(chain(s == -outer[0], y), chain(s == outer[0], y)))
    return np.concatenate(parts)


def _ordinary(length: float) -> Anatomy:
    """Return the default anatomy of a body of this length [m]."""
    usual, scale = Skeleton(), length / 0.46
    across, along = usual.iliac_crest_m
    skeleton = Skeleton.model_construct(  # without validation: a parametric body may exceed the limits of a person
        costal_arch_m=scale * usual.costal_arch_m,
        iliac_crest_m=(scale * across, scale * along),
        iliac_radius_m=scale * usual.iliac_radius_m,
    )
    return Anatomy(skeleton=skeleton)


@lru_cache(maxsize=8)
def parametric_surface(size_m: tuple[float, float, float], edge_m: float, anatomy: Anatomy | None = None) -> Shape:
    """The parametric abdomen of width, length and height `size_m` [m], edges up to `edge_m` [m] where it is examined.

    `anatomy` says where its bones are and how it is domed; without one, they are those of an ordinary body scaled to its length.
    The surface is closed: its ends and back are flat, and fixed. The umbilicus is a vertex at the origin of A.
    """
    body = _Body(size_m, anatomy or _ordinary(size_m[1]))
    spacing = edge_m
    for _ in range(2):  # the second lattice allows for how much the first one was stretched
        plan, inner = _plan(body, spacing)
        # Rounded: points of a ring lie on a circle, where the last bit, another on each processor, would choose the diagonal.
        skin = Delaunay(np.round(plan, 7)).simplices.astype(np.int32)
        vertices = body(plan[:, 0], plan[:, 1])
        fine = (np.abs(vertices[:, :2]) <= SHAPE.examined_half_m - edge_m).all(axis=1) & (vertices[:, 2] > -size_m[2] / 2)
        pairs = np.concatenate((skin[:, :2], skin[:, 1:], skin[:, ::2]))
        pairs = pairs[fine[pairs].all(axis=1)]
        longest = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1).max()
        if longest <= edge_m:
            break
        spacing *= 0.999 * edge_m / longest
    lid = _close(plan, inner, (body.half_arc, body.half_length))
    triangles = orient(vertices, np.concatenate((skin, lid)))
    fixed = np.zeros(len(vertices), dtype=np.bool_)
    fixed[inner:] = True
    return Shape(vertices, triangles, vertex_normals(vertices, triangles[: len(skin)]), fixed)
