"""The regression: amplitudes that data of known amplitudes have, the check of its predictions, and the standard press."""

import numpy as np
import pytest
from assessment_lines import LEVEL, UP, level, lines, lump, natural, observations, regression

from palpate_assessment.assess import AssessedMap, assess
from palpate_assessment.detection import limit_strength
from palpate_assessment.grid import map_grid
from palpate_assessment.model import Regression, fit_log_amplitudes
from palpate_assessment.observations import Observations
from palpate_assessment.sampling import ForceSample
from palpate_assessment.shape_search import find_disc, match_bumps
from palpate_assessment.shapes import Bump, ridge
from palpate_assessment.standard import LENGTHS, PressStandard


def observed(stroke_m: float = 0.0) -> Observations:
    wall = natural(0, 0.15)
    return observations(lines(lambda xy: LEVEL + wall(xy), stroke_m=stroke_m))


@pytest.mark.parametrize("stroke_m", [0.0005, 0.0015])
def test_errors_of_the_strokes_are_found_from_the_data(stroke_m: float) -> None:
    found = fit_log_amplitudes(observed(stroke_m), ())
    assert np.exp(found[len(LENGTHS.fields_m) + 2]) == pytest.approx(stroke_m, rel=0.6)


def test_the_field_is_followed_and_its_uncertainty_grows_beyond_the_samples() -> None:
    wall, o = natural(0, 0.15), observed()
    fitted = Regression(o, (), fit_log_amplitudes(o, ()))
    mean, sd = fitted.field(o.xy)
    assert mean == pytest.approx(LEVEL + wall(o.xy), abs=0.05)
    _, far = fitted.field(o.xy + np.array((0.3, 0.0)))
    assert far.min() > 1.5 * sd.max()


def test_the_matched_filter_reads_a_bump_without_bias() -> None:
    bump = Bump(0.0, 0.0, 0.02)
    (log_contrast,), (t,) = match_bumps(regression(lines(lambda xy: LEVEL + 0.4 * bump(xy), noise=0.002)), [bump])
    assert log_contrast == pytest.approx(0.4, abs=0.05)
    assert t > 3


@pytest.mark.parametrize("edge", [0.007, 0.013])
def test_the_edge_with_which_a_lump_is_felt_is_found(edge: float) -> None:
    lump = Bump(0.005, -0.01, 0.02, edge)
    found, t = find_disc(regression(lines(lambda xy: LEVEL + 0.8 * lump(xy), noise=0.01)))
    assert found is not None
    assert found.edge == pytest.approx(edge, rel=0.2)
    assert found.radius == pytest.approx(lump.radius, rel=0.15)
    assert t > 5


def test_what_one_stroke_alone_says_is_not_believed() -> None:
    """A hiccup of a second lifts the force along three centimetres of one stroke, a lump that of all strokes over it."""
    bump, smooth = Bump(0.0, 0.005, 0.015), lines(level, noise=0.005)
    hiccup = [s._replace(force=1.3 * s.force) if s.stroke == 6 and abs(s.position[0]) < 0.015 else s for s in smooth]
    lumpy = lines(lambda xy: LEVEL + lump(xy, (0.0, 0.005), 0.015, 1.3), noise=0.005)
    shares = []
    for samples in (hiccup, lumpy):
        prior = regression(samples)
        (t,) = match_bumps(prior, [bump])[1]
        shares.append(limit_strength(prior, bump, float(t)) / t)
    assert shares[0] < 0.5
    assert shares[1] == pytest.approx(1.0, rel=0.15)


def test_a_lump_in_the_model_takes_its_contrast() -> None:
    bump, samples = Bump(0.0, 0.0, 0.02), lines(lambda xy: LEVEL + lump(xy, (0.0, 0.0), 0.02, 2.0))
    mean, covariance = regression(samples, bump).contrast(bump, np.zeros((1, 2)))
    assert np.exp(mean[0]) == pytest.approx(2.0, rel=0.15)
    assert covariance[0, 0] > 0


def test_strokes_determine_the_zero_of_the_force_and_the_level_becomes_uncertain() -> None:
    zeros, wall = 0.25 * np.random.default_rng(0).standard_normal(20), natural(1, 0.1)
    steady = lines(lambda xy: LEVEL + wall(xy))
    found = []
    for samples in (steady, [s._replace(force=s.force + float(zeros[s.stroke])) for s in steady]):
        o = observations(samples)
        fitted = Regression(o, (), fit_log_amplitudes(o, ()))
        found.append((np.exp(fitted.log_amplitudes[-2]), fitted.field(np.zeros((1, 2)))[1][0]))
    (small, sure), (large, unsure) = found
    assert large > 1.3 * small
    assert unsure > 1.2 * sure


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
    return [
        ForceSample(10.0 * k, np.array((*p, 0.0)), UP, np.zeros(3), DEPTH, float(np.exp(f)), 0.02, 1.0, False, k)
        for k, (p, f) in enumerate(zip(xy, log_force, strict=True))
    ]


def examined(samples: list[ForceSample]) -> AssessedMap:
    standard = PressStandard.of(samples, RADIUS, 1.2)
    surface = np.array([sample.position for sample in samples])
    grid = map_grid(surface, (0.0, 0.0), (0.04, 0.04), standard.lengths.pitch_m, standard.lengths.node_m)
    result = assess(samples, grid, 0.002, 0.02, standard)
    assert result is not None
    return result


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


def test_a_ridge_whose_ends_coincide_is_a_disc() -> None:
    xy = np.array(((0.0, 0.0), (0.01, 0.0), (0.03, 0.02)))
    band = ridge(np.zeros((2, 2)), 0.005, 0.007)
    np.testing.assert_allclose(band(xy), Bump(0.0, 0.0, 0.005, 0.007)(xy))
