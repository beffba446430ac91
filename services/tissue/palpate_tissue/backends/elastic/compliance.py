"""Skin compliance of a phantom: normal displacement of each free vertex per normal force on each other vertex.

It starts from the Green's function of a uniform layer, exact at any distance. Then the modulus is changed, from uniform to that
of the healthy body, and by one lesion after another. Each change E -> E' turns S into

    S' = D S D + P M (F' - D F D) M' P'

D scales by the modulus at the skin, (E / E')^(1/2), which is exact for near points. The remainder, from modulus changes along and
below the skin, comes from finite elements (`solid`): F and F' are their compliances before and after on one coarse grid, whose
local errors cancel in the difference; P M interpolates them to the vertices.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.integrate import simpson
from scipy.interpolate import CubicSpline, LinearNDInterpolator, NearestNDInterpolator
from scipy.spatial.distance import cdist
from scipy.special import j0

from palpate_errors import UserError
from palpate_models.numerics.cache import content_key, remember
from palpate_models.numerics.frames import Array, Indices
from palpate_models.patient import field
from palpate_models.patient.field import lesion_field, smoothstep
from palpate_models.patient.phantom import PhantomModel
from palpate_models.patient.schema import Lesion
from palpate_tissue import contact
from palpate_tissue.backends.elastic import solid
from palpate_tissue.backends.elastic.solid import NodeGrid, graded_grid, skin_compliance
from palpate_tissue.contact import REFERENCE


class ComplianceTuning(NamedTuple):
    """Discretisation of the solid."""

    self_weight: float = 3.92
    """Displacement from a vertex's own pressure, over force / sqrt(area), for which the sum of 1/r over a lattice equals the
    integral (corrected trapezoidal rule; Marin, Runborg and Tornberg 2014). Regularised lattice sums (Epstein zeta at 1/2) give
    3.900 on a square and 3.921 on a hexagonal lattice, so it hardly depends on the mesh."""
    farthest: float = 12.0
    """Maximum tabulated distance over thickness; beyond it the skin of a layer is at rest."""
    pitch_m: float = 0.0125
    """Edge of the finite elements of the healthy body; those of a lesion near the skin are finer."""
    grid_half_m: float = 0.13
    """Maximum half width of the uniform part of the grid: 0.1 m of region plus a margin."""
    poisson: float = 0.49
    max_vertices: int = 20_000
    """The matrix of this many vertices takes 1.6 GB."""
    max_nodes: int = 2000
    """Skin nodes of the body's finite elements: a minute on one core; the time grows with the third power."""
    max_lesion_nodes: int = 1100
    """Skin nodes about a lesion, whose pitch is coarser for a larger one."""


COMPLIANCE: Final = ComplianceTuning()


def layer_factor(wave: Array, poisson: float) -> Array:
    """Return the compliance of a layer bonded to a rigid base relative to the half-space, at wave number k = wave / H.

    L(u) = (2 c sinh 2u - 4u) / (2 c cosh 2u + 4u^2 + 1 + c^2), c = 3 - 4 nu (Vorovich, Alexandrov and Babeshko 1974;
    Johnson, Contact Mechanics, section 5.8). 1 for short waves, u (1 - 2 nu) / (2 (1 - nu)^2), uniaxial strain, for long ones.
    """
    c = 3 - 4 * poisson
    fade = np.exp(-2 * wave)  # numerator and denominator are divided by exp(2 u) / 2 to avoid overflow
    above = 2 * c * (1 - fade**2) - 8 * wave * fade
    below = 2 * c * (1 + fade**2) + 2 * (4 * wave**2 + 1 + c * c) * fade
    return np.asarray(above / below)


