"""Geometry of the surface: the rest point under the indenter, and the normals of the deformed mesh."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate_models.compiled import compiled
from palpate_models.nearest import nearest_vertex
from palpate_models.phantom import PhantomModel

Array = NDArray[np.float64]
Index = NDArray[np.uint32]
Single = NDArray[np.float32]

_FAR_M = 0.15
"""Further away than this, the nearest vertex stands for the nearest point."""


@dataclass(frozen=True)
class RestPoint:
    """The point of the rest surface that is nearest to a point p, in A."""

    position: Array
    """[m], shape (3,)."""
    normal: Array
    """Outward unit normal, interpolated, shape (3,)."""
    height: float
    """Distance of p along that normal [m], positive outside."""
    stiffness: float
    """k_w there [N/m^3]."""


class Surface:
    """Queries on a phantom's surface."""

    def __init__(self, model: PhantomModel) -> None:
        self._model = model
        corners = model.vertices[model.triangles]
        sides = corners[:, 1:] - corners[:, :1]
        self._triangles = np.ascontiguousarray(model.triangles, np.uint32)
        self._faces = _incident_faces(model)
        # Maps an offset from the first corner to its barycentric coordinates, shape (m, 2, 3).
        self._gradient = _gradient(model, np.linalg.pinv(sides.transpose(0, 2, 1)).astype(np.float64))
        self.normals(np.zeros(len(model.vertices)), np.eye(3))  # compiles what it calls, and so do the next two
        placed(model.vertices, np.eye(3), np.zeros(3))
        self._fields = np.column_stack((model.breathing, model.stiffness))
        self.nearest(model.vertices[0].copy())

    def nearest(self, p: Array, excursion: float = 0.0) -> RestPoint:
        """The rest point nearest to `p` [m], shape (3,), at a breathing excursion [m]."""
        model = self._model
        distance, vertex = nearest_vertex(p, model.vertices)
        faces = self._faces[vertex]
        found = np.empty(8)
        rest_point(
            p, vertex, distance <= _FAR_M, excursion, faces, self._triangles, model.vertices, model.normals, self._fields, found
        )
        return RestPoint(found[0:3], found[3:6], float(found[6]), float(found[7]))

    def normals(self, inward: Array, R: Array) -> Single:
        """Unit vertex normals, in axes that `R` (3, 3) takes them to, one after the other, shape (3 n,).

        Of the surface whose vertices have moved `inward` by (n,) [m] along their normals: n + grad u, normalised. Exact for a
        plane, and otherwise to first order in u times curvature.
        """
        return tilted(inward, self._model.normals, *self._gradient, R)


