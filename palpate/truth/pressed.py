"""The true surface, and standard presses on a copy of the true tissue, with and without its lumps.

The copy uses the scenario's own tier and rests at the end of expiration. The difference with and without a lump at the same
places is the palpable effect of the lump.

The felt contrast of a lump is the force with it over the force without it, and e its logarithm. A lump's area is the connected
set about its maximum |e| in which e has the sign that it has there and |e| is at least half of it. Everything is in the xy plane
of A; areas are on the skin.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import label, maximum
from scipy.spatial import Delaunay, cKDTree

import palpate_models
from palpate_models.numerics.cache import content_key, remember
from palpate_models.numerics.frames import Array, Mask
from palpate_models.patient.field import edge_distance
from palpate_models.patient.mesh import vertex_normals
from palpate_models.patient.motion import Breathing, Motion
from palpate_models.patient.schema import Lesion, Structure
from palpate_models.scenario.schema import Exam, Scenario


class TrueBody(NamedTuple):
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
        self._mesh, self._front = mesh, front
        self._height = LinearNDInterpolator(mesh, body.vertices[front, 2])
        self._normal = LinearNDInterpolator(mesh, vertex_normals(body.vertices, body.triangles[facing])[front])

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


class PressedGrid(NamedTuple):
    """Pressed places and their reach."""

    nearest: int = 4
    """Number of nearest contacts whose errors are averaged, weighted by inverse distance."""
    pitch_m: float = 0.010
    """Distance of pressed places, over the examined region and a border of this width."""
    fine_pitch_m: float = 0.005
    """Distance of pressed places within `pitch_m` of a lump's outline."""
    reach_m: float = 0.040
    """A lump is not palpable further outside its outline than this plus its depth: the felt effect goes with the square of the
    influence K0(r / l) / K0(9 mm / l). There it is 0.3 % for the shortest l of the persons of seeds 1000 to 1099 (13 mm), 0.7 %
    for the median (17 mm) and 5 % for the longest (35 mm)."""


GRID: Final = PressedGrid()
RASTER_M: Final = 0.001
"""Pitch of the raster on which areas are compared."""
PALPABLE: Final = 0.05
"""A lump whose |e| is smaller everywhere in the examined region is not palpable."""


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
        count = min(GRID.nearest, len(self.believed))
        distance, index = (np.asarray(a).reshape(len(xy), count) for a in self._tree.query(xy, k=count))
        weight = 1.0 / (distance + 1e-4)
        weight /= weight.sum(axis=1, keepdims=True)
        shift = (self.true - self.believed)[index, :2]
        return np.asarray(xy + (weight[..., None] * shift).sum(axis=1))


if TYPE_CHECKING:
    from palpate_tissue.backend import TissueBackend


class Pressed(NamedTuple):
    """Apparent stiffness of a patient by the standard press; p places, l lumps."""

    places: Array
    """Places [m], on the skin at rest, shape (p, 3), in A."""
    force: Array
    """Force of the patient as is [N], shape (p,)."""
    limited: Mask
    """True where the press ended at its limit, shape (p,)."""
    healthy: Array
    """Without any lump [N], shape (p,)."""
    alone: Array
    """Without one lump each [N], shape (l, p)."""
    relaxed: Array
    """Without guarding [N], shape (p,)."""
    plain: Array
    """Without structures [N], shape (p,)."""


def true_tissue(scenario: Scenario) -> TissueBackend | None:
    """Return the tissue of a scenario, of any implementation, at rest, on a body that does not move.

    None if it cannot be copied: an FMU with a file or a map of the user's, a custom service, real tissue.
    """
    from palpate_bus.implementations import create  # noqa: PLC0415 - imports a service, which reading results does not need
    from palpate_tissue.service import TissueService  # noqa: PLC0415

    chosen = scenario.services.tissue
    if chosen == "none" or (scenario.tissue.fmu or scenario.tissue.fmu_map) is not None:
        return None
    still = scenario.phantom.model_copy(update={"motion": Motion()})
    tier = "winkler" if chosen == "fmu" else chosen  # the tier with the equations of our own FMU
    service = create("tissue", tier, scenario.model_copy(update={"phantom": still}))
    return service.backend if isinstance(service, TissueService) else None


def resting_tissue(scenario: Scenario, **changes: Any) -> TissueBackend | None:
    """Return the tissue of a patient who does not breathe, with other fields of the phantom; None if it cannot be copied."""
    phantom = scenario.phantom.model_copy(update={"breathing": Breathing(kind="none"), **changes})
    return true_tissue(scenario.model_copy(update={"phantom": phantom}))


