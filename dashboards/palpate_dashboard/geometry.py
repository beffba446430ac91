"""Geometry of what is drawn: normals of a deforming mesh, outlines of lesions, values carried from one mesh to another."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

Array = NDArray[np.floating[Any]]
Indices = NDArray[np.integer[Any]]


class VertexNormals:
    """Outward unit normals of the vertices of a mesh whose triangles stay and whose vertices move."""

    def __init__(self, triangles: Indices, vertices: int) -> None:
        """`triangles`: shape (m, 3), counter-clockwise seen from outside; `vertices`: how many there are."""
        self._triangles = triangles
        columns = np.repeat(np.arange(len(triangles)), 3)
        ones = np.ones(columns.size, dtype=np.float32)
        self._sum = csr_array((ones, (triangles.ravel(), columns)), shape=(vertices, len(triangles)))

    def __call__(self, positions: Array) -> NDArray[np.float32]:
        """Area-weighted normals, shape (n, 3), at `positions` [m], shape (n, 3)."""
        a, b, c = (positions[self._triangles[:, i]] for i in range(3))
        normals = np.asarray(self._sum @ np.cross(b - a, c - a).astype(np.float32))
        length = np.sqrt(np.einsum("ij,ij->i", normals, normals))
        return np.asarray(normals / np.maximum(length, 1e-20)[:, None], dtype=np.float32)


def creased(
    vertices: Array, triangles: Indices, crease_rad: float = 0.6
) -> tuple[NDArray[np.float32], Indices, NDArray[np.float32]]:
    """A still mesh ready for shading: smooth, but sharp where faces meet at more than `crease_rad`.

    Vertices on a crease are doubled. Returns vertices, shape (k, 3), triangles, shape (m, 3), unit normals, shape (k, 3).
    """
    corners = vertices[triangles]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    unit = area / np.maximum(np.linalg.norm(area, axis=1), 1e-20)[:, None]
    at = triangles.ravel()
    face = np.repeat(np.arange(len(triangles)), 3)
    ones = np.ones(at.size)
    corner_of = csr_array((ones, (np.arange(at.size), at)), shape=(at.size, len(vertices)))
    face_at = csr_array((ones, (at, face)), shape=(len(vertices), len(triangles)))
    pairs = (corner_of @ face_at).tocoo()  # each corner with every face about its vertex
    corner, other = pairs.coords
    smooth = np.einsum("ij,ij->i", unit[face[corner]], unit[other]) > np.cos(crease_rad)
    weights = csr_array((ones[:1].repeat(smooth.sum()), (corner[smooth], other[smooth])), shape=pairs.shape)
    normals = np.asarray(weights @ area)
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-20)[:, None]
    keys = np.column_stack((at, np.round(normals, 2)))
    _, first, index = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return vertices[at[first]].astype(np.float32), index.reshape(-1, 3), normals[first].astype(np.float32)


class Carry:
    """Carries values from the vertices of one mesh to the nearest ones of another, within a reach."""

    def __init__(self, source: Array, target: Array, reach: float) -> None:
        """`source` and `target`: vertex positions in one frame [m], shapes (n, 3) and (m, 3)."""
        distance, index = cKDTree(source).query(target, k=1, workers=1)
        self._index: NDArray[np.intp] = np.asarray(index)
        self._within = np.asarray(distance) <= reach

    def __call__(self, values: NDArray[Any], missing: Any) -> NDArray[Any]:
        """`values`, shape (n,), at the target's vertices, shape (m,); `missing` where no source vertex is in reach."""
        return np.where(self._within, values[self._index], missing)