class LayerKernel:
    """Normal displacement of the skin per normal force on it.

    u(r) = (1 - nu^2) / (pi E) F k(r),  k(r) = 1/r - g(r/H)/H,  g(s) = int_0^inf (1 - L(u)) J0(u s) du.

    The first term is Boussinesq's half-space, the second the base at depth H; `thickness_m` = inf omits it.
    """

    def __init__(self, poisson: float = 0.49, thickness_m: float = math.inf) -> None:
        if not 0 <= poisson < 0.5:
            raise ValueError(f"poisson = {poisson}: expected 0 <= poisson < 0.5")
        if not thickness_m > 0:
            raise ValueError(f"thickness_m = {thickness_m}: expected more than 0")
        self.poisson = poisson
        self.thickness_m = thickness_m
        self._base = _base_term(poisson) if math.isfinite(thickness_m) else None

    def factor(self, young_pa: float) -> float:
        """Return (1 - nu^2) / (pi E) [1/Pa]."""
        return (1 - self.poisson**2) / (math.pi * young_pa)

    def __call__(self, distance: Array) -> Array:
        """Return k(r) [1/m] at distances r > 0 [m], any shape."""
        near = 1 / distance
        return near if self._base is None else near - self._by_base(distance)

    def at_own_place(self, area: Array) -> Array:
        """Return k of a vertex on itself [1/m], for vertices of `area` [m^2], same shape."""
        own = COMPLIANCE.self_weight / np.sqrt(area)
        return own if self._base is None else own - self._by_base(np.zeros_like(area))

    def _by_base(self, distance: Array) -> Array:
        assert self._base is not None
        s = distance / self.thickness_m
        inside = s < COMPLIANCE.farthest
        # Far away the base cancels the half-space's displacement.
        return np.where(inside, self._base(np.minimum(s, COMPLIANCE.farthest)), 1 / np.maximum(s, 1.0)) / self.thickness_m


def _base_term(poisson: float) -> CubicSpline:
    """Return g(s) for 0 <= s <= COMPLIANCE.farthest."""
    wave = np.linspace(0, 20, 8001)
    short = 1 - layer_factor(wave, poisson)
    at = np.concatenate((np.linspace(0, 4, 161), np.linspace(4, COMPLIANCE.farthest, 121)[1:]))
    return CubicSpline(at, simpson(short[None, :] * j0(at[:, None] * wave[None, :]), x=wave, axis=1))


YOUNG_OVER_K_W = REFERENCE.young_pa / REFERENCE.k_w_n_per_m3
"""Young's modulus over the foundation modulus of an equally stiff wall at 10 mm depth [m]."""


def healthy_young(model: PhantomModel) -> Array:
    """Return Young's modulus without lesions at the vertices [Pa], shape (n,)."""
    return YOUNG_OVER_K_W * model.background if model.young is None else model.young


class ModulusField:
    """Instantaneous Young's modulus [Pa] at (x, y) of A and depth below the skin.

    The healthy modulus is constant over depth. A lesion with a depth is an ellipsoid whose top is at that depth; one without is a
    column through the whole body, as in the Winkler backend.
    """

    def __init__(self, model: PhantomModel, lesions: Sequence[Lesion] = ()) -> None:
        front = model.normals[:, 2] > 0
        self._front = front
        self._skin = healthy_young(model)
        log_young = np.log(self._skin[front])
        self._inside = LinearNDInterpolator(model.vertices[front, :2], log_young)
        self._outside = NearestNDInterpolator(model.vertices[front, :2], log_young)
        self._lesions = tuple(lesions)
        self._xy = model.vertices[:, :2]

    def healthy(self, xy: Array) -> Array:
        """Return the modulus without lesions at (p, 2) [m], shape (p,); beyond the front, that of the nearest vertex."""
        value = np.asarray(self._inside(xy))
        gap = np.isnan(value)
        if gap.any():
            value[gap] = self._outside(xy[gap])
        return np.asarray(np.exp(value))

    def __call__(self, points: Array) -> Array:
        """Return the modulus at points (x, y, depth) [m], shape (p, 3); shape (p,)."""
        # Points are in columns, so interpolation is done once per column.
        columns, of_point = np.unique(points[:, :2], axis=0, return_inverse=True)
        return np.asarray(self.healthy(columns)[of_point.ravel()] * lesion_factor(points, self._lesions))

    def at_skin(self) -> Array:
        """Return the modulus at the skin vertices, shape (n,)."""
        at = np.column_stack((self._xy, np.zeros(len(self._xy))))
        return np.asarray(self._skin * np.where(self._front, lesion_factor(at, self._lesions), 1.0))


