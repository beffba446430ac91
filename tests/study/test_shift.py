"""The split `shift`: its patients and equipment are valid, reproducible, and not those of the population."""

from typing import Any

import numpy as np
import pytest
from synthetic import study

from palpate.study.cases import Request, cases_of, patient_seeds
from palpate.study.shift import FAMILIES, Family, shift_patient
from palpate.study.spec import StudyError, load_study
from palpate_models.patient.abdomen import bone_share
from palpate_models.patient.field import edge_distance, structure_at_skin
from palpate_models.patient.motion import Breathing, BreathingCurve
from palpate_models.patient.phantom import PhantomModel, build_phantom
from palpate_models.scenario.errors import ChosenErrors, Errors, draw_errors
from palpate_models.scenario.load import as_settings, load_scenario
from palpate_models.scenario.schema import Scenario
from palpate_robot.sensors import FtSensor

EVERY = [(family, number) for family in Family for number in range(len(FAMILIES[family]))]
PATIENTS = 2


def person(seed: int) -> Scenario:
    return load_scenario("person", (), seed)


def changed(family: Family, number: int, seed: int) -> Scenario:
    return load_scenario("person", as_settings(shift_patient(person(seed), family, number)), seed)


def model(scenario: Scenario) -> PhantomModel:
    return build_phantom(scenario.phantom, scenario.seed)


@pytest.mark.parametrize(("family", "number"), EVERY)
def test_every_variant_is_valid_and_another_one_than_the_drawn_person(family: Family, number: int) -> None:
    for seed in range(PATIENTS):
        one = changed(family, number, seed)
        assert one == changed(family, number + len(FAMILIES[family]), seed) != person(seed)
        assert np.isfinite(model(one).stiffness).all()
    assert shift_patient(person(0), family, number) != shift_patient(person(1), family, number) or family is Family.EQUIPMENT


@pytest.mark.parametrize("number", range(len(FAMILIES[Family.STRUCTURES]) - 1))
def test_a_structure_changes_the_wall_where_it_is_and_nowhere_else(number: int) -> None:
    scenario = changed(Family.STRUCTURES, number, 3)
    after, before = model(scenario), model(person(3))
    front, xy = after.normals[:, 2] > 0, after.vertices[:, :2]
    at_skin = [structure_at_skin(structure) for structure in scenario.phantom.structures]
    beyond = np.min([edge_distance(xy, structure) - structure.edge_m / 2 for structure in at_skin], axis=0)
    ratio = after.background / before.background
    assert np.array_equal(front & (beyond < 0), np.abs(ratio - 1) > 1e-12)
    assert np.abs(np.log(ratio)).max() > 0.1
    assert (after.lesion == -1).all()


def test_bones_are_where_no_drawn_person_has_them() -> None:
    def share(family: str | None, seed: int) -> Any:
        scenario = person(seed) if family is None else changed(Family.BONES, list(FAMILIES[Family.BONES]).index(family), seed)
        assert scenario.phantom.anatomy is not None
        x, y = np.meshgrid(*(np.linspace(-0.1, 0.1, 21),) * 2)
        return bone_share(x, y, scenario.phantom.anatomy.skeleton)

    usual, nearer = (np.mean([share(family, seed) for seed in range(10)]) for family in (None, "both-nearer"))
    assert nearer > 2 * usual
    aside = share("asymmetric", 0)
    assert np.abs(aside - aside[:, ::-1]).max() > 0.1


def test_a_pulse_is_added_to_the_breath() -> None:
    still, beating = (BreathingCurve(Breathing(pulse_m=size, pulse_per_min=60), 1) for size in (0.0, 0.001))
    added = [beating.excursion(t) - still.excursion(t) for t in (3.0, 3.25, 3.5)]
    assert added == pytest.approx([0.0, 0.0005, 0.001])
    assert beating.mean_m - still.mean_m == pytest.approx(0.0005)


def test_chosen_errors_of_sensor_and_tool() -> None:
    chosen = ChosenErrors(force_gain=0.08, force_lag_s=0.04, askew_rad=(0.05, 0.0), indenter_m=(0.003, -0.004))
    errors = Errors(level="none", force={"noise_n": 0, "noise_nm": 0, "bias_n": 0, "bias_nm": 0}, chosen=chosen)
    given = draw_errors(errors, 1)
    assert given.arm.origin_m[-1].tolist() == [0.003, -0.004, 0.0]
    sensor = FtSensor(given.force, np.random.Generator(np.random.PCG64(0)), 0.001)
    sensor.read([0.0] * 6)
    readings = np.array([sensor.read([0.0, 0.0, 10.0, 0.0, 0.0, 0.0]) for _ in range(400)])
    assert readings[39, 2] == pytest.approx(10.8 * np.cos(0.05) * (1 - np.exp(-1)), rel=1e-6)
    assert readings[-1, :3] == pytest.approx([0.0, 10.8 * np.sin(0.05), 10.8 * np.cos(0.05)], rel=1e-3)


def test_the_split_has_a_population_by_family_and_seeds_of_its_own() -> None:
    both = {"relaxation": 2, "equipment": 1}
    shift = study(populations={"healthy": {"scenario": "person", "number": {"tune": 2, "test": 2, "shift": both}}}, salt="a")
    cases = cases_of(shift, Request("shift"))
    assert [case.population for case in cases] == ["healthy-relaxation"] * 2 + ["healthy-equipment"]
    seeds = {case.seed for case in cases}
    assert min(seeds) >= 1000
    assert seeds.isdisjoint(case.seed for split in ("tune", "test") for case in cases_of(shift, Request(split)))
    assert patient_seeds("s", "p", "shift", 5, "one") != patient_seeds("s", "p", "shift", 5, "two")
    slow = cases_of(shift, Request("shift", settings=("exam.speed_mps=0.02",)))
    assert {case.scenario["exam"]["speed_mps"] for case in slow} == {0.02}
    shift = study(populations={"healthy": {"scenario": "clean", "number": {"shift": both}}})
    with pytest.raises(StudyError, match=r"phantom.kind = parametric"):
        cases_of(shift, Request("shift"))


@pytest.mark.parametrize("name", ["operating-point", "detectability", "release"])
def test_the_studies_have_every_family(name: str) -> None:
    assert all(set(one.number.shift) in (set(Family), set()) for one in load_study(name).populations.values())
