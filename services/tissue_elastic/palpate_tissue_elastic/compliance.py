"""The compliance of a phantom's skin: normal displacement of each free vertex by a normal force on each other.

    S = D K D + P M (S_het - D S_hom D) M' P'

K is the Green's function of the uniform layer, exact at any distance; D scales it by the modulus at the skin. The second term
is what finite elements on a coarse grid say of everything else: modulus that varies along the skin and below it.
Both S_het and S_hom are finite-element solutions on the same grid, so that their local errors cancel in the difference.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from palpate_models.phantom import PhantomModel
from palpate_models.scenario import Lesion
from scipy import sparse
from scipy.spatial.distance import cdist

from palpate_tissue_elastic.cache import content_key, remembered
from palpate_tissue_elastic.kernel import LayerKernel
from palpate_tissue_elastic.modulus import YOUNG_OVER_K_W, ModulusField
from palpate_tissue_elastic.solid import Grid, graded_grid, skin_compliance

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

PITCH_M = 0.010
"""Of the finite elements below the examined region."""
GRID_HALF_M = 0.13
"""They are even over at most this half width and length: 0.1 m of region, and a margin."""
POISSON = 0.49
MOST_VERTICES = 20_000
"""The matrix of this many vertices takes 1.6 GB."""


class SizeError(ValueError):
    """A mesh for which this method's dense matrix is too large."""


@dataclass(frozen=True)
class Compliance:
    """What the step needs to know of an elastic solid."""

    matrix: Array32
    """S [m/N] on the free vertices, shape (f, f), symmetric and positive definite."""
    free: NDArray[np.intp]
    """Which vertices those are, ascending, shape (f,)."""


def compliance(
    model: PhantomModel,
    lesions: Sequence[Lesion] = (),
    thickness_m: float | None = None,
    poisson: float = POISSON,
    pitch_m: float = PITCH_M,
) -> Compliance:
    """The skin compliance of a phantom, from the cache or computed (seconds).

    `lesions` replace those in the phantom's own stiffness; `thickness_m` is that of the layer on its rigid base, by default the
    height of the phantom; infinite for a half-space, which is then uniform along its depth. Raises SizeError.
    """
    free = np.flatnonzero(~model.fixed)
    if len(free) > MOST_VERTICES:
        raise SizeError(
            f"tissue.implementation elastic: {len(free)} free vertices, at most {MOST_VERTICES} are possible: use a coarser mesh "
            "(phantom.edge_m), or tissue.implementation default"
        )
    thickness = float(np.ptp(model.vertices[:, 2])) if thickness_m is None else thickness_m
    uniform = not lesions and np.ptp(model.background) <= 1e-9 * model.background.mean()
    if uniform:
        return Compliance(_layer(model, free, ModulusField(model), LayerKernel(poisson, thickness)).astype(np.float32), free)
    if not math.isfinite(thickness):
        raise ValueError("a half-space cannot vary: give the layer a finite thickness_m")

    def compute() -> Array32:
        modulus = ModulusField(model, lesions)
        matrix = _layer(model, free, modulus, LayerKernel(poisson, thickness))
        _correct(matrix, model, free, modulus, thickness, poisson, pitch_m)
        return matrix.astype(np.float32)

    arrays = (model.vertices, model.normals, model.areas, model.background, model.fixed)
    key = content_key("compliance", *arrays, tuple(lesions), thickness, poisson, pitch_m)
    return Compliance(remembered(key, compute), free)


def _layer(model: PhantomModel, free: NDArray[np.intp], modulus: ModulusField, kernel: LayerKernel) -> Array:
    """D K D on the free vertices, shape (f, f)."""
    young = modulus.at_skin()[free]
    vertices = model.vertices[free]
    matrix = cdist(vertices, vertices)
    np.fill_diagonal(matrix, 1.0)
    matrix = kernel(matrix)
    np.fill_diagonal(matrix, kernel.at_own_place(model.areas[free]))
    scale = np.sqrt(kernel.factor(1.0) / young)
    matrix *= scale[:, None] * scale
    return matrix


def _correct(
    matrix: Array,
    model: PhantomModel,
    free: NDArray[np.intp],
    modulus: ModulusField,
    thickness: float,
    poisson: float,
    pitch: float,
) -> None:
    """Adds to the matrix what the uniform layer leaves out."""
    front = model.vertices[model.normals[:, 2] > 0.5]
    half = np.minimum(np.abs(front[:, :2]).max(axis=0), GRID_HALF_M)
    grid = graded_grid(float(half[0]), float(half[1]), thickness, pitch)
    uniform = YOUNG_OVER_K_W * float(np.median(model.background))
    key = content_key("uniform", grid.x, grid.y, grid.depth, poisson)
    plain = np.asarray(remembered(key, lambda: skin_compliance(grid, lambda points: np.ones(len(points)), poisson))) / uniform
    x, y = grid.skin
    nodes = np.column_stack([axis.ravel() for axis in np.meshgrid(x, y, indexing="ij")])
    at_skin = modulus(np.column_stack((nodes, np.zeros(len(nodes)))))
    scale = np.sqrt(uniform / at_skin)
    difference = skin_compliance(grid, modulus, poisson) - scale[:, None] * plain * scale
    to_vertices = _interpolation(grid, model.vertices[free], model.normals[free]) @ _smoothing(len(x), len(y))
    matrix += (to_vertices @ (to_vertices @ difference).T).T


def _smoothing(nx: int, ny: int) -> sparse.csr_array:
    """M: weights 1/4, 1/2, 1/4 along x and y, shape (nx ny, nx ny).

    Nodal forces on trilinear elements excite a displacement of alternating sign (nothing finer can answer them). These weights
    are blind to it, and otherwise spread force and displacement over half a pitch, to second order in the pitch.
    """

    def along(n: int) -> sparse.csr_array:
        total = sparse.csr_array(0.5 * np.eye(n) + 0.25 * (np.eye(n, k=1) + np.eye(n, k=-1)))
        return sparse.csr_array(sparse.diags_array(1 / np.asarray(total.sum(axis=1))) @ total)

    return sparse.csr_array(sparse.kron(along(nx), along(ny)))


def _interpolation(grid: Grid, vertices: Array, normals: Array) -> sparse.csr_array:
    """P: bilinear weights of the skin's nodes at vertices (f, 3), shape (f, k); fades away at the grid's rim and the flanks.

    Vertices lie over the grid by their x and y. Symmetric use, P (.) P', keeps the matrix positive definite wherever P fades.
    """
    x, y = grid.skin
    pitch = x[1] - x[0]
    at = (vertices[:, :2] - (x[0], y[0])) / pitch
    cell = np.clip(np.floor(at).astype(np.intp), 0, (len(x) - 2, len(y) - 2))
    share = at - cell
    last = np.array((len(x) - 1, len(y) - 1))
    rim = np.minimum(at, last - at).min(axis=1)
    weight = np.clip(rim / 2, 0, 1) * np.clip((normals[:, 2] - 0.3) / 0.3, 0, 1)
    rows, columns, values = [], [], []
    for i in (0, 1):
        for j in (0, 1):
            rows.append(np.arange(len(vertices)))
            columns.append((cell[:, 0] + i) * len(y) + cell[:, 1] + j)
            part = np.where(i, share[:, 0], 1 - share[:, 0]) * np.where(j, share[:, 1], 1 - share[:, 1])
            values.append(np.where(weight > 0, weight * part, 0.0))
    shape = (len(vertices), len(x) * len(y))
    return sparse.csr_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=shape)
