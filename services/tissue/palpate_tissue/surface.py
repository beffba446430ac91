"""Surface geometry: the rest point under the indenter, and the normals of the deformed mesh."""

from typing import NamedTuple

import numpy as np
from scipy import sparse

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array, Indices
from palpate_models.numerics.vectors import Vector, add, dot, nearest_vertex, row, scale, subtract
from palpate_models.patient.phantom import PhantomModel

_FAR_M = 0.15
"""Distance beyond which the nearest vertex replaces the nearest point."""


class RestPoint(NamedTuple):
    """Point of the rest surface nearest to a point p, in A."""

    position: Array
    """[m], shape (3,)."""
    normal: Array
    """Outward unit normal, interpolated, shape (3,)."""
    height: float
    """Distance of p along that normal [m], positive outside."""
    stiffness: float
    """k_w there [N/m^3]."""


class SkinSurface:
    """Queries on a phantom's surface."""

    def __init__(self, model: PhantomModel) -> None:
        self._model = model
        self._normals = np.ascontiguousarray(model.normals.T)
        self._faces = _incident_faces(model)
        self._gradient = _gradient(model)
        self.nearest(model.vertices[0].copy())  # compiles the search before the first deadline

    def nearest(self, p: Array, excursion: float = 0.0) -> RestPoint:
        """Return the rest point nearest to `p` [m], shape (3,), at a breathing excursion [m].

        Interpolates between the corners of the nearest triangle; far away it uses the nearest vertex.
        """
        model = self._model
        distance, vertex = nearest_vertex(p, model.vertices)
        far = distance > _FAR_M
        corner, weights = np.full(3, vertex), np.array((1.0, 0.0, 0.0))
        if not far:
            shifted = p - excursion * model.breathing[vertex] * model.normals[vertex]
            corners = model.triangles[self._faces[vertex]]
            squares, barycentric = nearest_on_triangles(shifted, model.vertices[corners])
            least = squares.argmin()
            corner, weights = corners[least], barycentric[least]
        normal = weights @ model.normals[corner]
        normal /= np.linalg.norm(normal)
        position = weights @ model.vertices[corner] + excursion * (weights @ model.breathing[corner]) * normal
        height = np.linalg.norm(p - position) if far else (p - position) @ normal
        return RestPoint(position, normal, float(height), float(weights @ model.stiffness[corner]))

    def normals(self, inward: Array) -> Array:
        """Return unit normals, shape (3, n), of the surface whose vertices have moved `inward` (n,) [m] along their normals.

        n + grad u, normalised. Exact for a plane, and otherwise to first order in u times curvature.
        """
        tilted: Array = self._normals + (self._gradient @ inward).reshape(3, -1)
        tilted /= np.sqrt(np.einsum("ij,ij->j", tilted, tilted))
        return tilted


@compiled
def nearest_on_triangles(p: Array, corners: Array) -> tuple[Array, Array]:
    """Return square distances [m^2] of `p` from k triangles and barycentric coordinates of the nearest points.

    Shapes (k,) and (k, 3). The nearest point a + v (b - a) + w (c - a) is the projection of p on the plane if it lies inside,
    else that on a side.
    `corners` [m], shape (k, 3, 3), has a, b and c of each triangle as rows. Compiled because numpy would create 200 small arrays.
    """
    squares, weights = np.full(len(corners), np.inf), np.empty((len(corners), 3))
    point = row(p.reshape(1, 3), 0)
    for k in range(len(corners)):
        a, b, c = row(corners[k], 0), row(corners[k], 1), row(corners[k], 2)
        ab, ac, ap = subtract(b, a), subtract(c, a), subtract(point, a)
        g_bb, g_bc, g_cc, r_b, r_c = dot(ab, ab), dot(ab, ac), dot(ac, ac), dot(ab, ap), dot(ac, ap)
        determinant = g_bb * g_cc - g_bc * g_bc
        v, w = (g_cc * r_b - g_bc * r_c) / determinant, (g_bb * r_c - g_bc * r_b) / determinant
        on_ab, on_ac, on_bc = _share(ap, ab), _share(ap, ac), _share(subtract(point, b), subtract(c, b))
        for at in ((1 - v - w, v, w), (1 - on_ab, on_ab, 0.0), (1 - on_ac, 0.0, on_ac), (0.0, 1 - on_bc, on_bc)):
            if min(at) < 0.0:
                continue
            gap = subtract(ap, add(scale(at[1], ab), scale(at[2], ac)))
            if dot(gap, gap) < squares[k]:
                squares[k] = dot(gap, gap)
                weights[k] = at
    return squares, weights


@compiled
def _share(offset: Vector, side: Vector) -> float:
    """Return the projection of a point at `offset` [m] from the start of a `side` [m] as a fraction of the side, 0 to 1."""
    return min(max(dot(offset, side) / dot(side, side), 0.0), 1.0)


def _incident_faces(model: PhantomModel) -> list[Indices]:
    """Return the triangles at each vertex."""
    corner = model.triangles.ravel()
    order = np.argsort(corner, kind="stable")
    first = np.searchsorted(corner[order], np.arange(1, len(model.vertices)))
    return np.split(order // 3, first)


def _gradient(model: PhantomModel) -> sparse.csr_array:
    """Return the surface gradient [1/m] of a vertex field, area-weighted from triangles, shape (3 n, n): all x, all y, all z."""
    m, n = len(model.triangles), len(model.vertices)
    sides = model.vertices[model.triangles[:, 1:]] - model.vertices[model.triangles[:, :1]]
    flat = np.linalg.pinv(sides.transpose(0, 2, 1))  # offset from the first corner to barycentric coordinates, (m, 2, 3)
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    total = np.bincount(model.triangles.ravel(), np.repeat(area, 3), n)
    slopes = np.concatenate((-flat.sum(axis=1, keepdims=True), flat), axis=1)  # of the three hat functions, (m, 3, 3)
    share = area[:, None] / total[model.triangles]  # (m, 3): weight of a face at each corner
    values = share[:, :, None, None] * slopes[:, None, :, :]  # (m, at corner, of corner, axis)
    rows = np.broadcast_to(model.triangles[:, :, None], (m, 3, 3)).ravel()
    columns = np.broadcast_to(model.triangles[:, None, :], (m, 3, 3)).ravel()
    axes = [sparse.csr_array((values[..., axis].ravel(), (rows, columns)), shape=(n, n)) for axis in range(3)]
    return sparse.csr_array(sparse.vstack(axes))
