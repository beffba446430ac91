"""Geometry of the surface: the rest point under the indenter, and the normals of the deformed mesh."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate_models.compiled import compiled
from palpate_models.frames import Array
from palpate_models.nearest import nearest_vertex
from palpate_models.phantom import PhantomModel
from palpate_models.vectors import Vector, add, divide, dot, norm, row, scale, subtract

_FAR_M = 0.15
"""Further away than this, the nearest vertex stands for the nearest point."""
_NO_FACES: NDArray[np.uint32] = np.empty(0, np.uint32)


class RestPoint(NamedTuple):
    """The point of the rest surface that is nearest to a point p, in A."""

    position: Array
    """[m], shape (3,)."""
    normal: Array
    """Outward unit normal, interpolated, shape (3,)."""
    height: float
    """Distance of p along that normal [m], positive outside."""
    stiffness: float
    """k_w there [N/m^3]."""


class Skin(NamedTuple):
    """The rest surface: n vertices, m triangles."""

    vertices: Array
    """[m], shape (n, 3)."""
    normals: Array
    """Outward unit normals, shape (n, 3)."""
    breathing: Array
    """Share of the breathing excursion, shape (n,)."""
    stiffness: Array
    """k_w [N/m^3], shape (n,)."""
    triangles: NDArray[np.uint32]
    """Shape (m, 3)."""


class SkinSurface:
    """Queries on a phantom's surface."""

    def __init__(self, model: PhantomModel) -> None:
        triangles = model.triangles.astype(np.uint32)
        self._skin = Skin(model.vertices, model.normals, model.breathing, model.stiffness, triangles)
        self._normals = np.ascontiguousarray(model.normals.T)
        self._faces = _incident_faces(model)
        self._gradient = _gradient(model)
        self.nearest(model.vertices[0].copy())  # compiles it before it has a deadline

    def nearest(self, p: Array, excursion: float = 0.0) -> RestPoint:
        """The rest point nearest to `p` [m], shape (3,), at a breathing excursion [m]."""
        distance, vertex = nearest_vertex(p, self._skin.vertices)
        faces = self._faces[vertex] if distance <= _FAR_M else _NO_FACES
        position, normal, height, stiffness = rest_point(self._skin, faces, vertex, tuple(p.tolist()), excursion)
        return RestPoint(np.array(position), np.array(normal), height, stiffness)

    def normals(self, inward: Array) -> Array:
        """Unit normals of the surface whose vertices have moved `inward` by (n,) [m] along their normals, shape (3, n).

        n + grad u, normalised. Exact for a plane, and otherwise to first order in u times curvature.
        """
        tilted: Array = self._normals + (self._gradient @ inward).reshape(3, -1)
        tilted /= np.sqrt(np.einsum("ij,ij->j", tilted, tilted))
        return tilted


@compiled
def rest_point(
    skin: Skin, faces: NDArray[np.uint32], vertex: int, p: Vector, excursion: float
) -> tuple[Vector, Vector, float, float]:
    """The point of the `faces` around a `vertex` that is nearest to `p` [m], as the fields of `RestPoint`.

    At a breathing excursion [m]. It is interpolated between the corners of its face; without faces it is the vertex itself.
    """
    corner, weights = (vertex, vertex, vertex), (1.0, 0.0, 0.0)
    shifted = subtract(p, scale(excursion * skin.breathing[vertex], row(skin.normals, vertex)))
    least = np.inf
    for face in faces:
        a, b, c = skin.triangles[face, 0], skin.triangles[face, 1], skin.triangles[face, 2]
        square, at = nearest_on_triangle(shifted, row(skin.vertices, a), row(skin.vertices, b), row(skin.vertices, c))
        if square < least:
            least, corner, weights = square, (int(a), int(b), int(c)), at
    normal = _mean(skin.normals, corner, weights)
    normal = divide(normal, norm(normal))
    rest = _mean(skin.vertices, corner, weights)
    breathing = stiffness = 0.0
    for k in range(3):
        breathing += weights[k] * skin.breathing[corner[k]]
        stiffness += weights[k] * skin.stiffness[corner[k]]
    position = add(rest, scale(excursion * breathing, normal))
    offset = subtract(p, position)
    return position, normal, dot(offset, normal) if len(faces) else norm(offset), stiffness


