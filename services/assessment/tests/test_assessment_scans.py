"""Whole scans of the default abdomen over the real tissue, on a few seeds."""

from __future__ import annotations

import pytest
from bench_assessment_scans import random_lesion, scan, scenario_with, scored

from palpate_models.patient.schema import Lesion, Phantom
from palpate_models.scenario.schema import Exam, Mode, Scenario

RLQ = Lesion(centre_m=(-0.055, -0.055), radii_m=(0.035, 0.030), contrast=4.0)
SMALL_RLQ = Lesion(centre_m=(-0.055, -0.055), radii_m=(0.030, 0.030), contrast=4.0)
LUQ = Lesion(centre_m=(0.055, 0.055), radii_m=(0.025, 0.025), contrast=3.5)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_healthy_has_no_finding(seed: int) -> None:
    s = scored(scan(scenario_with((), seed)))
    assert s.false_findings == 0
    assert s.coverage_90 is not None
    assert s.coverage_90 > 0.75


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_a_large_lesion_is_found(seed: int) -> None:
    s = scored(scan(scenario_with((RLQ,), seed)))
    assert (s.matched, s.missed, s.false_findings) == (1, 0, 0)
    assert s.dice is not None
    assert s.dice > 0.8
    assert s.place_error_m is not None
    assert s.place_error_m < 0.010, "within a fifth of the area's width"


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_both_lesions_are_found(seed: int) -> None:
    s = scored(scan(scenario_with((SMALL_RLQ, LUQ), seed)))
    assert (s.matched, s.missed, s.false_findings) == (2, 0, 0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_a_lesion_anywhere_is_found(seed: int) -> None:
    s = scored(scan(scenario_with((random_lesion(seed),), seed)))
    assert (s.matched, s.missed, s.false_findings) == (1, 0, 0)
    assert s.dice is not None
    assert s.dice > 0.7
    assert s.place_error_m is not None
    assert s.place_error_m < 0.012


@pytest.mark.slow
def test_point_by_point_says_the_same() -> None:
    lesion = Lesion(centre_m=(-0.012, -0.01), radii_m=(0.024, 0.020), contrast=4.0)
    exam = Exam(mode=Mode.POINT, region_m=(0.11, 0.10), spacing_m=0.010)
    s = scored(scan(Scenario(seed=4, phantom=Phantom(lesions=(lesion,)), exam=exam)))
    assert (s.matched, s.missed, s.false_findings) == (1, 0, 0)
    assert s.dice is not None
    assert s.dice > 0.8
    assert s.place_error_m is not None
    assert s.place_error_m < 0.005
