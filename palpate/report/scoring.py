"""Scores of findings and map against the truth. Kept apart from whatever makes them: nothing here is seen by the examination.

Everything is compared on a fine raster over the map, in the xy plane of the abdomen frame A; areas are on the true surface.
The truth's mask of a lesion is its half-contrast area. Distances are in xy of A.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator
from scipy.optimize import linear_sum_assignment
from scipy.spatial import Delaunay, cKDTree

from palpate_models.frames import Array

IntArray = NDArray[np.int32]
Mask = NDArray[np.bool_]

RASTER = 0.001
"""Pitch of the raster [m]."""
_EDGE_REACH = 0.01
"""A lesion's edge runs at most so far from its labelled vertices [m]."""
SCANNED_SHARE = 0.5
"""A lesion counts, as matched or missed, when this part of it was scanned."""


@dataclass(frozen=True)
class Truth:
    """The phantom, in A."""

    vertices: Array
    """Rest surface [m], shape (n, 3)."""
    triangles: IntArray
    """Shape (m, 3), counter-clockwise seen from outside."""
    stiffness: Array
    """k_w [N/m^3], shape (n,)."""
    background: Array
    """The same without lesions, shape (n,)."""
    lesion: IntArray
    """Index of the lesion in whose half-contrast area a vertex lies, -1 elsewhere, shape (n,)."""
    X_WA: Array
    """True pose of A in world, shape (4, 4)."""


@dataclass(frozen=True)
class Map:
    """The stiffness map, in A as registered."""

    vertices: Array
    """[m], shape (n, 3)."""
    stiffness: Array
    """k_w [N/m^3], shape (n,)."""
    lower: Array
    """Of its 90 % band."""
    upper: Array
    scanned: Mask
    """Within reach of a sample."""
    finding: IntArray
    """Index of the finding that a vertex belongs to, -1 where none."""


@dataclass(frozen=True)
class TrueLesion:
    """One lesion of the truth."""

    centroid: Array
    """Of its half-contrast area [m], shape (2,), xy of A."""
    area: float
    """[m^2] on the surface."""
    ratio: float
    """Mean stiffness in it over that without it [1]."""
    scanned: float
    """Part of it that was scanned [1]."""


@dataclass(frozen=True)
class Scores:
    """How good findings and map are."""

    localisation_error_m: float | None
    """Mean distance of the centroids of matched findings and lesions in xy of A; None where nothing matched."""
    dice: float | None
    """Of the findings' and the lesions' areas within the scanned region; None where there is neither."""
    matched: int
    missed: int
    false_positives: int
    coverage_90: float | None
    """Part of the scanned area on which the 90 % band holds the true stiffness; None without a map."""


class TrueSurface:
    """The outward (front) side of the true rest surface as functions of xy, in A."""

    def __init__(self, truth: Truth) -> None:
        corners = truth.vertices[truth.triangles]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        facing = normal[:, 2] > 0.1 * np.linalg.norm(normal, axis=1)
        front = np.unique(truth.triangles[facing])
        self._front = front
        self._mesh = Delaunay(truth.vertices[front, :2])
        self._height = LinearNDInterpolator(self._mesh, truth.vertices[front, 2])
        total = np.zeros((len(truth.vertices), 3))
        for k in range(3):
            np.add.at(total, truth.triangles[facing, k], normal[facing])
        self._steepness = LinearNDInterpolator(self._mesh, (np.linalg.norm(total, axis=1)[front] / total[front, 2]))

    def of(self, values: Array, xy: Array) -> Array:
        """A vertex quantity, shape (n,) or (n, k), at points xy [m], shape (p, 2); NaN off the surface."""
        return np.asarray(LinearNDInterpolator(self._mesh, values[self._front])(xy))

    def height(self, xy: Array) -> Array:
        """Height z [m] at points, shape (p,); NaN off the surface."""
        return np.asarray(self._height(xy))

    def steepness(self, xy: Array) -> Array:
        """Area of the surface over area in xy at points [1], shape (p,)."""
        return np.nan_to_num(self._steepness(xy), nan=1.0)


