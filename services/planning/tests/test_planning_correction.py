"""Tests of the correction of the perceived surface from touches."""

import numpy as np
import pytest

from palpate_planning.wall.wall import PRIOR, HeightMeasurement, TouchCorrection

PLACES = np.array([(x, y) for x in (-0.07, 0.0, 0.07) for y in (-0.07, 0.0, 0.07)])
BETWEEN = np.array([(x, y) for x in (-0.05, 0.03) for y in (-0.04, 0.06)])


def tilted(xy: np.ndarray) -> np.ndarray:
    """[m] outward."""
    return np.asarray(0.015 + xy @ np.array((0.012, -0.008)))


def test_without_touches_the_correction_is_zero_and_uncertain() -> None:
    correction = TouchCorrection()
    assert correction.height(np.zeros(2)) == 0.0
    assert correction.sigma(np.zeros(2)) == pytest.approx(np.hypot(PRIOR.offset_m, PRIOR.field_m))


def test_offset_and_tilt_are_found_in_between() -> None:
    correction = TouchCorrection()
    for place in PLACES:
        correction.touch(HeightMeasurement(place, float(tilted(place)), 2e-4))
    for place in BETWEEN:
        assert correction.height(place) == pytest.approx(float(tilted(place)), abs=3e-4)
        assert correction.sigma(place) < 0.0015
    assert correction.sigma(np.array((0.2, 0.2))) > correction.sigma(BETWEEN[0])


def test_touches_at_one_place_are_averaged() -> None:
    correction = TouchCorrection()
    for height in (0.0042, 0.0038):
        correction.touch(HeightMeasurement(np.zeros(2), height, 5e-4))
    assert correction.height(np.zeros(2)) == pytest.approx(0.004, abs=2e-5)
    assert correction.sigma(np.zeros(2)) == pytest.approx(5e-4 / np.sqrt(2), rel=0.01)


def test_errors_agree_with_the_reported_sd() -> None:
    rng = np.random.default_rng(3)
    everywhere = np.vstack((PLACES, BETWEEN))
    apart = np.sum((everywhere[:, None] - everywhere) ** 2, axis=-1)
    covariance = PRIOR.offset_m**2 + PRIOR.tilt_rad**2 * everywhere @ everywhere.T
    covariance += PRIOR.field_m**2 * np.exp(-apart / (2 * PRIOR.field_length_m**2))
    scores = []
    for _ in range(50):
        truth = rng.multivariate_normal(np.zeros(len(everywhere)), covariance)
        correction = TouchCorrection()
        for place, height in zip(PLACES, truth, strict=False):
            correction.touch(HeightMeasurement(place, float(height + 4e-4 * rng.standard_normal()), 4e-4))
        scores += [(correction.height(p) - h) / correction.sigma(p) for p, h in zip(BETWEEN, truth[len(PLACES) :], strict=True)]
    assert np.std(scores) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize(("rough_m", "most_m", "roughness"), [(0.0, 0.3e-3, (0.0, 0.3)), (1.2e-3, 1.5e-3, (0.5, 2.0))])
def test_touches_determine_the_roughness_of_the_error(rough_m: float, most_m: float, roughness: tuple[float, float]) -> None:
    """After 25 touches a smooth error is known to within the error of a touch, a rough one is not."""
    rng = np.random.default_rng(5)
    places = np.array([(x, y) for x in np.linspace(-0.09, 0.09, 5) for y in np.linspace(-0.09, 0.09, 5)])
    correction = TouchCorrection()
    for place in places:
        height = tilted(place) + rough_m * rng.standard_normal() + 2e-4 * rng.standard_normal()
        correction.touch(HeightMeasurement(place, float(height), 2.5e-4))
    assert roughness[0] <= correction.roughness <= roughness[1]
    assert correction.sigma(np.array((0.02, 0.02))) < most_m


def test_the_latest_touch_can_be_revised() -> None:
    revised, right = TouchCorrection(), TouchCorrection()
    for correction in (revised, right):
        correction.touch(HeightMeasurement(PLACES[0], 0.004, 4e-4))
    revised.touch(HeightMeasurement(PLACES[1], 0.006, 9e-4))
    revised.revise(HeightMeasurement(PLACES[1], 0.005, 4e-4))
    right.touch(HeightMeasurement(PLACES[1], 0.005, 4e-4))
    assert revised.height(PLACES[2]) == pytest.approx(right.height(PLACES[2]))
    assert revised.sigma(PLACES[2]) == pytest.approx(right.sigma(PLACES[2]))


def test_a_new_scan_keeps_offset_and_tilt_learned_from_touches() -> None:
    correction = TouchCorrection()
    for place in PLACES:
        correction.touch(HeightMeasurement(place, float(tilted(place)), 3e-4))
    before = correction.sigma(PLACES[0])
    correction.blur()
    assert correction.sigma(PLACES[0]) > before
    for place in BETWEEN:
        assert correction.height(place) == pytest.approx(float(tilted(place)), abs=5e-4)


def test_a_better_surface_needs_a_smaller_correction() -> None:
    rng = np.random.default_rng(5)
    apart = np.sum((PLACES[:, None] - PLACES) ** 2, axis=-1)
    bent = rng.multivariate_normal(
        np.zeros(len(PLACES)), (2 * PRIOR.field_m) ** 2 * np.exp(-apart / (2 * PRIOR.field_length_m**2))
    )
    correction = TouchCorrection()
    for place, field in zip(PLACES, bent, strict=True):
        correction.touch(HeightMeasurement(place, float(tilted(place) + field), 2e-4))
    better = correction.averaged(lambda xy: bent[[int(np.argmin(np.sum((PLACES - p) ** 2, axis=1))) for p in xy]])
    assert better.roughness < correction.roughness
    heights, sigmas = better.over(BETWEEN)
    assert heights == pytest.approx(tilted(BETWEEN), abs=2e-4)
    assert (sigmas < [correction.sigma(place) for place in BETWEEN]).all()


def test_successive_touches_share_the_error_of_the_breath() -> None:
    """Nine touches within three seconds leave the error of the breath in the offset; within three minutes they average it."""
    hasty, slow = TouchCorrection(), TouchCorrection()
    for number, place in enumerate(PLACES):
        hasty.touch(HeightMeasurement(place, 0.004, 1e-4, 5e-4, number / 3.0))
        slow.touch(HeightMeasurement(place, 0.004, 1e-4, 5e-4, number * 20.0))
    middle = PLACES[4]
    assert hasty.sigma(middle) == pytest.approx(5e-4, rel=0.2)
    assert slow.sigma(middle) < 0.7 * hasty.sigma(middle)
