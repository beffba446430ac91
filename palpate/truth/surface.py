"""True rest surface as functions of xy in the abdomen frame A, and the places on it that the tool touched."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay, cKDTree

from palpate_models.numerics.frames import Array


@dataclass(frozen=True)
class TrueBody:
    """The body at rest, as a mesh."""

    vertices: Array
    """[m], shape (n, 3), in A."""
    triangles: NDArray[np.int32]
    """Shape (m, 3), counter-clockwise seen from outside."""
    X_WA: Array
    """True pose of A in world, shape (4, 4)."""


class TrueSurface:
    """The front side of the true rest surface as functions of xy, in A."""

    def __init__(self, body: TrueBody) -> None:
        corners = body.vertices[body.triangles]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        facing = normal[:, 2] > 0.1 * np.linalg.norm(normal, axis=1)
        front = np.unique(body.triangles[facing])
        mesh = Delaunay(body.vertices[front, :2])
        total = np.zeros((len(body.vertices), 3))
        for k in range(3):
            np.add.at(total, body.triangles[facing, k], normal[facing])
        unit = total[front] / np.linalg.norm(total[front], axis=1, keepdims=True)
        self._mesh, self._front = mesh, front
        self._height = LinearNDInterpolator(mesh, body.vertices[front, 2])
        self._normal = LinearNDInterpolator(mesh, unit)

    def between(self, values: Array) -> LinearNDInterpolator:
        """Return an interpolator of values at the vertices, shape (n,): xy, shape (p, 2) -> (p,); NaN off the surface."""
        return LinearNDInterpolator(self._mesh, values[self._front])

    def points(self, xy: Array) -> tuple[Array, Array]:
        """Return points of the surface [m] and outward unit normals, each of shape (p, 3); NaN off the surface."""
        normal = np.asarray(self._normal(xy))
        return np.column_stack((xy, self.height(xy))), normal / np.linalg.norm(normal, axis=1, keepdims=True)

    def height(self, xy: Array) -> Array:
        """Return height z [m] at points, shape (p,); NaN off the surface."""
        return np.asarray(self._height(xy))

    def steepness(self, xy: Array) -> Array:
        """Return area of the surface over area in xy at points [1], shape (p,)."""
        normal = np.asarray(self._normal(xy))
        return np.asarray(np.nan_to_num(np.linalg.norm(normal, axis=1) / normal[:, 2], nan=1.0))


_NEAREST: Final = 4
"""Number of nearest contacts whose errors are averaged, weighted by inverse distance."""


class Touched:
    """Contacts of a run: k estimated and true places on the skin.

    Kinematics and registration have lateral errors, so an estimate at a place is compared with the truth at the place that the
    tool actually touched.
    """

    def __init__(self, believed: Array, true: Array) -> None:
        """Both [m], shape (k, 3), in the registered and in the true A. Without contacts places are unchanged."""
        self.believed, self.true = believed, true
        self._tree = cKDTree(believed[:, :2]) if len(believed) else None

    def places(self, xy: Array) -> Array:
        """Return true places of the tool for estimated ones xy [m], both of shape (p, 2)."""
        if self._tree is None:
            return xy
        count = min(_NEAREST, len(self.believed))
        distance, index = (np.asarray(a).reshape(len(xy), count) for a in self._tree.query(xy, k=count))
        weight = 1.0 / (distance + 1e-4)
        weight /= weight.sum(axis=1, keepdims=True)
        shift = (self.true - self.believed)[index, :2]
        return np.asarray(xy + (weight[..., None] * shift).sum(axis=1))
