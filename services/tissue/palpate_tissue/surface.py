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
    """Signed distance of p [m], positive outside."""
    stiffness: float
    """k_w there [N/m^3]."""


class Surface:
    """Queries on a phantom's surface, its breathing included."""

    def __init__(self, model: PhantomModel) -> None:
        self._model = model
        self._tree = cKDTree(model.vertices)
        m, n = len(model.triangles), len(model.vertices)
        corner = model.triangles.ravel()
        face = np.repeat(np.arange(m), 3)
        order = np.argsort(corner, kind="stable")
        self._faces = face[order]
        self._first = np.searchsorted(corner[order], np.arange(n + 1))
        self._incidence = sparse.csr_array((np.ones(3 * m), (corner, face)), shape=(n, m))

    def nearest(self, p: Array, excursion: float = 0.0) -> RestPoint:
        """The rest point nearest to `p` [m], shape (3,), at a breathing excursion [m]."""
        model = self._model
        distance, near = self._tree.query(p, k=4)
        if distance[0] > _FAR_M:
            corners = np.array([[near[0]] * 3])
            weights = np.array([[1.0, 0.0, 0.0]])
        else:
            faces = np.unique(np.concatenate([self._faces[self._first[v] : self._first[v + 1]] for v in near]))
            corners = model.triangles[faces]
            weights = np.empty(0)
        normals = model.normals[corners]
        points = model.vertices[corners] + (excursion * model.breathing[corners])[..., None] * normals
        if not weights.size:
            weights = nearest_weights(p, points)
        at = np.einsum("fk,fkx->fx", weights, points)
        best = int(np.argmin(((p - at) ** 2).sum(axis=1)))
        normal = weights[best] @ normals[best]
        normal /= np.linalg.norm(normal)
        offset = p - at[best]
        height = float(np.copysign(np.linalg.norm(offset), offset @ normal))
        return RestPoint(at[best], normal, height, float(weights[best] @ model.stiffness[corners[best]]))

    def normals(self, vertices: Array) -> Array:
        """Unit vertex normals of the mesh with its vertices moved to (n, 3), shape (n, 3)."""
        corners = vertices[self._model.triangles]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals = self._incidence @ cross
        return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300))


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
    if len(outside):
        nearest = np.full(len(outside), np.inf)
        for i, j in ((0, 1), (1, 2), (2, 0)):
            start, edge = triangles[outside, i], triangles[outside, j] - triangles[outside, i]
            t = np.clip(((p - start) * edge).sum(1) / (edge * edge).sum(1), 0, 1)
            distance = ((p - start - t[:, None] * edge) ** 2).sum(1)
            closer = distance < nearest
            nearest = np.where(closer, distance, nearest)
            on_edge = np.zeros((len(outside), 3))
            on_edge[:, i], on_edge[:, j] = 1 - t, t
            weights[outside[closer]] = on_edge[closer]
    return weights
