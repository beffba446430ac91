"""Persons and lumps below the skin: every bound that `palpate validate` prints of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate_validation import buried, guarding, persons, population
from palpate_validation.check import PageSection
from palpate_validation.population import PopulationSample


def assert_bounds(section: PageSection) -> None:
    missed = [f"{c.name}: {c.measured} {c.unit}, want {c.bound}" for c in section.checks if c.passed is False]
    assert not missed
    assert any(c.passed for c in section.checks)


def test_persons_have_the_statistics_of_the_measured_people() -> None:
    assert_bounds(population.section())


def test_people_all_alike_or_too_stiff_would_be_found_out() -> None:
    people = population.measured()
    alike = PopulationSample(people.person, np.tile(np.median(people.force, axis=0), (len(people.force), 1)))
    stiff = PopulationSample(people.person, 1.3 * people.force)
    for wrong in (alike, stiff):
        assert any(check.passed is False for check in population.section(wrong).checks)


def test_bone_is_felt_as_bone() -> None:
    assert_bounds(persons.section())


def test_lumps_below_the_skin_against_the_elastic_tier() -> None:
    assert_bounds(buried.section())


def test_voluntary_guarding_gives_way_under_a_press_and_more_under_strokes() -> None:
    assert_bounds(guarding.section())


def test_guarding_that_never_fades_would_be_found_out() -> None:
    found = guarding.measure()
    stubborn = {**found.strokes, "voluntary": found.strokes["involuntary"]}
    assert any(check.passed is False for check in guarding.section(replace(found, strokes=stubborn)).checks)


@pytest.mark.slow
def test_the_elastic_tier_still_says_so() -> None:
    lump = next(one for one in buried.ELASTIC_TIER if (one.radius_m, one.depth_m, one.contrast) == (0.020, 0.010, 4.0))
    assert buried.on_elastic_tier(lump) == pytest.approx(lump.ratio, rel=0.005)
