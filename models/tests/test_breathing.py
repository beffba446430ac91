"""Breaths: their rate, irregularity and shape, and that the seed decides them."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from palpate_models.patient.breathing import MOST_M, STILL, TABLE_S, Breathing, BreathingCurve

QUIET = Breathing(kind="quiet")


def table(seed: int = 0, **fields: object) -> np.ndarray:
    return BreathingCurve(Breathing.model_validate({"kind": "quiet", **fields}), seed).table


def many(**fields: object) -> np.ndarray:
    """The breaths of twenty patients, one after the other."""
    return np.concatenate([table(seed, **fields) for seed in range(20)])


def durations(breaths: np.ndarray) -> np.ndarray:
    return breaths[:, 1:4].sum(axis=1)


def cv(values: np.ndarray) -> float:
    return float(values.std() / values.mean())


def test_rate_and_depth_are_on_average_those_of_the_setting():
    breaths = many(rate_per_min=14, peak_to_peak_m=0.008)
    assert 60 / durations(breaths).mean() == pytest.approx(14, rel=0.03)
    assert breaths[:, 4].mean() == pytest.approx(0.008, rel=0.04)


def test_deep_breathing_is_slower_and_deeper_and_can_be_set():
    deep = Breathing(kind="deep")
    assert deep.rate_per_min < 8
    assert deep.peak_to_peak_m > 2 * QUIET.peak_to_peak_m
    assert Breathing(kind="deep", rate_per_min=12).rate_per_min == 12
    assert Breathing.model_validate(deep.model_dump()) == deep


def test_breaths_vary_as_much_as_is_set_and_remember_the_one_before():
    breaths = many(duration_cv=0.2, depth_cv=0.3, memory=0.28)
    assert cv(durations(breaths)) == pytest.approx(0.2, abs=0.02)
    assert cv(breaths[:, 4]) == pytest.approx(0.3, abs=0.03)
    for values in (durations(breaths), breaths[:, 4]):
        assert np.corrcoef(np.log(values[:-1]), np.log(values[1:]))[0, 1] == pytest.approx(0.28, abs=0.06)
    assert cv(breaths[:, 1] / durations(breaths)) == pytest.approx(0.179, abs=0.02)
    assert breaths[:, 2].mean() / breaths[:, 1].mean() == pytest.approx(1.2, abs=0.03)
    regular = table(duration_cv=0, depth_cv=0, timing_cv=0)
    assert np.ptp(regular[:, 1:], axis=0).max() < 1e-9


def test_expiration_is_longer_and_ends_with_a_pause():
    breaths = table(expiration_ratio=1.2, pause=0.1, timing_cv=0)
    np.testing.assert_allclose(breaths[:, 2] / breaths[:, 1], 1.2)
    np.testing.assert_allclose(breaths[:, 3] / durations(breaths), 0.1)


@pytest.mark.parametrize("fields", [{}, {"kind": "deep"}, {"kind": "held"}, {"coughs_per_min": 2}])
def test_the_curve_is_the_table_and_smooth_and_repeats(fields):
    curve = BreathingCurve(Breathing.model_validate({"kind": "quiet", **fields}), 3)
    start, inspiration, expiration, pause, amplitude = curve.table.T
    np.testing.assert_allclose(start[1:], (start + inspiration + expiration + pause)[:-1])
    assert start[0] <= 0
    assert start[0] + curve.repeats_s >= TABLE_S
    at = np.vectorize(curve.excursion)
    np.testing.assert_allclose(at(start), 0, atol=1e-15)
    np.testing.assert_allclose(at(start + inspiration), amplitude, rtol=1e-12)
    np.testing.assert_allclose(at(start + inspiration + expiration + 0.5 * pause), 0, atol=1e-15)
    t = np.arange(0, 90, 1e-3)
    values = at(t)
    assert values.min() == 0
    assert values.max() <= curve.largest_m
    steepest = (np.pi / 2 * amplitude / np.minimum(inspiration, expiration)).max()
    bend = (np.pi**2 / 2 * amplitude / np.minimum(inspiration, expiration) ** 2).max()
    assert np.abs(np.diff(values)).max() <= 1.001e-3 * steepest  # no jump
    assert np.abs(np.diff(values, 2)).max() <= 1.001e-6 * bend  # nor one of the speed
    np.testing.assert_allclose(at(t[:5000] + 7 * curve.repeats_s), values[:5000], atol=1e-12)
    np.testing.assert_allclose(at(t[:5000] - curve.repeats_s), values[:5000], atol=1e-12)


def test_the_seed_decides_the_breaths():
    first, again, other = (BreathingCurve(QUIET, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.table, again.table)
    assert abs(first.excursion(1.0) - other.excursion(1.0)) > 1e-5
    phases = [table(seed)[0, 0] for seed in range(60)]
    assert np.ptp(phases) > 0.8 * 60 / 14  # phases do not start with the examination


def test_the_held_breath_is_a_stretch_at_rest():
    breaths = table(kind="held", breathes_s=30, held_s=15)
    held = breaths[:, 3] > 15
    between = np.diff(breaths[held, 0])
    assert held.sum() > 8
    assert 40 < between.min() < between.max() < 56  # 30 s and what is left of a breath, then 15 s
    curve = BreathingCurve(Breathing(kind="held", breathes_s=30, held_s=15), 0)
    start, inspiration, expiration, _, _ = breaths[held][0]
    quiet = start + inspiration + expiration
    assert not any(curve.excursion(t) for t in np.linspace(quiet + 1e-9, quiet + 15, 50))


def test_coughs_come_in_bursts_and_leave_the_breaths_as_they_are():
    breaths = table(coughs_per_min=1)
    cough = breaths[:, 1] == 0.15
    bursts = np.diff(np.flatnonzero(np.diff(np.concatenate(([0], cough, [0])))))[::2]
    assert bursts.min() >= 2
    assert (bursts <= 3).mean() > 0.6  # two bursts may meet
    assert 4 < len(bursts) < 18
    assert 0.010 <= breaths[cough, 4].min() < breaths[cough, 4].max() <= 0.020
    calm = table()
    count = int((~cough).sum())
    np.testing.assert_array_equal(breaths[~cough][:, 1:], calm[:count, 1:])


def test_a_still_patient_does_not_breathe():
    assert BreathingCurve(Breathing(kind="none"), 5).table.shape == (0, 5)
    assert STILL.largest_m == 0
    assert STILL.excursion(1.3) == 0


@pytest.mark.parametrize(
    "fields",
    [{"kind": "loud"}, {"peak_to_peak_m": 8}, {"rate_per_min": 0}, {"cough_m": (0.02, 0.01)}, {"amplitude_m": 0.004}],
)
def test_bad_settings_are_refused_by_name(fields):
    with pytest.raises(ValidationError, match=next(iter(fields))):
        Breathing.model_validate(fields)


def test_no_breath_is_deeper_than_the_tissue_can_follow():
    assert many(kind="deep", peak_to_peak_m=0.025, depth_cv=0.5)[:, 4].max() == MOST_M