def lesion_factor(points: Array, lesions: Sequence[Lesion]) -> Array:
    """Return the modulus with lesions over that without at points (x, y, depth) [m], shape (p, 3); shape (p,).

    The contrast rises over `edge_m` centred on the outline; of overlapping lesions the stronger counts.
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
    """Return the first-order distance [m] from the ellipsoid, negative inside. Vertical half axis: the smaller of the other
    two.
    """
    assert lesion.depth_m is not None
    vertical = min(lesion.radii_m)
    radii = np.array((*lesion.radii_m, vertical))
    offset = (points - np.array((*lesion.centre_m, lesion.depth_m + vertical))) / radii
    rho = np.sqrt((offset**2).sum(axis=1))
    slope = np.sqrt(((offset / radii) ** 2).sum(axis=1))
    return np.asarray(np.where(rho > 1e-6, (rho - 1) * rho / np.maximum(slope, 1e-9), -radii.min()))


Array32 = NDArray[np.float32]


_CODE = tuple(Path(file) for file in (__file__, solid.__file__, field.__file__, contact.__file__))
"""Source files that the cached matrices depend on."""


class Compliance(NamedTuple):
    """Compliance of an elastic solid on its free vertices."""

    matrix: Array32
    """S [m/N] on the free vertices, shape (f, f), symmetric and positive definite."""
    free: Indices
    """Free vertices, ascending, shape (f,)."""
    young: Array
    """Instantaneous Young's modulus at these vertices [Pa], shape (f,)."""


def compliance(
    model: PhantomModel,
    lesions: Sequence[Lesion] = (),
    thickness_m: float | None = None,
    poisson: float = COMPLIANCE.poisson,
    pitch_m: float = COMPLIANCE.pitch_m,
) -> Compliance:
    """Return the skin compliance of a phantom, cached or computed (tens of seconds; well under one second if uniform).

    Args:
        model: the phantom.
        lesions: replace those in the phantom's stiffness.
        thickness_m: layer on a rigid base, by default the height of the phantom; infinite for a half-space, which must be
        uniform.
        poisson: Poisson's ratio.
        pitch_m: edge of the finite elements.

    Raises UserError for a mesh that is too large.
    """
    free = np.flatnonzero(~model.fixed)
    if len(free) > COMPLIANCE.max_vertices:
        raise UserError(
            f"services.tissue = elastic: {len(free)} free vertices, at most {COMPLIANCE.max_vertices} possible: use a coarser "
            "mesh (phantom.edge_m), or services.tissue = winkler"
        )
    thickness = float(np.ptp(model.vertices[:, 2])) if thickness_m is None else thickness_m
    young = ModulusField(model, lesions).at_skin()[free]
    return Compliance(_Body(model, free, thickness, poisson, pitch_m).matrix(tuple(lesions)), free, young)