def press_patient(scenario: Scenario) -> Pressed | None:
    """Press the patient of a scenario over the examined region; return None if the tissue cannot be copied.

    Takes seconds; cached in the user's cache folder by patient, tier and indenter.
    """
    phantom, radius = scenario.phantom, scenario.robot.indenter_radius_m
    lesions, structures = phantom.lesions, phantom.structures
    body = resting_tissue(scenario)
    if body is None:
        return None
    model = body.model
    skin = TrueSurface(TrueBody(model.vertices, model.triangles, np.eye(4)))
    places, normals = _places(skin, scenario.exam, (*lesions, *structures))
    words = (phantom.model_copy(update={"breathing": Breathing(kind="none")}), scenario.services.tissue, radius)
    key = content_key("pressed", _code(scenario), *vars(model).values(), places, *words)

    def press(tissue: TissueBackend, where: Mask, otherwise: Array) -> Array:
        felt = otherwise.copy()
        if where.any():
            felt[where] = tissue.press(places[where], normals[where], radius)[0]
        return felt

    def compute() -> Array:
        force, limited = body.press(places, normals, radius)
        near = _near(places, lesions)
        healthy = force
        if near.any() and (without := resting_tissue(scenario, lesions=())) is not None:
            healthy = press(without, np.asarray(near.any(axis=0)), force)
        alone = []
        for i, mine in enumerate(near):
            felt = np.where(mine, healthy, force)
            shared = mine & np.delete(near, i, axis=0).any(axis=0)
            rest = (*lesions[:i], *lesions[i + 1 :])
            others = resting_tissue(scenario, lesions=rest) if shared.any() else None
            alone.append(felt if others is None else press(others, shared, felt))
        slack = resting_tissue(scenario, guarding=()) if phantom.guarding else None
        relaxed = force if slack is None else press(slack, np.ones(len(places), dtype=bool), force)
        bare = resting_tissue(scenario, structures=()) if structures else None
        plain = force if bare is None else press(bare, np.asarray(_near(places, structures).any(axis=0)), force)
        return np.stack((force, limited, healthy, relaxed, plain, *alone))

    rows = np.asarray(remember(key, compute))
    return Pressed(places, rows[0], rows[1] > 0, rows[2], rows[5:], rows[3], rows[4])


def _code(scenario: Scenario) -> list[Path]:
    """Return the source files that affect the result."""
    import palpate_tissue  # noqa: PLC0415 - as above

    files = [path for package in (palpate_models, palpate_tissue) for path in Path(package.__path__[0]).rglob("*.py")]
    chosen = Path(scenario.services.tissue)
    return sorted([*files, Path(__file__), *([chosen.resolve()] if chosen.suffix == ".py" else [])])


def _places(skin: TrueSurface, exam: Exam, areas: Sequence[Lesion | Structure]) -> tuple[Array, Array]:
    """Return places on the skin [m] and outward unit normals, shape (p, 3): a grid, finer near outlines."""
    centre, half = np.asarray(exam.centre_m), 0.5 * np.asarray(exam.region_m) + GRID.pitch_m
    count = np.ceil(half / GRID.fine_pitch_m - 1e-9).astype(int)
    count += count % 2  # the coarse grid is every second point of the fine one, up to the border
    i, j = (a.ravel() for a in np.meshgrid(*(np.arange(-n, n + 1) for n in count)))
    xy = centre + np.column_stack((i, j)) * half / count
    coarse = (i % 2 == 0) & (j % 2 == 0)
    edge = np.any([np.abs(edge_distance(xy, area)) <= GRID.pitch_m for area in areas], axis=0) if areas else coarse
    places, normals = skin.points(xy[coarse | edge])
    on_skin = np.isfinite(places).all(axis=1) & np.isfinite(normals).all(axis=1)
    return places[on_skin], normals[on_skin]


def _near(places: Array, areas: Sequence[Lesion | Structure]) -> Mask:
    """Return True where each area may be palpable, shape (l, p)."""
    near = [edge_distance(places[:, :2], area) <= GRID.reach_m + (area.depth_m or 0.0) for area in areas]
    return np.array(near, dtype=bool).reshape(len(areas), len(places))


class Lump(NamedTuple):
    """Palpable properties of a lump."""

    palpable: bool
    contrast: float
    """Felt contrast where |e| is maximal [1]; below 1 if softer than its surroundings."""
    centroid: Array
    """Centre of its area [m], shape (2,); where |e| is maximal if it is not palpable."""
    area: float
    """[m^2]; 0 if it is not palpable."""
    inside: Mask
    """Its area on the raster, shape (ny, nx)."""


