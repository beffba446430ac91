"""The compliance of a phantom's skin: normal displacement of each free vertex by a normal force on each other.

It begins with the Green's function of a uniform layer, exact at any distance. Then the modulus is changed: from uniform to the
healthy body's, and by one lesion after another. Each change E -> E' turns S into

    S' = D S D + P M (F' - D F D) M' P'

D scales by the modulus at the skin, (E / E')^(1/2), which is all there is to near points. The rest is what finite elements say of
the modulus that changes along the skin and below it: F and F' are their compliances before and after on one coarse grid, whose
local errors cancel in the difference; P M carries them to the vertices.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial.distance import cdist

from palpate_models.numerics.cache import content_key, remembered
from palpate_models.numerics.frames import Array
from palpate_models.patient import field
from palpate_models.patient.phantom import PhantomModel
from palpate_models.patient.schema import Lesion
from palpate_tissue import friction
from palpate_tissue.backends.elastic import kernel, modulus, solid
from palpate_tissue.backends.elastic.kernel import LayerKernel
from palpate_tissue.backends.elastic.modulus import YOUNG_OVER_K_W, ModulusField
from palpate_tissue.backends.elastic.solid import NodeGrid, graded_grid, skin_compliance

Array32 = NDArray[np.float32]

PITCH_M = 0.0125
"""Edge of the finite elements of the healthy body [m]; those of a lesion near the skin are finer."""
GRID_HALF_M = 0.13
"""They are even over at most this half width and length: 0.1 m of region, and a margin."""
POISSON = 0.49
MOST_VERTICES = 20_000
"""The matrix of this many vertices takes 1.6 GB."""

_CODE = tuple(
    Path(file) for file in (__file__, kernel.__file__, modulus.__file__, solid.__file__, field.__file__, friction.__file__)
)
"""On which the matrices depend."""


class SizeError(ValueError):
    """A mesh for which this method's dense matrix is too large."""


@dataclass(frozen=True)
class Compliance:
    """What the step needs to know of an elastic solid."""

    matrix: Array32
    """S [m/N] on the free vertices, shape (f, f), symmetric and positive definite."""
    free: NDArray[np.intp]
    """Which vertices those are, ascending, shape (f,)."""
    young: Array
    """Instantaneous Young's modulus of the solid there [Pa], shape (f,)."""


def compliance(
    model: PhantomModel,
    lesions: Sequence[Lesion] = (),
    thickness_m: float | None = None,
    poisson: float = POISSON,
    pitch_m: float = PITCH_M,
) -> Compliance:
    """The skin compliance of a phantom, from the cache or computed (tens of seconds; well under one when it is uniform).

    `lesions` replace those in the phantom's own stiffness; `thickness_m` is that of the layer on its rigid base, by default the
    height of the phantom, and infinite for a half-space, which has to be uniform. `pitch_m` is that of the finite elements.
    Raises SizeError.
    """
    free = np.flatnonzero(~model.fixed)
    if len(free) > MOST_VERTICES:
        raise SizeError(
            f"services.tissue = elastic: {len(free)} free vertices, at most {MOST_VERTICES} are possible: use a coarser mesh "
            "(phantom.edge_m), or services.tissue = winkler"
        )
    thickness = float(np.ptp(model.vertices[:, 2])) if thickness_m is None else thickness_m
    young = ModulusField(model, lesions).at_skin()[free]
    return Compliance(_Body(model, free, thickness, poisson, pitch_m).matrix(tuple(lesions)), free, young)


