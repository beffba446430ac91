"""Persons: drawn from the seed alone, whole, of the bodies and walls that their builds have."""

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from palpate_models.patient.abdomen import bone_share
from palpate_models.patient.breathing import Breathing
from palpate_models.patient.healthy import belly, healthy_wall
from palpate_models.patient.person import PEOPLE, draw_person, under_fat
from palpate_models.patient.phantom import build_phantom
from palpate_models.patient.remus2024 import fitted
from palpate_models.patient.schema import Anatomy, Build, Draw, Muscles, Phantom, Skeleton, Stiffness, Variation
from palpate_models.scenario.load import dump_scenario, load_scenario
from palpate_models.scenario.schema import Scenario

PERSON = Phantom(kind="person")
SIZE = (0.36, 0.46, 0.20)
LUMPY = Draw(lumps=(2, 4), pairs=0.5, guarding="voluntary")


def person(**fields: Any) -> Phantom:
    return Phantom(kind="person", **fields)


def test_a_person_is_the_seeds() -> None:
    assert draw_person(PERSON, 3) == draw_person(PERSON, 3) != draw_person(PERSON, 4)
    assert draw_person(Phantom(), 3) == Phantom()


def test_a_drawn_person_is_whole_and_stays() -> None:
    whole = draw_person(person(draw=LUMPY), 5)
    assert draw_person(whole, 5) == whole == draw_person(whole, 6)
    assert Phantom.model_validate(whole.model_dump()) == whole
    first, second = build_phantom(person(draw=LUMPY), 5), build_phantom(whole, 5)
    for name in ("vertices", "stiffness", "background", "stiffening", "tension", "breathing"):
        assert np.array_equal(getattr(first, name), getattr(second, name)), name


def test_lumps_and_guarding_leave_the_body_as_it_is() -> None:
    plain, lumpy = draw_person(PERSON, 7), draw_person(person(draw=LUMPY), 7)
    assert lumpy.lesions
    assert lumpy.guarding
    assert plain.model_copy(update={"draw": LUMPY, "lesions": lumpy.lesions, "guarding": lumpy.guarding}) == lumpy


def test_persons_breathe_each_in_their_own_way() -> None:
    breaths = [draw_person(PERSON, seed).breathing for seed in range(200)]
    rates, depths = (np.array([getattr(breath, name) for breath in breaths]) for name in ("rate_per_min", "peak_to_peak_m"))
    assert 12 <= rates.min() < 12.6 and 18.5 < rates.max() <= 20
    assert 0.005 <= depths.min() < 0.0053 and 0.0117 < depths.max() <= 0.012
    assert rates.mean() == pytest.approx(46 / 3, abs=0.4)


def test_breathing_that_is_given_is_not_drawn() -> None:
    given = PERSON.model_copy(update={"breathing": Breathing(rate_per_min=13)})
    deep = PERSON.model_copy(update={"breathing": Breathing(kind="deep")})
    assert draw_person(given, 3).breathing.rate_per_min == 13
    assert draw_person(given, 3).breathing.peak_to_peak_m == draw_person(PERSON, 3).breathing.peak_to_peak_m
    assert draw_person(deep, 3).breathing == deep.breathing


def test_a_scenario_has_the_person_of_its_seed() -> None:
    scenario = load_scenario("person", seed=11)
    assert scenario.phantom == draw_person(PERSON, 11) == Scenario(seed=11, phantom=PERSON).phantom
    assert Scenario.model_validate(scenario.model_dump()) == scenario
    assert "anatomy" in dump_scenario(scenario)


@pytest.mark.parametrize("build", [Build.SLIM, Build.MEDIAN, Build.OBESE])
def test_builds_can_be_examined(build: Build) -> None:
    for seed in range(3):
        model = build_phantom(person(build=build), seed)
        assert (model.areas > 0).all()
        assert model.stiffness.min() > 0
        assert model.stiffening.min() >= 0
        assert not model.fixed[np.hypot(*model.vertices[:, :2].T).argmin()]


def test_builds_differ_as_they_are_called() -> None:
    def mean(build: str) -> tuple[np.ndarray, np.ndarray]:
        people = [draw_person(person(build=build), seed) for seed in range(20)]
        one = [(p.anatomy.fat_m, p.anatomy.dome_m, p.size_m[0], p.size_m[2]) for p in people if p.anatomy]
        walls = [(p.stiffness.k_w_n_per_m3, p.stiffness.length_m) for p in people]
        return np.mean(one, axis=0), np.mean(walls, axis=0)

    (slim, _), (median, wall), (obese, soft) = map(mean, ("slim", "median", "obese"))
    assert (slim < median).all()
    assert (median < obese).all()
    assert soft[0] < 0.8 * wall[0]
    assert soft[1] > 1.1 * wall[1]


def test_breathing_is_largest_near_the_navel_and_fades_to_the_border() -> None:
    for seed in range(3):
        model = build_phantom(PERSON, seed)
        at = np.hypot(*model.vertices[:, :2].T)
        assert at[model.breathing.argmax()] < 0.03
        assert (model.breathing[model.fixed] == 0).all()


