"""Our tissue with the vertices, springs, edges and damping of a DART soft body.

DART gives each vertex one stiffness k_v, each edge k_e (on displacement differences) and each vertex one damping. Ours wants
a foundation modulus, vertex areas and a Laplacian: with one area A everywhere k_w = k_v / A, G = k_w l^2 = k_e with the graph's
Laplacian, and dashpot_s = damping / k_v are the same equations, but for DART's masses and its three coordinates a vertex.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate_models.numerics.frames import Array
from palpate_models.patient.phantom import PhantomModel
from palpate_models.patient.schema import Stiffness
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_validation.dart_scene import Ellipsoid, Flesh, SoftBox

IntArray = NDArray[np.int32]

AREA_M2 = 2.5e-5
"""Area of a vertex [m^2]; any value gives the same tissue."""


def twin(flesh: Flesh) -> WinklerTissue:
    """Our tissue with the same vertices and parameters, without friction and relaxation."""
    if isinstance(flesh.shape, SoftBox):
        vertices, normals = box_surface(flesh.shape)
        edges = np.empty((0, 2), dtype=np.int32)
    else:
        vertices, normals = ellipsoid_surface(flesh.shape)
        edges = ellipsoid_edges(flesh.shape)
    n = len(vertices)
    k_w = np.full(n, flesh.k_v / AREA_M2)
    model = PhantomModel(
        vertices=vertices,
        triangles=np.empty((0, 3), dtype=np.int32),
        normals=normals,
        areas=np.full(n, AREA_M2),
        laplacian=graph_laplacian(edges, n),
        stiffness=k_w,
        background=k_w,
        lesion=np.full(n, -1, dtype=np.int32),
        fixed=np.zeros(n, dtype=np.bool_),
        breathing=np.zeros(n),
        stiffening=np.zeros(n),
        tension=np.zeros(n),
    )
    length = float(np.sqrt(flesh.k_e / k_w[0])) if len(edges) else Stiffness().length_m
    wall = Stiffness(
        k_w_n_per_m3=float(k_w[0]), length_m=length, dashpot_s=flesh.damping / flesh.k_v, prony_g=(), prony_tau_s=(), friction=0.0
    )
    return WinklerTissue(model, wall)


def graph_laplacian(edges: IntArray, n: int) -> sparse.csr_array:
    """Degree matrix minus adjacency, shape (n, n), of undirected edges (m, 2)."""
    i, j = np.concatenate((edges, edges[:, ::-1])).T
    adjacency = sparse.coo_array((np.ones(len(i)), (i, j)), shape=(n, n)).tocsr()
    return sparse.csr_array(sparse.diags_array(np.asarray(adjacency.sum(axis=1)).ravel()) - adjacency)


def box_surface(box: SoftBox) -> tuple[Array, Array]:
    """Vertices (n, 3) [m] of a box whose top is in z = 0, and outward normals; the rim of the top belongs to the top."""
    grids = [np.linspace(-size / 2, size / 2, count) for size, count in zip(box.size_m, box.counts, strict=True)]
    points = np.stack(np.meshgrid(*grids, indexing="ij"), axis=-1).reshape(-1, 3)
    side = points / (np.array(box.size_m) / 2)  # components of 1 on the surface
    on = np.isclose(np.abs(side), 1)
    surface = on.any(axis=1)
    points, side, on = points[surface], side[surface], on[surface]
    axis = np.where(on[:, 2], 2, np.argmax(on, axis=1))
    normals = np.zeros_like(points)
    normals[np.arange(len(points)), axis] = np.sign(side[np.arange(len(points)), axis])
    points[:, 2] -= box.size_m[2] / 2
    return points, normals


def ellipsoid_surface(ellipsoid: Ellipsoid) -> tuple[Array, Array]:
    """Vertices (n, 3) [m] of an ellipsoid whose pole is the origin, in DART's order, and outward normals."""
    half = np.array(ellipsoid.size_m) / 2
    polar = np.pi * np.arange(1, ellipsoid.stacks) / ellipsoid.stacks
    around = 2 * np.pi * np.arange(ellipsoid.slices) / ellipsoid.slices
    p, a = (grid.ravel() for grid in np.meshgrid(polar, around, indexing="ij"))
    rings = np.column_stack((-np.sin(p) * np.sin(a), np.sin(p) * np.cos(a), np.cos(p)))
    unit = np.concatenate(([[0.0, 0.0, 1.0]], rings, [[0.0, 0.0, -1.0]]))
    normals = unit / half
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    vertices = unit * half
    vertices[:, 2] -= half[2]
    return vertices, normals


def ellipsoid_edges(ellipsoid: Ellipsoid) -> IntArray:
    """Which vertices DART connects: along meridians and rings, and across both diagonals; shape (m, 2)."""
    slices, rings = ellipsoid.slices, ellipsoid.stacks - 1
    index = 1 + np.arange(rings * slices).reshape(rings, slices)
    turned = np.roll(index, -1, axis=1)
    last = rings * slices + 1
    pairs = [
        np.column_stack((np.zeros(slices, dtype=int), index[0])),
        np.column_stack((np.full(slices, last), index[-1])),
        np.column_stack((index[:-1].ravel(), index[1:].ravel())),
        np.column_stack((index.ravel(), turned.ravel())),
        np.column_stack((index[:-1].ravel(), turned[1:].ravel())),
        np.column_stack((turned[:-1].ravel(), index[1:].ravel())),
    ]
    return np.concatenate(pairs).astype(np.int32)