@dataclass(frozen=True)
class _Body:
    model: PhantomModel
    free: NDArray[np.intp]
    thickness: float
    poisson: float
    pitch: float

    def matrix(self, lesions: tuple[Lesion, ...]) -> Array32:
        """S with these lesions, shape (f, f)."""
        model = self.model
        if not lesions and np.ptp(model.background) <= 1e-9 * model.background.mean():
            return self.layer().astype(np.float32)
        if not math.isfinite(self.thickness):
            raise ValueError("a half-space has to be uniform: give the layer a finite thickness_m")
        arrays = (model.vertices, model.normals, model.areas, model.background, model.fixed)
        key = content_key("compliance", _CODE, *arrays, lesions, self.thickness, self.poisson, self.pitch)
        return remembered(key, lambda: self._changed(lesions))

    def _changed(self, lesions: tuple[Lesion, ...]) -> Array32:
        """S with the last of the lesions, from S without it; or of the healthy body, from the uniform layer's."""
        after = ModulusField(self.model, lesions)
        young = after.at_skin()[self.free]
        if lesions:
            before = ModulusField(self.model, lesions[:-1])
            base = self.matrix(lesions[:-1]).astype(np.float64)
            scale = np.sqrt(before.at_skin()[self.free] / young)
            grid = self._grid_about(lesions[-1])
            elements = skin_compliance(grid, before, self.poisson)
        else:
            base = self.layer()
            uniform = self.uniform()
            scale = np.sqrt(uniform / young)
            grid = self._grid()
            key = content_key("uniform", _CODE, grid.x, grid.y, grid.depth, self.poisson)
            elements = remembered(key, lambda: skin_compliance(grid, lambda points: np.ones(len(points)), self.poisson)) / uniform
        base *= scale[:, None] * scale
        x, y = grid.skin
        nodes = np.column_stack([axis.ravel() for axis in np.meshgrid(x, y, indexing="ij")])
        skin = np.column_stack((nodes, np.zeros(len(nodes))))
        at_nodes = np.sqrt((before(skin) if lesions else uniform) / after(skin))
        difference = skin_compliance(grid, after, self.poisson) - at_nodes[:, None] * elements * at_nodes
        weights = _interpolation(grid, self.model.vertices[self.free], self.model.normals[self.free])
        weights = weights @ _smoothing(len(x), len(y))
        base += (weights @ (weights @ difference).T).T
        return base.astype(np.float32)

    def uniform(self) -> float:
        """Young's modulus [Pa] of the uniform layer to begin with."""
        return YOUNG_OVER_K_W * float(np.median(self.model.background))

    def layer(self) -> Array:
        """S of the uniform layer, shape (f, f)."""
        kernel = LayerKernel(self.poisson, self.thickness)
        vertices = self.model.vertices[self.free]
        matrix = cdist(vertices, vertices)
        np.fill_diagonal(matrix, 1.0)
        matrix = kernel(matrix)
        np.fill_diagonal(matrix, kernel.at_own_place(self.model.areas[self.free]))
        matrix *= kernel.factor(self.uniform())
        return matrix

    def _front(self) -> Array:
        """Half width and length of the body's front, and not more than what is examined [m], shape (2,)."""
        front = self.model.vertices[self.model.normals[:, 2] > 0.5, :2]
        return np.asarray(np.minimum(np.abs(front).max(axis=0), GRID_HALF_M))

    def _grid(self) -> NodeGrid:
        half = self._front()
        return graded_grid(-half, half, self.thickness, self.pitch)

    def _grid_about(self, lesion: Lesion) -> NodeGrid:
        """The shallower a lesion begins, the finer are the elements that show it, and the nearer fades what it does."""
        depth = lesion.depth_m or 0.0
        half = self._front()
        centre = np.clip(np.asarray(lesion.centre_m), -half, half)
        reach = np.asarray(lesion.radii_m) + 0.045 + 0.5 * depth
        finest = max(0.4 * self.pitch, 0.3 * min(lesion.radii_m))
        pitch = min(self.pitch, finest, 0.4 * self.pitch + 0.2 * depth)
        return graded_grid(np.maximum(centre - reach, -half), np.minimum(centre + reach, half), self.thickness, pitch)


def _smoothing(nx: int, ny: int) -> sparse.csr_array:
    """M: weights (-1, 4, 10, 4, -1) / 16 along x and y, shape (nx ny, nx ny).

    Nodal forces on trilinear elements excite a displacement of alternating sign (nothing finer can answer them). These weights
    are blind to it, and leave cubic polynomials as they are.
    """

    def along(n: int) -> sparse.csr_array:
        total = sum((w / 16 * np.eye(n, k=k) for k, w in ((-2, -1), (-1, 4), (0, 10), (1, 4), (2, -1))), np.zeros((n, n)))
        return sparse.csr_array(total / total.sum(axis=1, keepdims=True))

    return sparse.csr_array(sparse.kron(along(nx), along(ny)))


def _interpolation(grid: NodeGrid, vertices: Array, normals: Array) -> sparse.csr_array:
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