def test_over_the_belly_the_wall_varies_as_asked() -> None:
    anatomy = Anatomy(
        muscles=Muscles(linea_alba=1.1, rectus=1.2), variation=Variation(stiffness=0.2, stiffening_per_m=20.0, correlation=-0.5)
    )
    points = belly(SIZE, anatomy)
    deviations, correlations = [], []
    for seed in range(100):
        wall = healthy_wall(points, SIZE, anatomy, 200.0, seed)
        logs = np.log(wall.stiffness)
        assert abs(logs.mean()) < 0.02
        deviations.append((logs.std(), wall.stiffening.std()))
        correlations.append(np.corrcoef(logs, wall.stiffening)[0, 1])
    np.testing.assert_allclose(np.mean(deviations, axis=0), (0.2, 20.0), rtol=0.08)
    assert np.mean(correlations) == pytest.approx(-0.5, abs=0.1)


def test_bones_are_where_the_skeleton_says() -> None:
    skeleton = Skeleton()
    across, along = skeleton.iliac_crest_m
    x = np.array([0.0, 0.0, 0.0, across, -across])
    y = np.array([0.0, skeleton.costal_arch_m - 0.001, skeleton.costal_arch_m + 0.05, along, along])
    np.testing.assert_allclose(bone_share(x, y, skeleton), (0, 0, 1, 1, 1), atol=1e-9)


def test_under_fat_the_wall_is_two_springs_in_series() -> None:
    wall, fat = Stiffness(k_w_n_per_m3=2e5, length_m=0.015, stiffening_per_m=80.0), 0.045
    extra = fat - PEOPLE.measured_fat_m
    both = under_fat(wall, fat)
    pressure = 200.0  # small: the springs are expanded to third order

    def yields(k: float, beta: float) -> float:
        linear = pressure / k
        roots = np.roots((beta**2 / 3, 0, 1, -linear))
        return float(roots[np.argmin(abs(roots.imag))].real)

    apart = yields(wall.k_w_n_per_m3, wall.stiffening_per_m) + yields(PEOPLE.fat_young_pa / extra, 1 / extra)
    assert yields(both.k_w_n_per_m3, both.stiffening_per_m) == pytest.approx(apart, rel=1e-5)
    shear = [one.k_w_n_per_m3 * one.length_m**2 for one in (wall, both)]
    assert shear[0] == pytest.approx(shear[1])
    assert under_fat(wall, PEOPLE.measured_fat_m) == wall


def test_lumps_are_within_their_ranges() -> None:
    draw = Draw(lumps=(1, 5), radius_m=(0.01, 0.02), elongation=(3, 4), depth_m=(0.005, 0.01), contrast=(0.2, 0.5), pairs=0.5)
    counts = set()
    for seed in range(60):
        lumps = draw_person(person(draw=draw), seed).lesions
        counts.add(len(lumps))
        for lump in lumps:
            drawn = (min(lump.radii_m), max(lump.radii_m) / min(lump.radii_m), lump.depth_m, lump.contrast)
            for value, (low, high) in zip(drawn, (draw.radius_m, draw.elongation, draw.depth_m, draw.contrast), strict=True):
                assert value is not None
                assert low <= value <= high
    assert counts == {1, 2, 3, 4, 5}


def test_pairs_are_beside_each_other() -> None:
    first, second = draw_person(person(draw=Draw(lumps=(2, 2), elongation=(1, 1), pairs=1.0)), 1).lesions
    gap = np.linalg.norm(np.subtract(first.centre_m, second.centre_m)) - first.radii_m[0] - second.radii_m[0]
    assert 0.002 <= gap <= 0.020


def test_guarding_has_a_measured_ratio() -> None:
    ratios = [fit.activated_ratio for fit in fitted().values()]
    found = [draw_person(person(draw=Draw(guarding="involuntary")), seed).guarding[0] for seed in range(200)]
    assert {area.kind for area in found} == {"involuntary"}
    assert min(ratios) <= min(area.ratio for area in found) <= max(area.ratio for area in found) <= max(ratios)
    assert np.median([area.ratio for area in found]) == pytest.approx(np.median(ratios), abs=0.3)


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"kind": "person", "stiffness": {"k_w_n_per_m3": 1e5}}, "stiffness of kind: person is drawn"),
        ({"kind": "person", "size_m": (0.3, 0.4, 0.2)}, "size_m of kind: person is drawn"),
        ({"kind": "person", "mesh": "a.stl"}, "mesh: FILE needs kind: mesh"),
        ({"kind": "parametric", "grid": "body.csv"}, "needs kind: grid"),
        ({"kind": "person", "build": "tall"}, "slim"),
        ({"build": "slim"}, "build belongs to kind: person"),
        ({"draw": {"lumps": (1, 2)}}, "draw belongs to kind: person"),
        ({"anatomy": {}}, "anatomy belongs to kind: person"),
        ({"kind": "person", "draw": {"lumps": (3, 2)}}, "the smaller value first"),
        ({"kind": "person", "draw": {"radius_m": (5, 40)}}, "less than or equal to 0.04"),
        ({"kind": "person", "draw": {"contrast": (0.5, 2)}}, "both above 1, or both below"),
        ({"kind": "person", "draw": {"guarding": "voluntary"}, "guarding": [{"centre_m": (0, 0)}]}, "draw.guarding"),
        ({"lesions": [{"centre_m": (0, 0), "contrast": 1}]}, "not 1"),
        ({"lesions": [{"centre_m": (0, 0), "contrast": 0.05}]}, "greater than or equal to 0.1"),
    ],
)
def test_bad_input_is_refused(fields: dict[str, Any], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        Phantom.model_validate(fields)