class _Body(NamedTuple):
    model: PhantomModel
    free: Indices
    thickness: float
    poisson: float
    pitch: float

    def matrix(self, lesions: tuple[Lesion, ...]) -> Array32:
        """Return S with these lesions, shape (f, f)."""
        model = self.model
        young = healthy_young(model)
        if not lesions and np.ptp(young) <= 1e-9 * young.mean():
            return self.layer().astype(np.float32)
        if not math.isfinite(self.thickness):
            raise UserError("a half-space must be uniform: use a finite thickness_m")
        arrays = (model.vertices, model.normals, model.areas, young, model.fixed)
        key = content_key("compliance", _CODE, *arrays, lesions, self.thickness, self.poisson, self.pitch)
        return remember(key, lambda: self._update_compliance(lesions))

    def _update_compliance(self, lesions: tuple[Lesion, ...]) -> Array32:
        """Return S with the last lesion from S without it, or S of the healthy body from that of the uniform layer."""
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
            elements = remember(key, lambda: skin_compliance(grid, lambda points: np.ones(len(points)), self.poisson)) / uniform
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
        """Return Young's modulus of the initial uniform layer [Pa]."""
        return float(np.median(healthy_young(self.model)))

    def layer(self) -> Array:
        """Return S of the uniform layer, shape (f, f)."""
        layer = LayerKernel(self.poisson, self.thickness)
        vertices = self.model.vertices[self.free]
        matrix = cdist(vertices, vertices)
        np.fill_diagonal(matrix, 1.0)
        matrix = layer(matrix)
        np.fill_diagonal(matrix, layer.at_own_place(self.model.areas[self.free]))
        matrix *= layer.factor(self.uniform())
        return matrix

    def _front(self) -> Array:
        """Return half width and length of the body's front, at most COMPLIANCE.grid_half_m [m], shape (2,)."""
        front = self.model.vertices[self.model.normals[:, 2] > 0.5, :2]
        return np.asarray(np.minimum(np.abs(front).max(axis=0), COMPLIANCE.grid_half_m))

    def _grid(self) -> NodeGrid:
        half = self._front()
        grid = graded_grid(-half, half, self.thickness, self.pitch)
        if (count := math.prod(map(len, grid.skin))) > COMPLIANCE.max_nodes:
            raise UserError(
                f"services.tissue = elastic: a body {self.thickness:.3g} m thick and {2 * half[0]:.2g} x {2 * half[1]:.2g} m "
                f"wide needs {count} nodes, at most {COMPLIANCE.max_nodes} possible: a thicker or smaller one, "
                "or services.tissue = winkler"
            )
        return grid

    def _grid_about(self, lesion: Lesion) -> NodeGrid:
        """Return a grid about a lesion: finer for shallow lesions, whose effect also decays faster."""
        depth = lesion.depth_m or 0.0
        half = self._front()
        centre = np.clip(np.asarray(lesion.centre_m), -half, half)
        reach = np.asarray(lesion.radii_m) + 0.045 + 0.5 * depth
        finest = max(0.4 * self.pitch, 0.3 * min(lesion.radii_m))
        low, high = np.maximum(centre - reach, -half), np.minimum(centre + reach, half)
        pitch = max(
            min(self.pitch, finest, 0.4 * self.pitch + 0.2 * depth),
            math.sqrt(math.prod(high - low) / COMPLIANCE.max_lesion_nodes),
        )
        return graded_grid(low, high, self.thickness, pitch)


def _smoothing(nx: int, ny: int) -> sparse.csr_array:
    """Return M: weights (-1, 4, 10, 4, -1) / 16 along x and y, shape (nx ny, nx ny).

    Nodal forces on trilinear elements excite a displacement of alternating sign at the grid scale. These weights remove it and
    preserve cubic polynomials.
    """

    def along(n: int) -> sparse.csr_array:
        total = sum((w / 16 * np.eye(n, k=k) for k, w in ((-2, -1), (-1, 4), (0, 10), (1, 4), (2, -1))), np.zeros((n, n)))
        return sparse.csr_array(total / total.sum(axis=1, keepdims=True))

    return sparse.csr_array(sparse.kron(along(nx), along(ny)))


def _interpolation(grid: NodeGrid, vertices: Array, normals: Array) -> sparse.csr_array:
    """Return P: bilinear weights of the skin nodes at vertices (f, 3), shape (f, k), fading at the rim of the grid and the
    flanks.

    Vertices map to the grid by x and y. The symmetric use P (.) P' keeps the matrix positive definite where P fades.
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
