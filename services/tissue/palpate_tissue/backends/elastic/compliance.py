"""What a normal force on the skin of a uniform layer does to the skin: the layer's surface Green's function."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.integrate import simpson
from scipy.interpolate import CubicSpline, LinearNDInterpolator, NearestNDInterpolator
from scipy.spatial.distance import cdist
from scipy.special import j0

from palpate_models.numerics.cache import content_key, remembered
from palpate_models.numerics.frames import Array
from palpate_models.patient import field
from palpate_models.patient.field import lesion_field, smoothstep
from palpate_models.patient.phantom import PhantomModel
from palpate_models.patient.schema import Lesion
from palpate_tissue import contact
from palpate_tissue.backends.elastic import solid
from palpate_tissue.backends.elastic.solid import NodeGrid, graded_grid, skin_compliance
from palpate_tissue.contact import REFERENCE_E, REFERENCE_K_W

SELF_WEIGHT = 3.92
"""Displacement that a vertex's own pressure adds, over its force / sqrt(area): what makes the sum of 1/r over a lattice equal the
integral (a corrected trapezoidal rule; Marin, Runborg and Tornberg 2014). Regularised lattice sums (Epstein zeta at 1/2) give
3.900 on a square lattice and 3.921 on a hexagonal one, so it hardly depends on the mesh."""

_FARTHEST = 12.0
"""Distance over thickness up to which the layer's function is tabulated; beyond, a layer's skin is at rest."""


def layer_factor(wave: Array, poisson: float) -> Array:
    """Compliance of a layer bonded to a rigid base over that of the half-space, for pressure of wave number k = wave / H.

    L(u) = (2 c sinh 2u - 4u) / (2 c cosh 2u + 4u^2 + 1 + c^2), c = 3 - 4 nu (Vorovich, Alexandrov and Babeshko 1974;
    Johnson, Contact Mechanics, section 5.8). 1 for short waves, u (1 - 2 nu) / (2 (1 - nu)^2), uniaxial strain, for long ones.
    """
    c = 3 - 4 * poisson
    fade = np.exp(-2 * wave)  # numerator and denominator are divided by exp(2 u) / 2, which overflows
    above = 2 * c * (1 - fade**2) - 8 * wave * fade
    below = 2 * c * (1 + fade**2) + 2 * (4 * wave**2 + 1 + c * c) * fade
    return np.asarray(above / below)


class LayerKernel:
    """Normal displacement of the skin by a normal force on it.

    u(r) = (1 - nu^2) / (pi E) F k(r),  k(r) = 1/r - g(r/H)/H,  g(s) = int_0^inf (1 - L(u)) J0(u s) du.

    The first term is Boussinesq's half-space, the second the base at depth H below; `thickness_m` = inf leaves it out.
    """

    def __init__(self, poisson: float = 0.49, thickness_m: float = math.inf) -> None:
        if not 0 <= poisson < 0.5:
            raise ValueError(f"poisson = {poisson}: want 0 <= poisson < 0.5")
        if not thickness_m > 0:
            raise ValueError(f"thickness_m = {thickness_m}: want more than 0")
        self.poisson = poisson
        self.thickness_m = thickness_m
        self._base = _base_term(poisson) if math.isfinite(thickness_m) else None

    def factor(self, young_pa: float) -> float:
        """(1 - nu^2) / (pi E) [1/Pa]."""
        return (1 - self.poisson**2) / (math.pi * young_pa)

    def __call__(self, distance: Array) -> Array:
        """k(r) [1/m] at distances r > 0 [m], any shape."""
        near = 1 / distance
        return near if self._base is None else near - self._by_base(distance)

    def at_own_place(self, area: Array) -> Array:
        """K at a vertex's own place [1/m], for vertices of `area` [m^2], same shape."""
        own = SELF_WEIGHT / np.sqrt(area)
        return own if self._base is None else own - self._by_base(np.zeros_like(area))

    def _by_base(self, distance: Array) -> Array:
        assert self._base is not None
        s = distance / self.thickness_m
        inside = s < _FARTHEST
        # Far out, the base takes away all of the half-space's displacement.
        return np.where(inside, self._base(np.minimum(s, _FARTHEST)), 1 / np.maximum(s, 1.0)) / self.thickness_m


def _base_term(poisson: float) -> CubicSpline:
    """g(s) for 0 <= s <= _FARTHEST."""
    wave = np.linspace(0, 20, 8001)
    short = 1 - layer_factor(wave, poisson)
    at = np.concatenate((np.linspace(0, 4, 161), np.linspace(4, _FARTHEST, 121)[1:]))
    return CubicSpline(at, simpson(short[None, :] * j0(at[:, None] * wave[None, :]), x=wave, axis=1))


