"""`palpate validate`: every bound of every section, and the report. Costs are printed, not tested."""

import json
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from typer.testing import CliRunner

from palpate_errors import ExitStatus
from palpate_models.patient.remus2024 import relaxed_people
from palpate_tissue.backends.elastic.slab import FlatSlab
from palpate_validation import buried, drop, energy, guarding, hertz, meshes, people, population, relaxation
from palpate_validation.check import Check, PageSection, failures, write
from palpate_validation.meshes import lump, static_force, uniform
from palpate_validation.population import DEPTHS_M, sample_of


def assert_bounds(section: PageSection) -> None:
    missed = [f"{c.name}: {c.measured} {c.unit}, expected {c.bound}" for c in section.checks if c.passed is False]
    assert not missed
    assert any(c.passed for c in section.checks)


SECTIONS: dict[str, Callable[[], PageSection]] = {
    "surface tier against Hertz": lambda: hertz.section(hertz.measure((0.020,))),
    "mesh halving, lumps against the continuum, superposition": meshes.section,
    "relaxation": relaxation.section,
    "some living people": lambda: people.section(people.measure(relaxed_people()[::40])),
    "random cycles": lambda: energy.section(energy.measure(8)),
    "population": lambda: population.section(population.sample_persons(100)),
    "buried lumps against finite elements": buried.section,
}
SLOW_SECTIONS = {
    "all living people": people.section,
    "contact test of the paper": drop.section,
    "elastic tier against Hertz and Sneddon": hertz.elastic_section,
}


@pytest.mark.parametrize(
    "section",
    [
        *(pytest.param(section, id=name) for name, section in SECTIONS.items()),
        *(pytest.param(section, id=name, marks=pytest.mark.slow) for name, section in SLOW_SECTIONS.items()),
    ],
)
def test_every_bound_of_a_section_holds(section: Callable[[], PageSection]) -> None:
    assert_bounds(section())


def test_the_range_of_validity_is_found() -> None:
    depths = np.array((0.001, 0.005, 0.010, 0.020))
    curves = hertz.HertzCurves((0.02,), depths, np.array([[1.5, 1.0, 1.0, 0.7]]), np.ones((1, 4)))
    low, high = curves.within(0.02)
    assert low == pytest.approx(0.0042, abs=1e-4)  # where the error crosses 10 % on straight lines
    assert high == pytest.approx(0.01333, abs=1e-4)


def test_the_continuum_is_winklers_without_shear() -> None:
    """Without G the force is k_w times the volume of the spherical cap."""
    depth, radius = 0.006, 0.020
    cap = np.pi * depth**2 * (3 * radius - depth) / 3
    assert static_force(depth, radius, uniform(1e5), uniform(1e-9), h=5e-5) == pytest.approx(1e5 * cap, rel=2e-3)
    assert static_force(depth, radius, lump(1e5, 0.05, 3.0, 0.001), uniform(1e-9), h=5e-5) == pytest.approx(3e5 * cap, rel=2e-3)


def test_a_loop_loses_what_does_not_come_back() -> None:
    depth = np.array((0.0, 1.0, 2.0, 1.0, 0.0)) * 1e-3
    assert people.HysteresisLoop(0.01, depth, np.array((0.0, 1.0, 2.0, 0.5, 0.0))).lost_percent == pytest.approx(25.0)


def test_a_source_of_energy_is_detected() -> None:
    """A pull that is stronger than the push."""
    work = np.array((1.0, 2.0, -0.5))
    cycle = energy.Cycle(work, np.array((0.5, 2.5, 0.0)), np.zeros(3), 100)
    assert cycle.gained == pytest.approx(0.25)
    assert cycle.surplus > 0


def test_dropped_on_our_surface_it_oscillates_and_settles() -> None:
    soft = drop.drop_on_tissue()
    assert 2.5e-3 < soft.deepest < 3.5e-3
    assert 0.9e-3 < soft.settled < 1.1e-3
    assert soft.oscillations >= 2
    assert soft.last_force == pytest.approx(drop.SETUP.mass_kg * drop.GRAVITY, rel=0.01)


def test_people_all_alike_or_too_stiff_are_detected() -> None:
    people = population.read_measured()
    force = people[DEPTHS_M].to_numpy()
    for wrong in (np.tile(np.median(force, axis=0), (len(people), 1)), 1.3 * force):
        assert any(check.passed is False for check in population.section(sample_of(people["person"], wrong)).checks)


def test_voluntary_guarding_fades_and_one_that_never_fades_is_detected() -> None:
    fading = guarding.measure()
    assert_bounds(guarding.section(fading))
    constant = {**fading.strokes, "voluntary": fading.strokes["involuntary"]}
    assert any(check.passed is False for check in guarding.section(fading._replace(strokes=constant)).checks)


@pytest.mark.slow
def test_the_elastic_tier_gives_the_recorded_ratio() -> None:
    lump = next(one for one in buried.ELASTIC_TIER if (one.radius_m, one.depth_m, one.contrast) == (0.020, 0.010, 4.0))
    setup = buried.SETUP
    slab = partial(FlatSlab, thickness_m=setup.thickness_m, half_m=0.09, edge_m=0.004, pitch_m=setup.pitch_m)
    lumpy, plain = (slab(lesions=lesions).press(setup.radius_m, setup.depth_m) for lesions in ((lump.lesion,), ()))
    assert lumpy / plain == pytest.approx(lump.ratio, rel=0.005)


def a_section() -> PageSection:
    checks = (Check("good", 1.0, "N", high=2.0, against="theory"), Check("bad", 3.0, high=2.0), Check("nan", float("nan")))
    return PageSection("name", "Title", "Text.", checks, lambda f: f.subplots().plot([1, 2]))


def test_report_files(tmp_path) -> None:
    section = a_section()
    write([section], tmp_path / "out")
    checks = json.loads((tmp_path / "out" / "validate.json").read_text())["name"]["checks"]
    assert [(c["measured"], c["passed"]) for c in checks] == [(1.0, True), (3.0, False), (None, None)]
    assert (tmp_path / "out" / "name.png").read_bytes()[:4] == b"\x89PNG"
    assert [c.name for c in failures([section])] == ["bad"]


def test_the_command(tmp_path, monkeypatch) -> None:
    from palpate_validation import cli

    monkeypatch.setattr(cli, "run_section", lambda name: a_section())
    runner = CliRunner()
    result = runner.invoke(cli.app, ["--only", "hertz", "--out", str(tmp_path)])
    assert result.exit_code == ExitStatus.FAILED
    assert "FAIL" in result.output
    assert runner.invoke(cli.app, ["--only", "nonsense"]).exit_code == ExitStatus.BAD_INPUT
