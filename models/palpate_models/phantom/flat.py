"""A plane phantom of uniform nominal stiffness: the reference on which contact laws are checked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import robust_laplacian
from scipy import sparse
from scipy.spatial import Delaunay

from palpate_models.patient import Lesion
from palpate_models.phantom.field import lesion_field
from palpate_models.phantom.mesh import boundary_vertices
from palpate_models.phantom.model import PhantomModel
from palpate_models.phantom.parametric import lattice


def flat_phantom(
    half_m: float = 0.13, edge_m: float = 0.005, k_w_n_per_m3: float = 1.7e5, lesions: Sequence[Lesion] = ()
) -> PhantomModel:
    """A square of half width `half_m` [m] in z = 0 on a hexagonal lattice of `edge_m` [m]; its border is fixed.

    A vertex is at the origin. The breathing profile is 1 everywhere inside.
    """
    points = lattice(half_m, half_m, edge_m)
    triangles = Delaunay(points).simplices
    a, b, c = (points[triangles[:, k]] for k in range(3))
    double_area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    flat = np.abs(double_area) < 1e-3 * edge_m**2  # Qhull's slivers along the border
    triangles = np.where((double_area > 0)[:, None], triangles, triangles[:, ::-1])[~flat].astype(np.int32)
    n = len(points)
    vertices = np.column_stack((points, np.zeros(n)))
    laplacian, mass = robust_laplacian.mesh_laplacian(vertices, triangles)
    contrast, lesion = lesion_field(points, lesions)
    fixed = boundary_vertices(n, triangles)
    return PhantomModel(
        vertices=vertices,
        triangles=triangles,
        normals=np.tile((0.0, 0.0, 1.0), (n, 1)),
        areas=np.asarray(mass.diagonal(), dtype=np.float64),
        laplacian=sparse.csr_array(laplacian),
        stiffness=k_w_n_per_m3 * contrast,
        background=np.full(n, k_w_n_per_m3),
        stiffening=np.zeros(n),
        tension=np.zeros(n),
        lesion=lesion,
        fixed=fixed,
        breathing=np.where(fixed, 0.0, 1.0),
    )
