"""The tissue's comparisons: every bound that `palpate validate` prints."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from palpate_models.patient.remus2024 import relaxed_people
from palpate_models.patient.schema import Stiffness
from palpate_validation import drop, energy, hertz, lumps, meshes, people, relaxation
from palpate_validation.check import Check, PageSection
from palpate_validation.foundation import lump, static_force, uniform
from palpate_validation.indentation import SPACING_M
from palpate_validation.people_fit import at_depths, fit


def assert_bounds(section: PageSection) -> None:
    missed = [f"{c.name}: {c.measured} {c.unit}, want {c.bound}" for c in section.checks if c.passed is False]
    assert not missed
    assert any(c.passed for c in section.checks)


def test_surface_tier_against_hertz() -> None:
    assert_bounds(hertz.section(hertz.measure((0.020,))))


def test_hertz_is_what_the_design_facts_compute() -> None:
    np.testing.assert_allclose(
        hertz.hertz_force(np.array((0.002, 0.005, 0.010, 0.015)), 0.020), (0.222, 0.877, 2.481, 4.559), atol=6e-4
    )


def test_where_it_stops_being_right_is_found() -> None:
    depths = np.array((0.001, 0.005, 0.010, 0.020))
    curves = hertz.HertzCurves((0.02,), depths, np.array([[1.5, 1.0, 1.0, 0.7]]), np.ones((1, 4)))
    low, high = curves.within(0.02)
    assert low == pytest.approx(0.0042, abs=1e-4)  # where the error crosses 10 % on straight lines
    assert high == pytest.approx(0.01333, abs=1e-4)


def test_lumps_against_the_continuum() -> None:
    assert_bounds(lumps.section())


def test_the_continuum_is_winklers_without_shear() -> None:
    """Without G the force is k_w times the volume of the spherical cap."""
    depth, radius = 0.006, 0.020
    cap = np.pi * depth**2 * (3 * radius - depth) / 3
    assert static_force(depth, radius, uniform(1e5), uniform(1e-9), h=5e-5) == pytest.approx(1e5 * cap, rel=2e-3)
    assert static_force(depth, radius, lump(1e5, 0.05, 3.0, 0.001), uniform(1e-9), h=5e-5) == pytest.approx(3e5 * cap, rel=2e-3)


def test_mesh_halving_and_superposition() -> None:
    assert_bounds(meshes.section())


def test_relaxation_is_read_back_from_the_force() -> None:
    assert_bounds(relaxation.section())


def test_a_sixth_of_the_living_people() -> None:
    assert_bounds(people.section(people.measure(relaxed_people()[::6])))


@pytest.mark.slow
def test_all_living_people() -> None:
    assert_bounds(people.section())


def test_people_are_fitted_by_the_wall_that_made_the_force() -> None:
    """The fit finds a wall, its offset and its k_w again from a force that such a wall gave."""

    def simulated(length: float, beta: float) -> np.ndarray:
        depth = np.arange(221) * SPACING_M
        return length * depth + depth**1.5 * length**2 + beta**2 * depth**4

    force = 2e5 * at_depths(simulated(0.015, 90.0), 0.0005)
    wall, offset, rms = fit(force, simulated)
    np.testing.assert_allclose(wall, (2e5, 0.015, 90.0), rtol=1e-3)
    assert offset == pytest.approx(0.0005, rel=1e-3)
    assert rms < 1e-3


def test_a_loop_loses_what_does_not_come_back() -> None:
    depth = np.array((0.0, 1.0, 2.0, 1.0, 0.0)) * 1e-3
    assert people.HysteresisLoop(0.01, depth, np.array((0.0, 1.0, 2.0, 0.5, 0.0))).lost_percent == pytest.approx(25.0)


def test_random_cycles() -> None:
    assert_bounds(energy.section(energy.measure(8)))


WAVES = arrays(float, (3, 3), elements=st.floats(-1, 1))


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True)
@given(WAVES, WAVES.map(lambda w: np.pi * w), st.integers(80, 600), st.sampled_from((0.0, 0.3, 1.5)))
def test_no_closed_cycle_yields_work(amplitude: np.ndarray, phase: np.ndarray, steps: int, friction: float) -> None:
    """Fast ones too: 80 ms for 16 mm of depth and 60 mm sideways."""
    path = energy.closed_path(amplitude, phase, steps)
    np.testing.assert_allclose(path[0], path[-1], atol=1e-9)
    cycle = energy.run_cycle(energy.lumpy_phantom(), path, friction)
    assume(cycle.touched > 20)
    assert cycle.gained <= 0
    assert cycle.surplus <= 1e-4


def test_a_source_of_energy_would_be_seen() -> None:
    """Pulling back more strongly than the tissue was pushed: the books must show it."""
    work = np.array((1.0, 2.0, -0.5))
    cycle = energy.Cycle(work, np.array((0.5, 2.5, 0.0)), np.zeros(3), 100)
    assert cycle.gained == pytest.approx(0.25)
    assert cycle.surplus > 0


def test_dropped_on_our_surface_it_oscillates_and_settles() -> None:
    soft = drop.drop_on_tissue()
    assert 2.5e-3 < soft.deepest < 3.5e-3
    assert 0.9e-3 < soft.settled < 1.1e-3
    assert soft.oscillations >= 2
    assert soft.last_force == pytest.approx(drop.MASS_KG * drop.GRAVITY, rel=0.01)


def test_dropped_on_a_rigid_surface_it_stops() -> None:
    rigid = drop.drop_in_dart(None, seconds=0.3)
    assert rigid.oscillations == 0
    assert rigid.deepest < 0.3e-3
    assert rigid.last_force == pytest.approx(drop.MASS_KG * drop.GRAVITY, rel=0.01)


def test_the_tool_would_sink_deep_into_the_default_wall() -> None:
    wall = Stiffness(prony_g=(), prony_tau_s=())
    assert 0.009 < drop.drop_on_tissue(wall, seconds=1.5).settled < 0.013


@pytest.mark.slow
def test_the_contact_test_of_the_paper() -> None:
    assert_bounds(drop.section())


def test_checks_know_their_bounds() -> None:
    assert Check("a", 1.0, high=2.0).passed
    assert Check("a", 3.0, high=2.0).passed is False
    assert Check("a", 1.0, low=2.0).passed is False
    assert Check("a", float("nan"), low=0.0, high=2.0).passed is False
    assert Check("a", 1.0).passed is None