def _incident_faces(model: PhantomModel) -> list[Index]:
    """The triangles at each vertex."""
    corner = model.triangles.ravel()
    order = np.argsort(corner, kind="stable")
    first = np.searchsorted(corner[order], np.arange(1, len(model.vertices)))
    return np.split((order // 3).astype(np.uint32), first)


def _gradient(model: PhantomModel, flat: Array) -> tuple[Index, Index, Array]:
    """Surface gradient [1/m] of a field at the vertices, area-weighted from the triangles: rows of vertices in CSR form.

    Where each begins, (n + 1,), the vertices it takes the field at, (k,), and their three slopes, (k, 3).
    """
    m, n = len(model.triangles), len(model.vertices)
    sides = model.vertices[model.triangles[:, 1:]] - model.vertices[model.triangles[:, :1]]
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    total = np.bincount(model.triangles.ravel(), np.repeat(area, 3), n)
    slopes = np.concatenate((-flat.sum(axis=1, keepdims=True), flat), axis=1)  # of the three hat functions, (m, 3, 3)
    share = area[:, None] / total[model.triangles]  # (m, 3): a face's weight at each of its corners
    values = share[:, :, None, None] * slopes[:, None, :, :]  # (m, at corner, of corner, axis)
    rows = np.broadcast_to(model.triangles[:, :, None], (m, 3, 3)).ravel()
    columns = np.broadcast_to(model.triangles[:, None, :], (m, 3, 3)).ravel()
    axes = [sparse.csr_array((values[..., axis].ravel(), (rows, columns)), shape=(n, n)) for axis in range(3)]
    slope = np.column_stack([part.data for part in axes])
    return axes[0].indptr.astype(np.uint32), axes[0].indices.astype(np.uint32), slope


@compiled
def tilted(inward: Array, normals: Array, indptr: Index, indices: Index, slope: Array, R: Array) -> Single:
    """The unit normals of a deformed surface, turned by `R`; see `Surface.normals` and `_gradient`."""
    out = np.empty(normals.size, np.float32)
    for i in range(inward.shape[0]):
        x, y, z = normals[i, 0], normals[i, 1], normals[i, 2]
        for j in range(indptr[i], indptr[i + 1]):
            u = inward[indices[j]]
            x += slope[j, 0] * u
            y += slope[j, 1] * u
            z += slope[j, 2] * u
        length = sqrt(x * x + y * y + z * z)
        x, y, z = x / length, y / length, z / length
        for k in range(3):
            out[3 * i + k] = R[k, 0] * x + R[k, 1] * y + R[k, 2] * z
    return out


@compiled
def placed(vertices: Array, R: Array, p: Array) -> Single:
    """Points (n, 3) in other axes and from another origin, R x + p, one after the other, shape (3 n,)."""
    out = np.empty(vertices.size, np.float32)
    for i in range(vertices.shape[0]):
        x, y, z = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        for k in range(3):
            out[3 * i + k] = R[k, 0] * x + R[k, 1] * y + R[k, 2] * z + p[k]
    return out


@compiled
def nearest_on_faces(p: Array, faces: Index, triangles: Index, vertices: Array, weights: Array) -> int:
    """The face, among some, that is nearest to `p` (3,); `weights` (3,) get the barycentric coordinates of its nearest point."""
    best = -1
    least = np.inf
    for face in faces:
        a, b, c = vertices[triangles[face, 0]], vertices[triangles[face, 1]], vertices[triangles[face, 2]]
        d11 = d12 = d22 = d1 = d2 = 0.0
        for k in range(3):
            ab, ac, ap = b[k] - a[k], c[k] - a[k], p[k] - a[k]
            d11 += ab * ab
            d12 += ab * ac
            d22 += ac * ac
            d1 += ab * ap
            d2 += ac * ap
        determinant = d11 * d22 - d12 * d12
        v, w = (d22 * d1 - d12 * d2) / determinant, (d11 * d2 - d12 * d1) / determinant
        if v < 0.0 or w < 0.0 or v + w > 1.0:  # outside: the nearest point is on one of the sides
            on_ab = min(max(d1 / d11, 0.0), 1.0)
            on_ac = min(max(d2 / d22, 0.0), 1.0)
            # Along bc, from b: (p - b).(c - b) = (ap - ab).(ac - ab).
            on_bc = min(max((d2 - d1 - d12 + d11) / (d11 - 2.0 * d12 + d22), 0.0), 1.0)
            closest = np.inf
            for tv, tw in ((on_ab, 0.0), (0.0, on_ac), (1.0 - on_bc, on_bc)):
                distance = _square_distance(p, a, b, c, tv, tw)
                if distance < closest:
                    closest, v, w = distance, tv, tw
        distance = _square_distance(p, a, b, c, v, w)
        if distance < least:
            least, best = distance, int(face)
            weights[0], weights[1], weights[2] = 1.0 - v - w, v, w
    return best


@compiled
def rest_point(
    p: Array,
    vertex: int,
    near: bool,
    excursion: float,
    faces: Index,
    triangles: Index,
    vertices: Array,
    normals: Array,
    fields: Array,
    out: Array,
) -> None:
    """The rest point under `p` (3,), near a vertex with its `faces`: position, unit normal, height and stiffness in `out` (8,).

    Where `p` is not `near`, the vertex itself. `fields` (n, 2): share of the breathing excursion, k_w [N/m^3].
    """
    weights = np.empty(3)
    a = b = c = vertex
    weights[0], weights[1], weights[2] = 1.0, 0.0, 0.0
    if near:
        shifted = np.empty(3)
        for k in range(3):
            shifted[k] = p[k] - excursion * fields[vertex, 0] * normals[vertex, k]
        face = nearest_on_faces(shifted, faces, triangles, vertices, weights)
        a, b, c = triangles[face, 0], triangles[face, 1], triangles[face, 2]
    length = height = distance = 0.0
    for k in range(3):
        out[3 + k] = weights[0] * normals[a, k] + weights[1] * normals[b, k] + weights[2] * normals[c, k]
        length += out[3 + k] * out[3 + k]
    lift = excursion * (weights[0] * fields[a, 0] + weights[1] * fields[b, 0] + weights[2] * fields[c, 0])
    for k in range(3):
        out[3 + k] /= sqrt(length)
        out[k] = weights[0] * vertices[a, k] + weights[1] * vertices[b, k] + weights[2] * vertices[c, k] + lift * out[3 + k]
        height += (p[k] - out[k]) * out[3 + k]
        distance += (p[k] - out[k]) ** 2
    out[6] = height if near else sqrt(distance)
    out[7] = weights[0] * fields[a, 1] + weights[1] * fields[b, 1] + weights[2] * fields[c, 1]


@compiled
def _square_distance(p: Array, a: Array, b: Array, c: Array, v: float, w: float) -> float:
    """Of `p` from the point a + v (b - a) + w (c - a)."""
    total = 0.0
    for k in range(3):
        offset = p[k] - (a[k] + v * (b[k] - a[k]) + w * (c[k] - a[k]))
        total += offset * offset
    return total
