"""Scores against phantoms whose answer is known by geometry."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.report import scoring
from palpate.report.scoring import Map, Truth

CENTRE, RADIUS = np.array((-0.03, -0.02)), 0.03


def plane(half: float = 0.12, pitch: float = 0.005, slope: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    n = round(2 * half / pitch) + 1
    axis = np.linspace(-half, half, n)
    x, y = np.meshgrid(axis, axis)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    triangles = np.concatenate(
        (np.column_stack((corner, corner + 1, corner + n + 1)), np.column_stack((corner, corner + n + 1, corner + n)))
    )
    return np.column_stack((x.ravel(), y.ravel(), slope * x.ravel())), triangles.astype(np.int32)


def disc(points: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    return np.linalg.norm(points[:, :2] - centre, axis=1) < radius


def truth(lesions: list[tuple[np.ndarray, float]], slope: float = 0.0, pitch: float = 0.004) -> Truth:
    vertices, triangles = plane(0.14, pitch, slope)
    label = np.full(len(vertices), -1, dtype=np.int32)
    ratio = np.ones(len(vertices))
    for i, (centre, radius) in enumerate(lesions):
        beyond = np.linalg.norm(vertices[:, :2] - centre, axis=1) - radius
        label[beyond < 0] = i
        ratio = np.maximum(ratio, 1.0 + 3.0 * np.clip(0.5 - beyond / 0.008, 0.0, 1.0))
    background = np.full(len(vertices), 1.7e5)
    return Truth(vertices, triangles, background * ratio, background, label, np.eye(4))


def found(findings: list[tuple[np.ndarray, float]], factor: float = 1.0, scanned: float = 0.10) -> Map:
    vertices, _ = plane(0.12, 0.004)
    finding = np.full(len(vertices), -1, dtype=np.int32)
    for i, (centre, radius) in enumerate(findings):
        finding[disc(vertices, centre, radius)] = i
    stiffness = np.full(len(vertices), 1.7e5 * factor)
    reached = (np.abs(vertices[:, :2]) <= scanned + 1e-9).all(axis=1)
    return Map(vertices, stiffness, 0.9 * stiffness, 1.1 * stiffness, reached, finding)


def centroids(findings: list[tuple[np.ndarray, float]]) -> np.ndarray:
    return np.array([(*c, 0.0) for c, _ in findings]).reshape(-1, 3)


def test_a_perfect_finding() -> None:
    areas = [(CENTRE, RADIUS)]
    s = scoring.score(centroids(areas), found(areas), truth(areas))
    assert (s.matched, s.missed, s.false_positives) == (1, 0, 0)
    assert s.dice == pytest.approx(1.0, abs=0.04)  # the map says which vertices, not where the edge runs between
    assert s.localisation_error_m == pytest.approx(0.0, abs=3e-4)


def test_a_shifted_finding_has_the_lens_of_two_circles() -> None:
    shift = 0.012
    areas = [(CENTRE + np.array((shift, 0.0)), RADIUS)]
    s = scoring.score(centroids(areas), found(areas), truth([(CENTRE, RADIUS)]))
    half = shift / 2 / RADIUS
    lens = 2 * (np.arccos(half) - half * np.sqrt(1 - half**2)) / np.pi
    assert s.dice == pytest.approx(lens, abs=0.02)
    assert s.localisation_error_m == pytest.approx(shift, abs=5e-4)


def test_nothing_to_find_and_nothing_found() -> None:
    s = scoring.score(centroids([]), found([]), truth([]))
    assert (s.matched, s.missed, s.false_positives) == (0, 0, 0)
    assert s.dice is None
    assert s.localisation_error_m is None


def test_a_finding_in_a_healthy_abdomen_is_false() -> None:
    areas = [(CENTRE, RADIUS)]
    s = scoring.score(centroids(areas), found(areas), truth([]))
    assert (s.matched, s.false_positives, s.dice) == (0, 1, None)


def test_a_missed_lesion() -> None:
    s = scoring.score(centroids([]), found([]), truth([(CENTRE, RADIUS)]))
    assert (s.matched, s.missed, s.dice, s.localisation_error_m) == (0, 1, 0.0, None)


def test_two_findings_on_one_lesion_count_once() -> None:
    areas = [(CENTRE + np.array((0.014, 0.0)), 0.012), (CENTRE - np.array((0.016, 0.0)), 0.010)]
    s = scoring.score(centroids(areas), found(areas), truth([(CENTRE, RADIUS)]))
    assert (s.matched, s.false_positives) == (1, 1)
    assert s.localisation_error_m == pytest.approx(0.014, abs=1e-3)  # the one with the greater overlap


def test_findings_are_matched_to_their_own_lesions() -> None:
    lesions = [(CENTRE, RADIUS), (np.array((0.05, 0.05)), 0.02)]
    areas = lesions[::-1]
    s = scoring.score(centroids(areas), found(areas), truth(lesions))
    assert (s.matched, s.missed, s.false_positives) == (2, 0, 0)
    assert s.localisation_error_m == pytest.approx(0.0, abs=3e-4)


def test_a_lesion_outside_the_scanned_region_is_not_missed() -> None:
    s = scoring.score(centroids([]), found([], scanned=0.05), truth([(np.array((0.08, 0.08)), 0.02)]))
    assert (s.matched, s.missed) == (0, 0)


@pytest.mark.parametrize(("factor", "coverage"), [(1.0, 1.0), (1.05, 1.0), (1.2, 0.0)])
def test_coverage_is_the_area_where_the_band_holds(factor: float, coverage: float) -> None:
    s = scoring.score(centroids([]), found([], factor), truth([]))
    assert s.coverage_90 == pytest.approx(coverage)


def test_coverage_leaves_out_the_lesion_that_the_map_misses() -> None:
    s = scoring.score(centroids([]), found([]), truth([(CENTRE, RADIUS)]))
    assert s.coverage_90 == pytest.approx(1 - np.pi * RADIUS**2 / 0.04, abs=0.035)


def test_areas_are_on_the_surface() -> None:
    lesions, _ = scoring.true_lesions(tilted := truth([(CENTRE, RADIUS)], slope=0.75), scoring.TrueSurface(tilted), None)
    assert lesions[0].area == pytest.approx(1.25 * np.pi * RADIUS**2, rel=0.03)
    assert lesions[0].centroid == pytest.approx(CENTRE, abs=3e-4)
    assert lesions[0].ratio == pytest.approx(4.0, abs=0.4)


def test_surface_error_is_along_the_normal() -> None:
    tilted = truth([], slope=0.75)
    off = tilted.vertices + np.array((0.0, 0.0, 0.001))
    low, high = np.array((-0.1, -0.1)), np.array((0.1, 0.1))
    assert scoring.surface_error(off, tilted, low, high) == pytest.approx(0.0008, rel=1e-3)
    assert scoring.surface_error(off[:0], tilted, low, high) is None


def test_depth_errors_apart_for_healthy_wall_and_lesion() -> None:
    wanted = np.full(4, 0.01)
    e = scoring.depth_errors(wanted + np.array((0.001, -0.001, 0.002, 0.002)), wanted, np.array((False, False, True, True)))
    assert e["healthy"] == pytest.approx(0.001)
    assert e["lesion"] == pytest.approx(0.002)
    assert e["all"] == pytest.approx(np.sqrt(2.5e-6))
    assert scoring.depth_errors(wanted[:0], wanted[:0], np.zeros(0, bool)) == {"all": None, "healthy": None, "lesion": None}


def test_the_map_grid_need_not_be_the_truths() -> None:
    """Dice of the same disc on a 5 mm and a 2.5 mm mesh stays high: the edge is interpolated."""
    areas = [(CENTRE, RADIUS)]
    s = scoring.score(centroids(areas), found(areas), truth(areas, pitch=0.005))
    assert s.dice is not None
    assert s.dice > 0.96


def test_without_a_map_a_finding_is_a_place_in_a_lesion_or_beside_it() -> None:
    lesions = [(CENTRE, RADIUS)]
    inside, beside = CENTRE + np.array((0.01, 0.0)), CENTRE + np.array((RADIUS + 0.02, 0.0))
    s = scoring.score(centroids([(inside, RADIUS), (beside, RADIUS)]), None, truth(lesions))
    assert (s.matched, s.missed, s.false_positives, s.dice, s.coverage_90) == (1, 0, 1, None, None)
    assert s.localisation_error_m == pytest.approx(0.01, abs=3e-4)
    s = scoring.score(centroids([]), None, truth(lesions))
    assert (s.matched, s.missed, s.false_positives, s.localisation_error_m) == (0, 1, 0, None)