YOUNG_OVER_K_W = REFERENCE_E / REFERENCE_K_W
"""Young's modulus over foundation modulus of a wall that is equally stiff at 10 mm depth [m]."""


class ModulusField:
    """Instantaneous Young's modulus [Pa] at (x, y) of A and depth below the skin.

    The healthy modulus does not change with depth. A lesion with a depth is an ellipsoid whose upper side is there; one
    without is a column from the skin through the whole body, which is what the surface tier's lesions are.
    """

    def __init__(self, model: PhantomModel, lesions: Sequence[Lesion] = ()) -> None:
        front = model.normals[:, 2] > 0
        self._front = front
        self._skin = YOUNG_OVER_K_W * model.background
        log_young = np.log(self._skin[front])
        self._inside = LinearNDInterpolator(model.vertices[front, :2], log_young)
        self._outside = NearestNDInterpolator(model.vertices[front, :2], log_young)
        self._lesions = tuple(lesions)
        self._xy = model.vertices[:, :2]

    def healthy(self, xy: Array) -> Array:
        """Without lesions, at (p, 2) [m]; beyond the front, that of its nearest vertex; shape (p,)."""
        value = np.asarray(self._inside(xy))
        gap = np.isnan(value)
        if gap.any():
            value[gap] = self._outside(xy[gap])
        return np.asarray(np.exp(value))

    def __call__(self, points: Array) -> Array:
        """At points (x, y, depth) [m], shape (p, 3); shape (p,)."""
        # Points lie in columns, so the interpolation is done once a column.
        columns, of_point = np.unique(points[:, :2], axis=0, return_inverse=True)
        return np.asarray(self.healthy(columns)[of_point.ravel()] * lesion_factor(points, self._lesions))

    def at_skin(self) -> Array:
        """At the vertices of the skin, shape (n,)."""
        at = np.column_stack((self._xy, np.zeros(len(self._xy))))
        return np.asarray(self._skin * np.where(self._front, lesion_factor(at, self._lesions), 1.0))


def lesion_factor(points: Array, lesions: Sequence[Lesion]) -> Array:
    """Modulus with lesions over modulus without at points (x, y, depth) [m], shape (p, 3); shape (p,).

    As on the surface, the contrast rises over `edge_m` centred on the outline, and of overlapping lesions the stronger counts.
    """
    factor = np.ones(len(points))
    for lesion in lesions:
        if lesion.depth_m is None:
            own = lesion_field(points[:, :2], (lesion,))[0]
        else:
            own = 1 + (lesion.contrast - 1) * smoothstep(0.5 - _ellipsoid_distance(points, lesion) / lesion.edge_m)
        stronger = np.abs(np.log(own)) > np.abs(np.log(factor))
        factor[stronger] = own[stronger]
    return factor


def _ellipsoid_distance(points: Array, lesion: Lesion) -> Array:
    """Distance [m] from the ellipsoid, to first order, negative inside. Vertical half axis: the smaller of the other two."""
    assert lesion.depth_m is not None
    vertical = min(lesion.radii_m)
    radii = np.array((*lesion.radii_m, vertical))
    offset = (points - np.array((*lesion.centre_m, lesion.depth_m + vertical))) / radii
    rho = np.sqrt((offset**2).sum(axis=1))
    slope = np.sqrt(((offset / radii) ** 2).sum(axis=1))
    return np.asarray(np.where(rho > 1e-6, (rho - 1) * rho / np.maximum(slope, 1e-9), -radii.min()))


Array32 = NDArray[np.float32]

PITCH_M = 0.0125
"""Edge of the finite elements of the healthy body [m]; those of a lesion near the skin are finer."""
GRID_HALF_M = 0.13
"""They are even over at most this half width and length: 0.1 m of region, and a margin."""
POISSON = 0.49
MOST_VERTICES = 20_000
"""The matrix of this many vertices takes 1.6 GB."""

_CODE = tuple(Path(file) for file in (__file__, solid.__file__, field.__file__, contact.__file__))
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
        layer = LayerKernel(self.poisson, self.thickness)
        vertices = self.model.vertices[self.free]
        matrix = cdist(vertices, vertices)
        np.fill_diagonal(matrix, 1.0)
        matrix = layer(matrix)
        np.fill_diagonal(matrix, layer.at_own_place(self.model.areas[self.free]))
        matrix *= layer.factor(self.uniform())
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
