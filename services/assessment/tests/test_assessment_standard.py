"""Another body, indenter and depth than the abdomen's: presses of 2 mm with a ball of 6 mm on a small phantom."""

import numpy as np
import pytest

from palpate_assessment.assess import AssessedMap, assess
from palpate_assessment.grid import map_grid
from palpate_assessment.sampling import ForceSample
from palpate_assessment.shapes import Bump, ridge
from palpate_assessment.standard import LENGTHS, USUAL, PressStandard

RADIUS, DEPTH, FORCE = 0.006, 0.002, 1.0
VESSEL = ridge(np.array(((-0.015, 0.0), (0.0, 0.002), (0.014, 0.008))), 0.0025, 0.0025)
BALL = Bump(0.005, -0.004, 0.004, 0.0025)


def presses(shape: Bump | None, seed: int = 0, noise: float = 0.04, contrast: float = 1.5) -> list[ForceSample]:
    rng = np.random.default_rng(seed)
    axis = np.arange(-0.02, 0.0201, 0.0025)
    xy = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    log_force = np.log(FORCE) + 0.05 * np.sin(xy[:, 0] / 0.01) + noise * rng.standard_normal(len(xy))
    if shape is not None:
        log_force += np.log(contrast) * shape(xy)
    up, still = np.array((0.0, 0.0, 1.0)), np.zeros(3)
    return [
        ForceSample(10.0 * k, np.array((*p, 0.0)), up, still, DEPTH, float(np.exp(f)), 0.02, 1.0, False, k)
        for k, (p, f) in enumerate(zip(xy, log_force, strict=True))
    ]


def examined(samples: list[ForceSample]) -> AssessedMap:
    standard = PressStandard.of(samples, RADIUS, 1.2)
    surface = np.array([sample.position for sample in samples])
    grid = map_grid(surface, (0.0, 0.0), (0.04, 0.04), standard.lengths.pitch_m, standard.lengths.node_m)
    result = assess(samples, grid, 0.002, 0.02, standard)
    assert result is not None
    return result


def test_lengths_scale_with_the_footprint() -> None:
    small = PressStandard(RADIUS, DEPTH)
    scale = np.sqrt(2 * 6 * 2 - 2**2) / np.sqrt(2 * 15 * 10 - 10**2)
    assert USUAL.lengths == LENGTHS
    assert small.lengths.edge_m == pytest.approx(scale * LENGTHS.edge_m)
    assert small.lengths.fields_m == pytest.approx(scale * np.array(LENGTHS.fields_m))


@pytest.mark.parametrize(("shape", "long"), [(VESSEL, True), (BALL, False)])
def test_a_curved_vessel_and_a_ball_are_found_as_they_are(shape: Bump, long: bool) -> None:
    result = examined(presses(shape))
    (found,) = result.findings
    truth = shape(result.grid.nodes[:, :2]) > 0.5
    assert 2 * (truth & found.nodes).sum() / (truth.sum() + found.nodes.sum()) > 0.6
    assert (found.length > 0.02) == long
    assert result.background == pytest.approx(FORCE, rel=0.05)


def test_a_plain_body_has_no_finding_and_its_band_holds_what_a_press_feels() -> None:
    result = examined(presses(None))
    assert result.findings == []
    again = np.array([sample.force for sample in presses(None, seed=1)])
    at = [int(np.argmin(np.hypot(*(result.grid.nodes[:, :2] - s.position[:2]).T))) for s in presses(None)]
    assert 0.8 < ((result.lower[at] <= again) & (again <= result.upper[at])).mean() <= 0.98