@compiled
def nearest_on_triangle(p: Vector, a: Vector, b: Vector, c: Vector) -> tuple[float, Vector]:
    """Square distance [m^2] of `p` from a triangle, and the barycentric coordinates of its nearest point.

    The point a + v (b - a) + w (c - a) is p's projection on the plane where that lies inside, else the nearest one of a side.
    """
    ab, ac, ap = subtract(b, a), subtract(c, a), subtract(p, a)
    bc = subtract(c, b)
    g11, g12, g22, r1, r2 = dot(ab, ab), dot(ab, ac), dot(ac, ac), dot(ab, ap), dot(ac, ap)
    determinant = g11 * g22 - g12 * g12
    v, w = (g22 * r1 - g12 * r2) / determinant, (g11 * r2 - g12 * r1) / determinant
    if v >= 0.0 and w >= 0.0 and v + w <= 1.0:
        return _square_distance(ap, ab, ac, v, w), (1.0 - v - w, v, w)
    on_ab, on_ac = min(max(r1 / g11, 0.0), 1.0), min(max(r2 / g22, 0.0), 1.0)
    on_bc = min(max(dot(bc, subtract(p, b)) / dot(bc, bc), 0.0), 1.0)
    least, best = np.inf, (1.0, 0.0, 0.0)
    for v, w in ((on_ab, 0.0), (0.0, on_ac), (1.0 - on_bc, on_bc)):
        square = _square_distance(ap, ab, ac, v, w)
        if square < least:
            least, best = square, (1.0 - v - w, v, w)
    return least, best


@compiled
def _square_distance(ap: Vector, ab: Vector, ac: Vector, v: float, w: float) -> float:
    """|ap - v ab - w ac|^2."""
    offset = subtract(ap, add(scale(v, ab), scale(w, ac)))
    return dot(offset, offset)


@compiled
def _mean(table: Array, corner: tuple[int, int, int], weights: Vector) -> Vector:
    """The rows of three corners, weighted."""
    mean = add(scale(weights[0], row(table, corner[0])), scale(weights[1], row(table, corner[1])))
    return add(mean, scale(weights[2], row(table, corner[2])))


def _incident_faces(model: PhantomModel) -> list[NDArray[np.uint32]]:
    """The triangles at each vertex."""
    corner = model.triangles.ravel()
    order = np.argsort(corner, kind="stable")
    first = np.searchsorted(corner[order], np.arange(1, len(model.vertices)))
    return np.split((order // 3).astype(np.uint32), first)


def _gradient(model: PhantomModel) -> sparse.csr_array:
    """Surface gradient [1/m] of a field at the vertices, area-weighted from triangles, shape (3 n, n): all x, all y, all z."""
    m, n = len(model.triangles), len(model.vertices)
    sides = model.vertices[model.triangles[:, 1:]] - model.vertices[model.triangles[:, :1]]
    flat = np.linalg.pinv(sides.transpose(0, 2, 1))  # an offset from the first corner to its barycentric coordinates, (m, 2, 3)
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    total = np.bincount(model.triangles.ravel(), np.repeat(area, 3), n)
    slopes = np.concatenate((-flat.sum(axis=1, keepdims=True), flat), axis=1)  # of the three hat functions, (m, 3, 3)
    share = area[:, None] / total[model.triangles]  # (m, 3): a face's weight at each of its corners
    values = share[:, :, None, None] * slopes[:, None, :, :]  # (m, at corner, of corner, axis)
    rows = np.broadcast_to(model.triangles[:, :, None], (m, 3, 3)).ravel()
    columns = np.broadcast_to(model.triangles[:, None, :], (m, 3, 3)).ravel()
    axes = [sparse.csr_array((values[..., axis].ravel(), (rows, columns)), shape=(n, n)) for axis in range(3)]
    return sparse.csr_array(sparse.vstack(axes))
