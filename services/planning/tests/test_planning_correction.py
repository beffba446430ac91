"""The correction of the perceived surface, from touches."""

from __future__ import annotations

import numpy as np
import pytest

from palpate_planning.wall.correction import PRIOR, FeltHeight, SurfaceCorrection

PLACES = np.array([(x, y) for x in (-0.07, 0.0, 0.07) for y in (-0.07, 0.0, 0.07)])
BETWEEN = np.array([(x, y) for x in (-0.05, 0.03) for y in (-0.04, 0.06)])


def tilted(xy: np.ndarray) -> np.ndarray:
    """[m] outward."""
    return np.asarray(0.015 + xy @ np.array((0.012, -0.008)))


def test_untouched_it_is_nothing_and_unsure() -> None:
    correction = SurfaceCorrection()
    assert correction.height(np.zeros(2)) == 0.0
    assert correction.sigma(np.zeros(2)) == pytest.approx(np.hypot(PRIOR.offset_m, PRIOR.field_m))


def test_offset_and_tilt_are_found_in_between() -> None:
    correction = SurfaceCorrection()
    for place in PLACES:
        correction.touch(FeltHeight(place, float(tilted(place)), 2e-4))
    for place in BETWEEN:
        assert correction.height(place) == pytest.approx(float(tilted(place)), abs=3e-4)
        assert correction.sigma(place) < 0.0015
    assert correction.sigma(np.array((0.2, 0.2))) > correction.sigma(BETWEEN[0])


def test_touches_at_one_place_are_averaged() -> None:
    correction = SurfaceCorrection()
    for height in (0.0042, 0.0038):
        correction.touch(FeltHeight(np.zeros(2), height, 5e-4))
    assert correction.height(np.zeros(2)) == pytest.approx(0.004, abs=2e-5)
    assert correction.sigma(np.zeros(2)) == pytest.approx(5e-4 / np.sqrt(2), rel=0.01)


def test_its_errors_are_as_large_as_it_says() -> None:
    rng = np.random.default_rng(3)
    everywhere = np.vstack((PLACES, BETWEEN))
    apart = np.sum((everywhere[:, None] - everywhere) ** 2, axis=-1)
    covariance = PRIOR.offset_m**2 + PRIOR.tilt_rad**2 * everywhere @ everywhere.T
    covariance += PRIOR.field_m**2 * np.exp(-apart / (2 * PRIOR.field_length_m**2))
    scores = []
    for _ in range(50):
        truth = rng.multivariate_normal(np.zeros(len(everywhere)), covariance)
        correction = SurfaceCorrection()
        for place, height in zip(PLACES, truth, strict=False):
            correction.touch(FeltHeight(place, float(height + 4e-4 * rng.standard_normal()), 4e-4))
        scores += [(correction.height(p) - h) / correction.sigma(p) for p, h in zip(BETWEEN, truth[len(PLACES) :], strict=True)]
    assert np.std(scores) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize(("rough_m", "most_m", "roughness"), [(0.0, 0.3e-3, (0.0, 0.3)), (1.2e-3, 1.5e-3, (0.5, 2.0))])
def test_touches_tell_how_rough_the_error_is(rough_m: float, most_m: float, roughness: tuple[float, float]) -> None:
    """25 touches: a surface that they agree about is known within what a touch gets wrong, another one is not."""
    rng = np.random.default_rng(5)
    places = np.array([(x, y) for x in np.linspace(-0.09, 0.09, 5) for y in np.linspace(-0.09, 0.09, 5)])
    correction = SurfaceCorrection()
    for place in places:
        height = tilted(place) + rough_m * rng.standard_normal() + 2e-4 * rng.standard_normal()
        correction.touch(FeltHeight(place, float(height), 2.5e-4))
    assert roughness[0] <= correction.roughness <= roughness[1]
    assert correction.sigma(np.array((0.02, 0.02))) < most_m


def test_the_latest_touch_can_be_revised() -> None:
    revised, right = SurfaceCorrection(), SurfaceCorrection()
    for correction in (revised, right):
        correction.touch(FeltHeight(PLACES[0], 0.004, 4e-4))
    revised.touch(FeltHeight(PLACES[1], 0.006, 9e-4))
    revised.revise(FeltHeight(PLACES[1], 0.005, 4e-4))
    right.touch(FeltHeight(PLACES[1], 0.005, 4e-4))
    assert revised.height(PLACES[2]) == pytest.approx(right.height(PLACES[2]))
    assert revised.sigma(PLACES[2]) == pytest.approx(right.sigma(PLACES[2]))


def test_a_new_look_keeps_what_touches_told_of_offset_and_tilt() -> None:
    correction = SurfaceCorrection()
    for place in PLACES:
        correction.touch(FeltHeight(place, float(tilted(place)), 3e-4))
    before = correction.sigma(PLACES[0])
    correction.blur()
    assert correction.sigma(PLACES[0]) > before
    for place in BETWEEN:
        assert correction.height(place) == pytest.approx(float(tilted(place)), abs=5e-4)


def test_of_a_better_surface_the_same_touches_leave_less() -> None:
    rng = np.random.default_rng(5)
    apart = np.sum((PLACES[:, None] - PLACES) ** 2, axis=-1)
    bent = rng.multivariate_normal(
        np.zeros(len(PLACES)), (2 * PRIOR.field_m) ** 2 * np.exp(-apart / (2 * PRIOR.field_length_m**2))
    )
    correction = SurfaceCorrection()
    for place, field in zip(PLACES, bent, strict=True):
        correction.touch(FeltHeight(place, float(tilted(place) + field), 2e-4))
    better = correction.averaged(lambda xy: bent[[int(np.argmin(np.sum((PLACES - p) ** 2, axis=1))) for p in xy]])
    assert better.roughness < correction.roughness
    heights, sigmas = better.over(BETWEEN)
    assert heights == pytest.approx(tilted(BETWEEN), abs=2e-4)
    assert (sigmas < [correction.sigma(place) for place in BETWEEN]).all()


def test_touches_in_a_row_share_what_the_breath_erred_by() -> None:
    """Nine of them within three seconds tell the offset no better than the breath was followed, within three minutes they do."""
    hasty, slow = SurfaceCorrection(), SurfaceCorrection()
    for number, place in enumerate(PLACES):
        hasty.touch(FeltHeight(place, 0.004, 1e-4, 5e-4, number / 3.0))
        slow.touch(FeltHeight(place, 0.004, 1e-4, 5e-4, number * 20.0))
    middle = PLACES[4]
    assert hasty.sigma(middle) == pytest.approx(5e-4, rel=0.2)
    assert slow.sigma(middle) < 0.7 * hasty.sigma(middle)
