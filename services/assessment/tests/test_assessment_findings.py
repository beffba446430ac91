"""Findings: what is one, what is not, and where it ends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from assessment_samples import CONTACT, flat_grid, samples_of

from palpate_assessment.apparent import Footprints
from palpate_assessment.assess import Assessment, assess
from palpate_assessment.findings import CONFIDENCE, SMALLEST, confidence, outline
from palpate_assessment.grid import MapGrid
from palpate_assessment.prior import BACKGROUND, Field
from palpate_models.press import DEPTH_M

LEVEL = np.log(1.7e5)


def background(grid: MapGrid, seed: int, cv: float = 0.2) -> np.ndarray:
    covariance = Field(grid, (replace(BACKGROUND, sd=cv),)).times(np.eye(grid.z.size)) + 1e-9 * np.eye(grid.z.size)
    rng = np.random.Generator(np.random.PCG64(seed))
    return LEVEL + np.linalg.cholesky(covariance) @ rng.standard_normal(grid.z.size)


def lump(grid: MapGrid, centre: tuple[float, float], radius: float, contrast: float, edge: float = 0.008) -> np.ndarray:
    beyond = np.linalg.norm(grid.nodes[:, :2] - centre, axis=1) - radius
    return np.log(1 + (contrast - 1) * np.clip(0.5 - beyond / edge, 0, 1))


def examine(grid: MapGrid, z: np.ndarray, noise: float = 0.01) -> Assessment:
    rng = np.random.Generator(np.random.PCG64(1))
    samples = [replace(s, force=s.force * float(np.exp(noise * rng.standard_normal()))) for s in samples_of(grid, z)]
    result = assess(samples, grid, CONTACT, 0.010)
    assert result is not None
    return result


@pytest.mark.parametrize("seed", range(6))
def test_natural_variation_is_no_finding(seed: int) -> None:
    grid = flat_grid()
    assert examine(grid, background(grid, seed)).findings == []


def test_a_rise_towards_the_costal_margin_is_no_finding() -> None:
    grid = flat_grid()
    rise = np.log(1 + 0.8 * np.clip((grid.nodes[:, 1] - 0.0) / 0.08, 0, 1))
    assert examine(grid, background(grid, 3) + rise).findings == []


def test_a_soft_area_is_no_finding() -> None:
    grid = flat_grid()
    assert examine(grid, background(grid, 2) + lump(grid, (0.01, 0.0), 0.025, 0.3)).findings == []


@pytest.mark.parametrize(("contrast", "radius"), [(2.5, 0.02), (4.0, 0.02), (4.0, 0.03), (8.0, 0.025)])
def test_a_lump_is_found_where_and_as_it_is(contrast: float, radius: float) -> None:
    grid = flat_grid()
    centre = (-0.015, 0.01)
    healthy = background(grid, 4, cv=0.1)
    wall = healthy + lump(grid, centre, radius, contrast)
    result = examine(grid, wall)
    (found,) = result.findings
    assert np.linalg.norm(found.centroid[:2] - centre) < 0.004
    assert found.area == pytest.approx(np.pi * radius**2, rel=0.25)
    felt = Footprints(grid, CONTACT, DEPTH_M).felt
    ratio = np.exp(np.log(felt(wall) / felt(healthy))[found.nodes].mean())
    assert found.ratio == pytest.approx(ratio, rel=0.15)
    assert found.ratio_lower < found.ratio < found.ratio_upper
    assert found.confidence >= CONFIDENCE


def test_two_lumps_are_two_findings() -> None:
    grid = flat_grid()
    z = background(grid, 5) + lump(grid, (-0.035, -0.03), 0.02, 4.0) + lump(grid, (0.035, 0.03), 0.02, 4.0)
    assert len(examine(grid, z).findings) == 2


def test_a_lump_smaller_than_the_smallest_is_left_alone() -> None:
    grid = flat_grid()
    result = examine(grid, np.full(grid.z.size, LEVEL) + lump(grid, (0.0, 0.0), 0.006, 3.0))
    assert all(f.area >= SMALLEST for f in result.findings)


def test_confidence_grows_with_the_ratio_and_falls_with_doubt() -> None:
    ratios = [0.1, 0.3, 0.5, 0.7, 1.0]
    values = [confidence(r, 0.01) for r in ratios]
    assert values == sorted(values)
    assert values[0] < 0.2
    assert values[-1] > 0.99
    assert confidence(0.6, 0.3) < confidence(0.6, 0.003)
    assert confidence(-0.5, 0.01) == 0.0


def test_outline_is_at_half_contrast() -> None:
    grid = flat_grid()
    excess = lump(grid, (0.0, 0.0), 0.03, 4.0)
    mask = outline(excess, excess > 0.2, grid)
    r = np.linalg.norm(grid.nodes[:, :2], axis=1)
    assert mask[r < 0.027].all()
    assert not mask[r > 0.033].any()


def test_the_map_says_what_was_not_scanned() -> None:
    grid = flat_grid()
    samples = [s for s in samples_of(grid, np.full(grid.z.size, LEVEL)) if s.position[0] < 0]
    result = assess(samples, grid, CONTACT, 0.010)
    assert result is not None
    assert not result.scanned[grid.nodes[:, 0] > 0.012].any()
    assert result.scanned[(np.abs(grid.nodes[:, 1]) < 0.05) & (grid.nodes[:, 0] < 0) & (grid.nodes[:, 0] > -0.05)].all()
    unseen = (result.upper / result.lower)[grid.nodes[:, 0] > 0.05]
    seen = (result.upper / result.lower)[result.scanned]
    assert np.median(unseen) > 1.5 * np.median(seen)


def test_too_few_samples_are_no_map() -> None:
    grid = flat_grid()
    assert assess(samples_of(grid, np.full(grid.z.size, LEVEL))[:5], grid, CONTACT, 0.010) is None


def test_the_force_map_is_the_force_at_the_common_depth() -> None:
    grid = flat_grid()
    result = assess(samples_of(grid, np.full(grid.z.size, LEVEL), depth=0.007), grid, CONTACT, 0.010)
    assert result is not None
    expected = 1.7e5 * float(CONTACT.force(np.array(0.010)))
    assert np.median(result.force[result.scanned]) == pytest.approx(expected, rel=0.03)
