"""Map and findings of known bellies: what is found, where it ends, how wide the bands are, and what is not assessed."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from assessment_lines import LEVEL, flat_grid, level, lines, lump, natural

from palpate_assessment.assess import AssessedMap, assess, growing
from palpate_assessment.calibration import learned
from palpate_assessment.sampling import ForceSample
from palpate_bus.messages import StiffnessMap

REACH, FALSE_FINDINGS = 0.010, 0.02


def examine(samples: list[ForceSample]) -> AssessedMap:
    result = assess(samples, flat_grid(), REACH, FALSE_FINDINGS)
    assert result is not None
    return result


def held(result: AssessedMap, truth: np.ndarray) -> float:
    inside = result.unassessed == StiffnessMap.ASSESSED
    return float(((result.lower <= truth) & (truth <= result.upper))[inside].mean())


@pytest.mark.parametrize("seed", range(4))
def test_natural_variation_under_errors_is_no_finding_and_is_in_the_band(seed: int) -> None:
    wall = natural(seed, 0.15)
    result = examine(lines(lambda xy: LEVEL + wall(xy), seed, stroke_m=0.0007, breathing_m=0.0007))
    assert result.findings == []
    assert held(result, np.exp(LEVEL + wall(result.grid.nodes[:, :2]))) > 0.75


@pytest.mark.parametrize(("contrast", "radius"), [(2.5, 0.02), (4.0, 0.02), (4.0, 0.03), (0.3, 0.025)])
def test_a_lump_is_found_where_and_as_it_is(contrast: float, radius: float) -> None:
    centre, wall = (-0.015, 0.01), natural(4, 0.1)
    result = examine(lines(lambda xy: LEVEL + wall(xy) + lump(xy, centre, radius, contrast)))
    (found,) = result.findings
    assert np.linalg.norm(found.centroid[:2] - centre) < 0.004
    assert found.area == pytest.approx(np.pi * radius**2, rel=0.25)
    truth = lump(result.grid.nodes[found.nodes, :2], centre, radius, contrast)
    assert np.log(found.ratio) == pytest.approx(truth.mean(), abs=0.15)
    assert found.ratio_lower < found.ratio < found.ratio_upper
    assert found.confidence > 0.9


def test_two_lumps_are_two_findings() -> None:
    result = examine(lines(lambda xy: LEVEL + lump(xy, (-0.04, -0.03), 0.02, 4.0) + lump(xy, (0.04, 0.03), 0.02, 4.0)))
    assert len(result.findings) == 2


def test_a_lump_is_found_under_errors_of_depth() -> None:
    wall = natural(5, 0.1)
    samples = lines(lambda xy: LEVEL + wall(xy) + lump(xy, (0.01, 0.0), 0.025, 3.0), stroke_m=0.0007, breathing_m=0.0007)
    (found,) = examine(samples).findings
    assert np.linalg.norm(found.centroid[:2] - (0.01, 0.0)) < 0.008


def test_errors_of_strokes_widen_the_band() -> None:
    def width(result: AssessedMap) -> float:
        return float(np.median(np.log(result.upper / result.lower)[result.unassessed == StiffnessMap.ASSESSED]))

    exact, wrong = (examine(lines(level, stroke_m=error)) for error in (0.0, 0.001))
    assert width(wrong) > 1.2 * width(exact)


def test_a_lower_rate_of_false_findings_reports_less() -> None:
    wall, found = natural(3, 0.1), {1e-4: 0, 0.5: 0}
    for contrast in (1.2, 1.35, 1.5):
        bump = partial(lump, centre=(0.0, 0.0), radius=0.02, contrast=contrast)
        samples = lines(lambda xy, bump=bump: LEVEL + wall(xy) + bump(xy), stroke_m=0.0007, breathing_m=0.0007)
        weighed = []
        for rate in found:
            result = assess(samples, flat_grid(), REACH, rate)
            assert result is not None
            found[rate] += len(result.findings)
            weighed.append(len(result.findings) + len(result.candidates))
        assert weighed[0] == weighed[1]
    assert found[1e-4] < found[0.5]


def test_a_stroke_piece_that_the_others_contradict_is_not_assessed() -> None:
    def spoiled(sample: ForceSample) -> ForceSample:
        wrong = abs(sample.position[0]) < 0.012 and abs(sample.position[1] - 0.005) < 0.001
        return replace(sample, force=sample.force * 3.0) if wrong else sample

    result = examine([spoiled(sample) for sample in lines(level)])
    x, y = result.grid.nodes[:, :2].T
    there = (np.abs(x) < 0.008) & (np.abs(y - 0.005) < 0.004)
    assert (result.unassessed[there] == StiffnessMap.CONTRADICTED).all()
    assert result.findings == []
    assert (result.unassessed == StiffnessMap.CONTRADICTED).mean() < 0.1


def test_a_place_where_the_force_limit_was_met_far_above_the_depth_is_not_assessed() -> None:
    samples = [replace(s, force=15.0, depth=0.004, force_limited=True) if s.position[0] > 0.05 else s for s in lines(level)]
    result = examine(samples)
    x, y = result.grid.nodes[:, :2].T
    assert (result.unassessed[(x > 0.057) & (x < 0.07) & (np.abs(y) < 0.06)] == StiffnessMap.YIELDED).all()
    assert result.findings == []


def test_a_lump_whose_middle_yields_to_the_force_limit_is_one_finding() -> None:
    limit, calibration = 8.0, learned()

    def yielding(sample: ForceSample) -> ForceSample:
        depth = sample.depth * min(1.0, (limit / sample.force) ** (1 / calibration.exponent))
        return replace(sample, force=min(sample.force, limit), depth=depth, force_limited=sample.force > limit)

    samples = lines(lambda xy: LEVEL + lump(xy, (0.0, 0.0), 0.025, 4.0))
    (area,), (unlimited,) = (examine(felt).findings for felt in ([yielding(s) for s in samples], samples))
    assert np.hypot(*area.centroid[:2]) < 0.002
    assert area.area == pytest.approx(unlimited.area, rel=0.1)
    assert area.ratio == pytest.approx(unlimited.ratio, rel=0.05)


def test_the_map_says_what_was_not_reached() -> None:
    samples = [s for s in lines(level) if s.position[0] < 0]
    result = examine(samples)
    x, y = result.grid.nodes[:, :2].T
    assert (result.unassessed[x > 0.012] == StiffnessMap.NOT_REACHED).all()
    assert (result.unassessed[(np.abs(y) < 0.05) & (x < -0.005) & (x > -0.05)] == StiffnessMap.ASSESSED).all()
    widths = np.log(result.upper / result.lower)
    assert np.median(widths[x > 0.05]) > 1.3 * np.median(widths[result.unassessed == StiffnessMap.ASSESSED])


def test_too_few_samples_are_no_map() -> None:
    few = lines(level)[:5]
    assert assess(few, flat_grid(), REACH, FALSE_FINDINGS) is None
    assert growing(few, flat_grid(), REACH) is None


def test_a_growing_map_says_what_the_final_one_does() -> None:
    samples = lines(lambda xy: LEVEL + lump(xy, (0.0, 0.0), 0.025, 3.0))
    grown = growing(samples[::2], flat_grid(0.008), REACH)
    assert grown is not None
    inside = np.linalg.norm(grown.grid.nodes[:, :2], axis=1) < 0.01
    assert np.median(grown.apparent[inside]) == pytest.approx(3.0 * np.exp(LEVEL), rel=0.1)
    assert grown.findings == []
