"""Mesh geometry for drawing: vertex normals, shading, and transfer of values between meshes."""

from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

Array = NDArray[np.floating[Any]]
Indices = NDArray[np.integer[Any]]


class VertexNormals:
    """Computes outward unit normals of a deforming mesh with fixed triangles."""

    def __init__(self, triangles: Indices, vertices: int) -> None:
        """`triangles`: shape (m, 3), counter-clockwise seen from outside; `vertices`: their number."""
        self._triangles = triangles
        columns = np.repeat(np.arange(len(triangles)), 3)
        ones = np.ones(columns.size, dtype=np.float32)
        self._sum = csr_array((ones, (triangles.ravel(), columns)), shape=(vertices, len(triangles)))

    def __call__(self, positions: Array) -> NDArray[np.float32]:
        """Return area-weighted normals, shape (n, 3), at `positions` [m], shape (n, 3)."""
        a, b, c = (positions[self._triangles[:, i]] for i in range(3))
        normals = np.asarray(self._sum @ np.cross(b - a, c - a).astype(np.float32))
        length = np.sqrt(np.einsum("ij,ij->i", normals, normals))
        return np.asarray(normals / np.maximum(length, 1e-20)[:, None], dtype=np.float32)


def shaded(
    vertices: Array, triangles: Indices, crease_rad: float = 0.6
) -> tuple[NDArray[np.float32], Indices, NDArray[np.float32]]:
    """Return a rigid mesh for shading: smooth, but sharp where faces meet at more than `crease_rad`.

    Vertices on a crease are doubled. Returns vertices, shape (k, 3), triangles, shape (m, 3), and unit normals, shape (k, 3).
    """
    mesh = trimesh.graph.smooth_shade(trimesh.Trimesh(vertices, triangles, process=False), angle=crease_rad)
    return mesh.vertices.astype(np.float32), np.asarray(mesh.faces), mesh.vertex_normals.astype(np.float32)


class Carry:
    """Transfers values from the vertices of one mesh to those of another, from the nearest within a reach."""

    def __init__(self, source: Array, target: Array, reach: float) -> None:
        """`source` and `target`: vertex positions in one frame [m], shapes (n, 3) and (m, 3)."""
        distance, index = cKDTree(source).query(target, k=1, workers=1)
        self._index: NDArray[np.intp] = np.asarray(index)
        self._within = np.asarray(distance) <= reach

    def __call__(self, values: NDArray[Any], missing: Any) -> NDArray[Any]:
        """Return `values`, shape (n,), at the target's vertices, shape (m,); `missing` without a source vertex in reach."""
        return np.where(self._within, values[self._index], missing)