def raster(low: Array, high: Array) -> Array:
    """Points of a raster of pitch RASTER over a rectangle [m], shape (p, 2)."""
    x = np.arange(low[0] + 0.5 * RASTER, high[0], RASTER)
    y = np.arange(low[1] + 0.5 * RASTER, high[1], RASTER)
    xx, yy = np.meshgrid(x, y)
    return np.column_stack((xx.ravel(), yy.ravel()))


def true_lesions(truth: Truth, surface: TrueSurface, scanned: Map | None) -> tuple[list[TrueLesion], list[tuple[Array, Mask]]]:
    """The truth's lesions and, for each, the raster points and its mask on them."""
    lesions, masks = [], []
    for index in range(int(truth.lesion.max(initial=-1)) + 1):
        inside = truth.lesion == index
        if not inside.any():
            continue
        around = truth.vertices[inside, :2]
        points = raster(around.min(axis=0) - 0.01, around.max(axis=0) + 0.01)
        mask = lesion_of(truth, surface, points) == index
        weight = mask * surface.steepness(points) * RASTER**2
        area = float(weight.sum())
        seen = 0.0 if scanned is None else float(weight[_nearest(scanned, points, scanned.scanned)].sum()) / area
        ratio = truth.stiffness[inside] / truth.background[inside]
        lesions.append(TrueLesion(weight @ points / area, area, float(ratio.mean()), seen))
        masks.append((points, np.asarray(mask)))
    return lesions, masks


def lesion_of(truth: Truth, surface: TrueSurface, points: Array) -> IntArray:
    """The lesion in whose half-contrast area each point [m], shape (p, 2), lies, -1 elsewhere, shape (p,).

    Half contrast: stiffness over background above halfway from 1 to the lesion's greatest. The labelled vertices say which lesion
    a place belongs to, the interpolated stiffness where its edge runs between them.
    """
    owner = np.full(len(points), -1, dtype=np.int32)
    labelled = np.flatnonzero(truth.lesion >= 0)
    if not len(labelled):
        return owner
    ratio = truth.stiffness / truth.background
    distance, nearest = cKDTree(truth.vertices[labelled, :2]).query(points, distance_upper_bound=_EDGE_REACH)
    near = np.flatnonzero(np.isfinite(distance))
    lesion = truth.lesion[labelled[np.asarray(nearest)[near]]]
    half = np.zeros(int(truth.lesion.max()) + 1)
    np.maximum.at(half, truth.lesion[labelled], 0.5 * (1.0 + ratio[labelled]))
    inside = surface.of(ratio, points[near]) >= half[lesion]
    owner[near[inside]] = lesion[inside]
    return owner


def score(centroids: Array, found: Map | None, truth: Truth) -> Scores:
    """Scores of findings with `centroids` [m], shape (k, 2 or 3), in A, and of the map that holds their areas.

    A finding matches a lesion when their areas overlap; each counts once, so that the overlap is greatest. Without a map a
    finding is no more than a place: it matches the lesion in whose area it lies, and every lesion counts.
    """
    surface = TrueSurface(truth)
    lesions, masks = true_lesions(truth, surface, found)
    counted = [i for i, lesion in enumerate(lesions) if found is None or lesion.scanned >= SCANNED_SHARE]
    overlap = np.zeros((len(centroids), len(lesions)))
    for j, (points, mask) in enumerate(masks):
        if found is None:
            for i, centroid in enumerate(centroids):
                overlap[i, j] = np.linalg.norm(points[mask] - centroid[:2], axis=1).min() <= RASTER
            continue
        area = surface.steepness(points) * RASTER**2 * mask
        owner = _owner(found, points)
        for i in range(len(centroids)):
            overlap[i, j] = area[owner == i].sum()
    rows, columns = linear_sum_assignment(-overlap)
    pairs = [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if overlap[i, j] > 0]
    errors = [float(np.linalg.norm(centroids[i][:2] - lesions[j].centroid)) for i, j in pairs]
    hit = {j for _, j in pairs}
    return Scores(
        localisation_error_m=float(np.mean(errors)) if errors else None,
        dice=None if found is None else _dice(found, truth, surface),
        matched=len(pairs),
        missed=len([j for j in counted if j not in hit]),
        false_positives=len(centroids) - len(pairs),
        coverage_90=None if found is None else _coverage(found, truth, surface),
    )


