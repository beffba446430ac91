"""Scores of findings and map against the palpable truth, which the examination does not receive.

A finding matches a lump if their areas overlap by a Dice coefficient of MATCHING_DICE, or if its centroid lies in the lump's
area. The assignment is one to one, with most matches first and best overlap second. A candidate, which has no area on the map,
matches by its centroid, and only a lump that no finding matches. Places are those that the tool truly touched, in the xy plane
of the abdomen frame A; areas are on the skin.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator
from scipy.optimize import linear_sum_assignment
from scipy.spatial import Delaunay

from palpate.report.rows import FindingRow, FindingScore, Scores
from palpate.truth.pressed import Felt, Lump, Touched, TrueBody, TrueSurface
from palpate_models.numerics.frames import Array, Mask, apply

MATCHING_DICE: Final = 0.3


@dataclass(frozen=True)
class Map:
    """The stiffness map, in A as registered."""

    vertices: Array
    """[m], shape (n, 3)."""
    apparent: Array
    """Apparent stiffness [N], shape (n,)."""
    lower: Array
    """Lower end of its 90 % band [N]."""
    upper: Array
    scanned: Mask
    """Within reach of a sample."""
    finding: NDArray[np.int32]
    """Index of the finding of each vertex, -1 if none."""


class Truth(NamedTuple):
    """Truth of a run, for its scores."""

    body: TrueBody
    felt: Felt
    touched: Touched
    X_WA: Array
    """Pose of A in world as registered, shape (4, 4)."""


def score(found: Sequence[FindingRow], found_map: Map | None, truth: Truth, candidates: Sequence[FindingRow] = ()) -> Scores:
    """Return the scores of findings, of the map with their areas, and of candidates, the most probable first.

    Without a map a finding has only a place, like a candidate.
    """
    felt = truth.felt
    owner = np.full(len(felt.raster), -1) if found_map is None else _owner(found_map, felt.raster)
    places = truth.touched.places(felt.raster)
    masks = [owner == i for i in range(len(found))]
    dice = np.array([[_dice(felt, mask, places, lump) for lump in felt.lumps] for mask in masks])
    partner = _match(found, dice, _within(found, truth))
    excess = felt.excess(places)
    guarded, structured = (felt.inside(area, places) for area in (felt.guarded, felt.structured))
    rows = []
    for i, (finding, mask) in enumerate(zip(found, masks, strict=True)):
        lump = partner.get(i)
        known = mask & np.isfinite(excess)
        ratio = float(np.exp(np.average(excess[known], weights=felt.cells[known]))) if known.any() else None
        over = bool((mask & guarded).any()), bool((mask & structured).any())
        rows.append(_finding_score(finding, lump, None if lump is None else float(dice[i, lump]), ratio, over, truth))
    matched = [row for row in rows if row.lump is not None]
    palpable = sum(lump.palpable for lump in felt.lumps)
    coverage, in_lumps, guarding = (None, None, None) if found_map is None else _coverage(found_map, truth)
    return Scores(
        matched=len(matched),
        missed=palpable - len(matched),
        not_palpable=len(felt.lumps) - palpable,
        false_findings=sum(row.lump is None and not row.on_structure for row in rows),
        on_guarding=sum(row.on_guarding for row in rows),
        on_structure=sum(row.on_structure for row in rows),
        place_error_m=_mean([row.place_error_m for row in matched]),
        absolute_error_m=_mean([row.absolute_error_m for row in matched]),
        dice=None if found_map is None else _mean([row.dice for row in matched]),
        size_error=_mean([row.size_error for row in matched]),
        ratio_error=_mean([row.ratio_error for row in matched]),
        ratio_coverage_90=_mean([row.ratio_held for row in matched]),
        coverage_90=coverage,
        coverage_90_in_lumps=in_lumps,
        coverage_90_on_guarding=guarding,
        findings=tuple(rows),
        candidates=_candidate_scores(candidates, set(partner.values()), truth),
    )


def depth_errors(depth: Array, wanted: Array, in_lump: Mask) -> dict[str, float | None]:
    """Return the RMS of `depth` - `wanted` [m] over all, outside and in lumps, by the ends of its names; None without values."""

    def rms(chosen: Mask) -> float | None:
        return float(np.sqrt(np.mean((depth - wanted)[chosen] ** 2))) if chosen.any() else None

    return {"": rms(np.ones(len(depth), dtype=bool)), "_beside": rms(~in_lump), "_lump": rms(in_lump)}


def surface_error(perceived: Array, body: TrueBody, low: Array, high: Array) -> float | None:
    """Return the RMS distance [m] of perceived points, shape (n, 3), in A, from the true rest surface along its normal.

    Over the rectangle `low` to `high` [m] of the xy plane; None without points in it.
    """
    surface = TrueSurface(body)
    inside = perceived[np.all((perceived[:, :2] >= low) & (perceived[:, :2] <= high), axis=1)]
    rise = inside[:, 2] - surface.height(inside[:, :2])
    distance = (rise / surface.steepness(inside[:, :2]))[np.isfinite(rise)]
    return float(np.sqrt(np.mean(distance**2))) if len(distance) else None


def _dice(felt: Felt, mask: Mask, places: Array, lump: Lump) -> float:
    """Return the overlap of a finding's area, given by raster points, with a lump's, at the places truly touched."""
    if not lump.palpable or not mask.any():
        return 0.0
    both = float(felt.cells[mask & felt.inside(lump.inside, places)].sum())
    return 2 * both / (float(felt.cells[mask].sum()) + lump.area)


def _within(found: Sequence[FindingRow], truth: Truth) -> Mask:
    """Return True where the centroid of an area lies in the area of a lump, shape (findings, lumps)."""
    lumps = truth.felt.lumps
    if not found or not lumps:
        return np.zeros((len(found), len(lumps)), dtype=bool)
    centroids = truth.touched.places(np.array([f.centroid_m[:2] for f in found]))
    return np.stack([truth.felt.inside(lump.inside, centroids) for lump in lumps], axis=1)


def _candidate_scores(candidates: Sequence[FindingRow], taken: set[int], truth: Truth) -> tuple[FindingScore, ...]:
    """Return the scores of candidates. Each matches the first lump around its centroid that is not matched yet."""
    rows = []
    felt = truth.felt
    for candidate, within in zip(candidates, _within(candidates, truth), strict=True):
        lump = next((int(j) for j in np.flatnonzero(within) if int(j) not in taken), None)
        taken = taken | {lump} if lump is not None else taken
        centroid = truth.touched.places(np.array([candidate.centroid_m[:2]]))
        over = bool(felt.inside(felt.guarded, centroid)[0]), bool(felt.inside(felt.structured, centroid)[0])
        rows.append(_finding_score(candidate, lump, None, None, over, truth))
    return tuple(rows)


def _match(found: Sequence[FindingRow], dice: Array, within: Mask) -> dict[int, int]:
    """Return the lump of each matched finding."""
    if not within.size:
        return {}
    fits = (dice >= MATCHING_DICE) | within
    rows, columns = linear_sum_assignment(-(fits + 1e-3 * dice))
    return {int(i): int(j) for i, j in zip(rows, columns, strict=True) if fits[i, j]}


def _finding_score(
    finding: FindingRow, index: int | None, dice: float | None, true_ratio: float | None, over: tuple[bool, bool], truth: Truth
) -> FindingScore:
    """Return the score of a finding that matches the lump `index`; `over`: it lies on guarding, on a structure."""
    place = absolute = size = None
    if index is not None:
        lump = truth.felt.lumps[index]
        place = float(np.linalg.norm(truth.touched.places(np.array([finding.centroid_m[:2]]))[0] - lump.centroid))
        size = finding.area_m2 / lump.area - 1
        p_AL = np.append(lump.centroid, truth.felt.surface.height(lump.centroid[None])[0])
        off = apply(truth.X_WA, np.array([finding.centroid_m]))[0] - apply(truth.body.X_WA, p_AL[None])[0]
        outward = truth.body.X_WA[:3, 2]
        absolute = float(np.linalg.norm(off - (off @ outward) * outward))
    return FindingScore(
        lump=index,
        dice=dice,
        place_error_m=place,
        absolute_error_m=absolute,
        size_error=size,
        true_ratio=true_ratio,
        ratio_error=None if true_ratio is None else finding.ratio / true_ratio - 1,
        ratio_held=None if true_ratio is None else finding.ratio_90[0] <= true_ratio <= finding.ratio_90[1],
        on_guarding=index is None and over == (True, False),
        on_structure=index is None and over[1],
    )


def _coverage(found: Map, truth: Truth) -> tuple[float | None, ...]:
    """Return the share of the scanned area, and of its parts in lumps and on guarding, whose band includes the true stiffness.

    Where the standard press ended at its force limit, the upper end of the band decides.
    """
    felt, xy = truth.felt, truth.touched.places(found.vertices[found.scanned, :2])
    true, lower, upper = felt.force(xy), found.lower[found.scanned], found.upper[found.scanned]
    holds = (upper >= true) & ((lower <= true) | felt.limited(xy))
    weight = np.where(np.isfinite(true), felt.surface.steepness(xy), 0.0)
    parts = (weight, weight * felt.in_lump(xy), weight * felt.inside(felt.guarded, xy))
    return tuple(float(w[holds].sum() / w.sum()) if w.sum() > 0 else None for w in parts)


def _mean(values: Sequence[float | None]) -> float | None:
    """Return the mean of the magnitudes; None without any."""
    known = [abs(value) for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _owner(found: Map, points: Array) -> NDArray[np.int32]:
    """Return the finding of each point, -1 if none, by the half level of the interpolated membership."""
    owner = np.full(len(points), -1, dtype=np.int32)
    mesh = Delaunay(found.vertices[:, :2])
    for i in range(int(found.finding.max(initial=-1)) + 1):
        member = LinearNDInterpolator(mesh, (found.finding == i).astype(float), fill_value=0.0)(points)
        owner[member >= 0.5] = i
    return owner
