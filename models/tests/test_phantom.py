"""The phantom: surface, stiffness, buried lumps, bodies from grid files, and persons drawn from the seed alone."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, strategies as st
from pydantic import ValidationError

from palpate_models.patient.abdomen import bone_share, parametric_surface
from palpate_models.patient.field import at_skin, background_factor, gaussian_field, lesion_field
from palpate_models.patient.healthy import belly, healthy_wall
from palpate_models.patient.mesh import MeshError
from palpate_models.patient.motion import Breathing
from palpate_models.patient.person import PEOPLE, draw_person, under_fat
from palpate_models.patient.phantom import BodyGrid, build_phantom, read_grid
from palpate_models.patient.remus2024 import fitted
from palpate_models.patient.schema import (
    Anatomy,
    Background,
    Build,
    Draw,
    Lesion,
    Muscles,
    Phantom,
    Skeleton,
    Stiffness,
    Variation,
)
from palpate_models.scenario.load import dump_scenario, load_scenario
from palpate_models.scenario.schema import Scenario
from palpate_models.section import quadrant


@pytest.fixture(scope="module")
def model():
    return build_phantom(Phantom(), seed=0)


@pytest.mark.parametrize("edge", [0.0025, 0.004, 0.008, 0.02])
@pytest.mark.parametrize("size", [(0.36, 0.46, 0.20), (0.28, 0.36, 0.16), (0.5, 0.6, 0.26)])
def test_surface_is_closed_and_outward_at_every_size(edge, size):
    shape = parametric_surface(size, edge)
    mesh = trimesh.Trimesh(shape.vertices, shape.triangles, process=False)
    assert mesh.is_watertight
    assert 0.6 * np.prod(size) < mesh.volume < np.prod(size)
    assert np.isin(np.arange(len(shape.vertices)), shape.triangles).all()


def test_umbilicus_is_the_origin_and_the_back_is_on_the_table(model):
    assert np.linalg.norm(model.vertices, axis=1).min() == 0.0
    assert model.vertices[:, 2].min() == pytest.approx(-0.20)
    assert model.vertices[:, 2].max() < 0.006  # the crown is nearly level


def test_normals_are_unit_and_areas_add_up(model):
    np.testing.assert_allclose(np.linalg.norm(model.normals, axis=1), 1, atol=1e-12)
    mesh = trimesh.Trimesh(model.vertices, model.triangles, process=False)
    assert model.areas.sum() == pytest.approx(mesh.area, rel=1e-6)
    assert (model.areas > 0).all()


def test_laplacian_is_safe(model):
    dense = model.laplacian.tocoo()
    off = dense.data[dense.coords[0] != dense.coords[1]]
    assert off.max() <= 1e-9  # no edge pulls its ends apart
    np.testing.assert_allclose(model.laplacian @ np.ones(len(model.vertices)), 0, atol=1e-9)
    assert abs(model.laplacian - model.laplacian.T).max() < 1e-9


def test_fixed_vertices_neither_breathe_nor_lie_in_the_examined_region(model):
    assert (model.breathing[model.fixed] == 0).all()
    assert np.abs(model.vertices[model.fixed, :2]).max(axis=1).min() > 0.11
    assert model.breathing.max() == pytest.approx(1, abs=0.05)
    assert (model.breathing >= 0).all()


def test_quadrants_are_the_patients():
    places = [(-0.05, 0.05), (0.05, 0.05), (-0.05, -0.05), (0.05, -0.05)]
    assert [quadrant(x, y) for x, y in places] == ["RUQ", "LUQ", "RLQ", "LLQ"]


def test_the_same_phantom_twice_is_the_same():
    first, second = build_phantom(Phantom(), 7), build_phantom(Phantom(), 7)
    np.testing.assert_array_equal(first.vertices, second.vertices)
    np.testing.assert_array_equal(first.stiffness, second.stiffness)
    assert not np.array_equal(first.stiffness, build_phantom(Phantom(), 8).stiffness)


def test_background_has_the_asked_mean_variation_and_correlation():
    rng = np.random.default_rng(0)
    points = np.column_stack((rng.uniform(-0.1, 0.1, (40, 2)), np.zeros(40)))
    shifted = points + np.array([0.05, 0.0, 0.0])
    background = Background(cv=0.2, correlation_m=0.05, margins=1.0)
    factors = np.array([background_factor(points, background, 0.23, seed) for seed in range(200)])
    assert factors.mean() == pytest.approx(1.0, abs=0.02)
    assert factors.std() == pytest.approx(0.2, abs=0.015)
    here = np.array([gaussian_field(points, 0.05, seed) for seed in range(200)])
    there = np.array([gaussian_field(shifted, 0.05, seed) for seed in range(200)])
    assert (here * there).mean() == pytest.approx(np.exp(-0.5), abs=0.05)


def test_lesion_rises_from_one_to_its_contrast_through_half_at_its_outline():
    lesion = Lesion(centre_m=(0.01, -0.02), radii_m=(0.03, 0.02), contrast=5.0, edge_m=0.008)
    xy = np.array([[0.01, -0.02], [0.04, -0.02], [0.01, 0.0], [0.01 + 0.0345, -0.02], [0.2, 0.2]])
    factor, label = lesion_field(xy, (lesion,))
    np.testing.assert_allclose(factor, [5, 3, 3, 1, 1], atol=0.02)
    assert label.tolist()[0] == 0
    assert label.tolist()[3:] == [-1, -1]


def test_lesion_label_covers_the_half_contrast_area():
    lesion = Lesion(centre_m=(-0.055, -0.055), radii_m=(0.035, 0.030))
    model = build_phantom(Phantom(lesions=(lesion,)), 0)
    area = model.areas[model.lesion == 0].sum()
    assert area == pytest.approx(np.pi * 0.035 * 0.030, rel=0.06)
    ratio = model.stiffness / model.background
    assert ratio[model.lesion == 0].min() >= 2.49
    assert ratio[model.lesion == -1].max() <= 2.51


def test_a_lesion_does_not_reach_through_to_the_back():
    model = build_phantom(Phantom(lesions=(Lesion(centre_m=(0.0, 0.0), radii_m=(0.15, 0.15)),)), 0)
    assert (model.normals[model.lesion >= 0, 2] > 0).all()


radius = st.floats(0.005, 0.040)
depth = st.floats(0.0, 0.040)
contrast = st.one_of(st.floats(0.1, 0.99), st.floats(1.01, 20))


def lump(radii: tuple[float, float], c: float, d: float | None) -> Lesion:
    return Lesion(centre_m=(0.0, 0.0), radii_m=radii, contrast=c, depth_m=d)


def test_a_lesion_from_the_skin_inward_is_as_it_is() -> None:
    lesion = lump((0.02, 0.03), 4.0, None)
    assert at_skin(lesion) == lesion


@given(radius, radius, depth, contrast)
def test_a_lump_below_the_skin_is_felt_as_less_and_to_the_same_side(a: float, b: float, d: float, c: float) -> None:
    felt = at_skin(lump((a, b), c, d)).contrast
    assert min(1, c) < felt < max(1, c)
    assert felt > 0.1


@given(radius, st.floats(0, 0.035), st.floats(0.001, 0.005), contrast)
def test_the_deeper_the_weaker_and_the_wider(r: float, d: float, more: float, c: float) -> None:
    shallow, deep = at_skin(lump((r, r), c, d)), at_skin(lump((r, r), c, d + more))
    assert abs(np.log(deep.contrast)) < abs(np.log(shallow.contrast))
    assert deep.radii_m[0] > shallow.radii_m[0]


def test_the_field_has_the_felt_lump() -> None:
    buried = lump((0.02, 0.02), 6.0, 0.010)
    xy = np.random.default_rng(0).uniform(-0.06, 0.06, (200, 2))
    factor, label = lesion_field(xy, (buried,))
    expected, _ = lesion_field(xy, (at_skin(buried),))
    assert np.array_equal(factor, expected)
    assert 1.3 < factor.max() < 2.5
    assert (label >= 0).any()


def _grid() -> BodyGrid:
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-0.03, 0.03, 13), np.linspace(-0.02, 0.02, 9), indexing="ij"))
    return BodyGrid(x, y, -2.0 * y**2, np.where(x > 0, 4e5, 2e5), np.where(x > 0, 4e4, 1e4), 100 + 1e3 * y)


def test_model_has_surface_and_mechanics_of_the_file(tmp_path: Path) -> None:
    _grid().write(tmp_path / "body.csv")
    (tmp_path / "twin.yaml").write_text("phantom: {kind: grid, grid: body.csv, edge_m: 0.0025}")
    model = build_phantom(load_scenario(str(tmp_path / "twin.yaml")).phantom, 0)
    assert np.abs(model.vertices[:, :2]).max() > 0.1
    inside = (np.abs(model.vertices[:, 0]) < 0.0275) & (np.abs(model.vertices[:, 1]) < 0.018)
    assert model.fixed.any()
    assert not model.fixed[inside].any()
    x, y, z = model.vertices[inside].T
    np.testing.assert_allclose(z, -2.0 * y**2, atol=3e-5)
    assert (model.normals[inside, 2] > 0.9).all()
    away = np.abs(x) > 0.006
    np.testing.assert_allclose(model.stiffness[inside][away], np.where(x > 0, 4e5, 2e5)[away])
    assert model.young is not None
    np.testing.assert_allclose(model.young[inside][away], np.where(x > 0, 4e4, 1e4)[away])
    np.testing.assert_allclose(model.stiffening[inside], 100 + 1e3 * y)


def _with(column: int, value: str) -> Callable[[list[str]], list[str]]:
    """Return a change of one number of a row."""
    return lambda lines: [*lines[:5], ",".join(np.where(np.arange(6) == column, value, lines[5].split(","))), *lines[6:]]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda lines: [lines[0].replace("x_m", "x_mm"), *lines[1:]], "x_mm"),
        (lambda lines: lines[:5] + lines[6:], "116 rows"),
        (lambda lines: [*lines, lines[5]], "118 rows"),
        (_with(3, "nan"), "k_w_n_per_m3 = nan"),
        (_with(3, "1"), "k_w_n_per_m3 = 1.0"),
        (_with(1, "0.0013"), "y_m"),
    ],
)
def test_unusable_file_is_refused_and_named(tmp_path: Path, change: Callable[[list[str]], list[str]], named: str) -> None:
    path = tmp_path / "body.csv"
    _grid().write(path)
    path.write_text("\n".join(change(path.read_text().split())))
    with pytest.raises(MeshError, match=named) as refused:
        read_grid(path)
    assert str(path) in str(refused.value)


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
