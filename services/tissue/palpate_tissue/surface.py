"""Geometry of the surface: the rest point under the indenter, and the normals of the deformed mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from palpate_models.phantom import PhantomModel
from scipy import sparse
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

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
        self._tree = cKDTree(model.vertices)
        corners = model.vertices[model.triangles]
        self._corner = corners[:, 0]
        sides = corners[:, 1:] - corners[:, :1]
        # Maps an offset from the first corner to its barycentric coordinates, shape (m, 2, 3).
        self._flat: Array = np.linalg.pinv(sides.transpose(0, 2, 1)).astype(np.float64)
        self._faces = _incident_faces(model)
        self._gradient = _gradient(model, self._flat)

    def nearest(self, p: Array, excursion: float = 0.0) -> RestPoint:
        """The rest point nearest to `p` [m], shape (3,), at a breathing excursion [m]."""
        model = self._model
        distance, vertex = self._tree.query(p)
        if distance > _FAR_M:
            corners, weights = np.array([vertex]), np.ones(1)
        else:
            shifted = p - excursion * model.breathing[vertex] * model.normals[vertex] if excursion else p
            corners, weights = self._project(shifted, self._faces[vertex])
        normal = weights @ model.normals[corners]
        normal /= np.sqrt(normal @ normal)
        position = weights @ model.vertices[corners]
        if excursion:
            position += excursion * (weights @ model.breathing[corners]) * normal
        offset = p - position
        length = np.sqrt(offset @ offset)
        height = float(offset @ normal) if distance <= _FAR_M else float(length)
        return RestPoint(position, normal, height, float(weights @ model.stiffness[corners]))

    def _project(self, p: Array, faces: NDArray[np.intp]) -> tuple[NDArray[np.int32], Array]:
        """The vertices (3,) of the face nearest to `p` among some, and the nearest point's barycentric coordinates (3,)."""
        offset = p - self._corner[faces]
        vw = (self._flat[faces] * offset[:, None, :]).sum(axis=2)
        least = np.minimum(vw.min(axis=1), 1 - vw.sum(axis=1))
        best = int(least.argmax())
        if least[best] >= 0:  # over one face; over several only beneath a concave edge, where they hardly differ
            v, w = vw[best]
            return self._model.triangles[faces[best]], np.array((1 - v - w, v, w))
        corners = self._model.triangles[faces]
        points = self._model.vertices[corners]
        weights = nearest_weights(p, points)
        at = (weights[:, :, None] * points).sum(axis=1)
        best = int(((p - at) ** 2).sum(axis=1).argmin())
        return corners[best], weights[best]

    def normals(self, inward: Array) -> Array:
        """Unit vertex normals (n, 3) of the surface whose vertices have moved inward by (n,) [m] along their normals.

        n + grad u, normalised: exact for a plane, and otherwise to first order in u times curvature.
        """
        normals = self._model.normals + (self._gradient @ inward).reshape(-1, 3)
        normals /= np.sqrt(np.einsum("ij,ij->i", normals, normals))[:, None]
        return np.asarray(normals)


def _incident_faces(model: PhantomModel) -> list[NDArray[np.intp]]:
    """The triangles at each vertex."""
    corner = model.triangles.ravel()
    order = np.argsort(corner, kind="stable")
    first = np.searchsorted(corner[order], np.arange(1, len(model.vertices)))
    return np.split(order // 3, first)


def _gradient(model: PhantomModel, flat: Array) -> sparse.csr_array:
    """Surface gradient [1/m] of a field at the vertices, area-weighted from the triangles, shape (3 n, n)."""
    m, n = len(model.triangles), len(model.vertices)
    sides = model.vertices[model.triangles[:, 1:]] - model.vertices[model.triangles[:, :1]]
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    total = np.bincount(model.triangles.ravel(), np.repeat(area, 3), n)
    slopes = np.concatenate((-flat.sum(axis=1, keepdims=True), flat), axis=1)  # of the three hat functions, (m, 3, 3)
    share = area[:, None] / total[model.triangles]  # (m, 3): a face's weight at each of its corners
    values = share[:, :, None, None] * slopes[:, None, :, :]  # (m, at corner, of corner, axis)
    rows = 3 * model.triangles[:, :, None, None] + np.arange(3)
    columns = np.broadcast_to(model.triangles[:, None, :, None], (m, 3, 3, 3))
    rows = np.broadcast_to(rows, (m, 3, 3, 3))
    return sparse.csr_array((values.ravel(), (rows.ravel(), columns.ravel())), shape=(3 * n, n))


def nearest_weights(p: Array, triangles: Array) -> Array:
    """Barycentric coordinates (m, 3) of the point of each triangle (m, 3, 3) that is nearest to `p` (3,)."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    ab, ac, ap = b - a, c - a, p - a
    d11, d12, d22 = (ab * ab).sum(1), (ab * ac).sum(1), (ac * ac).sum(1)
    d1, d2 = (ab * ap).sum(1), (ac * ap).sum(1)
    determinant = d11 * d22 - d12 * d12
    v = (d22 * d1 - d12 * d2) / determinant
    w = (d11 * d2 - d12 * d1) / determinant
    weights = np.stack((1 - v - w, v, w), axis=1)
    outside = np.flatnonzero((weights < 0).any(axis=1))
    nearest = np.full(len(outside), np.inf)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        start, edge = triangles[outside, i], triangles[outside, j] - triangles[outside, i]
        t = np.clip(((p - start) * edge).sum(1) / (edge * edge).sum(1), 0, 1)
        distance = ((p - start - t[:, None] * edge) ** 2).sum(1)
        closer = distance < nearest
        nearest = np.where(closer, distance, nearest)
        on_edge = np.zeros((len(outside), 3))
        on_edge[np.arange(len(outside)), i], on_edge[np.arange(len(outside)), j] = 1 - t, t
        weights[outside[closer]] = on_edge[closer]
    return weights