class Felt:
    """Apparent stiffness by the standard press over the examined region and a border around it."""

    def __init__(self, pressed: Pressed, surface: TrueSurface, exam: Exam) -> None:
        mesh = Delaunay(pressed.places[:, :2])

        def between(values: Array) -> LinearNDInterpolator:
            return LinearNDInterpolator(mesh, values)

        self.pressed, self.surface = pressed, surface
        self._force = between(np.log(pressed.force))
        self._limited = between(pressed.limited.astype(float))
        self._excess = between(np.log(pressed.force / pressed.healthy))
        low, high = pressed.places[:, :2].min(axis=0), pressed.places[:, :2].max(axis=0)
        self._x, self._y = (np.arange(a + 0.5 * RASTER_M, b, RASTER_M) for a, b in zip(low, high, strict=True))
        xx, yy = np.meshgrid(self._x, self._y)
        self.raster = np.column_stack((xx.ravel(), yy.ravel()))
        """Raster points [m], shape (ny nx, 2)."""
        self.cells = surface.steepness(self.raster) * RASTER_M**2
        """Skin area of each raster point [m^2], shape (ny nx,)."""
        half = 0.5 * np.asarray(exam.region_m)
        self._examined = (np.abs(self.raster - exam.centre_m) <= half).all(axis=1).reshape(xx.shape)
        self.lumps = tuple(self._lump(between(np.log(pressed.force / alone))) for alone in pressed.alone)
        guard = np.nan_to_num(between(np.log(pressed.force / pressed.relaxed))(self.raster)).reshape(xx.shape)
        self.guarded: Mask = guard >= max(0.5 * float(guard.max()), PALPABLE)
        """Mask of guarding: at least half of its maximum effect, shape (ny, nx)."""
        changed = np.abs(np.nan_to_num(between(np.log(pressed.force / pressed.plain))(self.raster)).reshape(xx.shape))
        parts, count = label(changed >= PALPABLE)
        maxima = np.append(np.inf, maximum(changed, parts, np.arange(1, count + 1)))
        self.structured: Mask = changed >= 0.5 * maxima[parts]
        """Mask of structures: at least half of the maximum effect of each connected one that is palpable, shape (ny, nx)."""

    def force(self, xy: Array) -> Array:
        """Return apparent stiffness [N] at points [m], shape (p, 2) -> (p,); NaN outside the pressed places."""
        return np.asarray(np.exp(self._force(xy)))

    def limited(self, xy: Array) -> Mask:
        """Return True where the press ended at its limit, so `force` is a lower bound, shape (p,)."""
        return np.asarray(np.nan_to_num(self._limited(xy)) > 0.5)

    def excess(self, xy: Array) -> Array:
        """Return e of all lumps together at points, shape (p,); NaN outside the pressed places."""
        return np.asarray(self._excess(xy))

    def inside(self, area: Mask, xy: Array) -> Mask:
        """Return True for points [m], shape (p, 2), in an area of the raster, shape (p,)."""
        j = np.floor((xy[:, 1] - self._y[0]) / RASTER_M + 0.5).astype(np.intp)
        i = np.floor((xy[:, 0] - self._x[0]) / RASTER_M + 0.5).astype(np.intp)
        there = (i >= 0) & (i < len(self._x)) & (j >= 0) & (j < len(self._y))
        found = np.zeros(len(xy), dtype=bool)
        found[there] = area[j[there], i[there]]
        return found

    def in_lump(self, xy: Array) -> Mask:
        """Return True for points [m], shape (p, 2), in the area of any lump, shape (p,)."""
        found = np.zeros(len(xy), dtype=bool)
        for lump in self.lumps:
            found |= self.inside(lump.inside, xy)
        return found

    def _lump(self, excess: LinearNDInterpolator) -> Lump:
        e = np.nan_to_num(excess(self.raster)).reshape(self._examined.shape)
        peak = int(np.argmax(np.abs(e) * self._examined))
        extreme = float(e.ravel()[peak])
        if abs(extreme) < PALPABLE:
            return Lump(False, float(np.exp(extreme)), self.raster[peak], 0.0, np.zeros(e.shape, dtype=bool))
        parts, _ = label(e * np.sign(extreme) >= 0.5 * abs(extreme))
        inside = parts == parts.ravel()[peak]
        weight = self.cells * inside.ravel()
        area = float(weight.sum())
        return Lump(True, float(np.exp(extreme)), weight @ self.raster / area, area, inside)