def depth_errors(depth: Array, wanted: Array, in_lesion: Mask) -> dict[str, float | None]:
    """RMS of `depth` - `wanted` [m], over all and apart for healthy wall and lesions; None where there is nothing."""

    def rms(chosen: Mask) -> float | None:
        return float(np.sqrt(np.mean((depth - wanted)[chosen] ** 2))) if chosen.any() else None

    return {"all": rms(np.ones(len(depth), dtype=bool)), "healthy": rms(~in_lesion), "lesion": rms(in_lesion)}


def surface_error(perceived: Array, truth: Truth, low: Array, high: Array) -> float | None:
    """RMS distance [m] of perceived points, shape (n, 3), in A, from the true rest surface along its normal.

    Over the rectangle `low` to `high` [m] of the xy plane; None where no point lies in it.
    """
    surface = TrueSurface(truth)
    inside = perceived[np.all((perceived[:, :2] >= low) & (perceived[:, :2] <= high), axis=1)]
    rise = inside[:, 2] - surface.height(inside[:, :2])
    distance = (rise / surface.steepness(inside[:, :2]))[np.isfinite(rise)]
    return float(np.sqrt(np.mean(distance**2))) if len(distance) else None


def lesion_at(truth: Truth, points: Array) -> Mask:
    """Whether the vertex nearest to each point [m], shape (n, 3), in A, lies in a lesion's half-contrast area."""
    return np.asarray(truth.lesion[cKDTree(truth.vertices).query(points)[1]] >= 0)


def _dice(found: Map, truth: Truth, surface: TrueSurface) -> float | None:
    points = raster(found.vertices[:, :2].min(axis=0), found.vertices[:, :2].max(axis=0))
    points = points[_nearest(found, points, found.scanned)]
    area = surface.steepness(points)
    lesion = lesion_of(truth, surface, points) >= 0
    finding = _owner(found, points) >= 0
    both = float(area[lesion & finding].sum())
    total = float(area[lesion].sum() + area[finding].sum())
    return 2 * both / total if lesion.any() else None


def _coverage(found: Map, truth: Truth, surface: TrueSurface) -> float | None:
    xy = found.vertices[found.scanned, :2]
    true = np.exp(surface.of(np.log(truth.stiffness), xy))
    weight = np.where(np.isfinite(true), surface.steepness(xy), 0.0)
    holds = (found.lower[found.scanned] <= true) & (true <= found.upper[found.scanned])
    return float(weight[holds].sum() / weight.sum()) if weight.sum() > 0 else None


def _nearest(found: Map, points: Array, flag: Mask) -> Mask:
    """A flag of the map's vertices at points, by the nearest vertex; false farther off than the map's own pitch."""
    tree = cKDTree(found.vertices[:, :2])
    pitch = float(np.median(np.asarray(tree.query(found.vertices[:, :2], k=2)[0])[:, 1]))
    distance, index = tree.query(points)
    return np.asarray(flag[index] & (distance <= pitch))


def _owner(found: Map, points: Array) -> IntArray:
    """The finding that each point belongs to, -1 where none: half level of the interpolated membership."""
    owner = np.full(len(points), -1, dtype=np.int32)
    mesh = Delaunay(found.vertices[:, :2])
    for i in range(int(found.finding.max(initial=-1)) + 1):
        member = LinearNDInterpolator(mesh, (found.finding == i).astype(float), fill_value=0.0)(points)
        owner[member >= 0.5] = i
    return owner
