"""Scores against a known truth, and the truth by pressing a copy of the patient with its lumps and without."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import conductor_messages
import numpy as np
import pytest

from palpate.report import scoring
from palpate.report.rows import FindingRow, Scores
from palpate.report.scoring import Map, Truth
from palpate.truth import pressed
from palpate.truth.pressed import Felt, Pressed, Touched, TrueBody, TrueSurface, press_patient, resting_tissue
from palpate_models.numerics.frames import Array
from palpate_models.patient.phantom import flat_phantom
from palpate_models.patient.schema import Lesion
from palpate_models.scenario.load import load_scenario
from palpate_models.scenario.press import LIMIT_N
from palpate_models.scenario.schema import Exam, Scenario
from palpate_tissue.backend import TissueBackend
from palpate_tissue.backends.winkler.tissue import WinklerTissue

CENTRE, RADIUS = np.array((-0.03, -0.02)), 0.03
EXAM = Exam()
Disc = tuple[Array, float]
NOWHERE = Touched(np.empty((0, 3)), np.empty((0, 3)))


def plane(half: float = 0.14, pitch: float = 0.005, slope: float = 0.0) -> tuple[Array, np.ndarray]:
    vertices, triangles = conductor_messages.plane(half, pitch)
    vertices[:, 2] = slope * vertices[:, 0]
    return vertices, triangles.astype(np.int32)


def factor(xy: Array, disc: Disc, contrast: float) -> Array:
    """Return a contrast that falls linearly over 10 mm and has half of its logarithm on the rim of the disc."""
    beyond = np.linalg.norm(xy - disc[0], axis=1) - disc[1]
    return np.asarray(contrast ** np.clip(0.5 - beyond / 0.010, 0.0, 1.0))


def truth(
    lumps: Sequence[Disc],
    contrast: float = 3.0,
    guarded: Disc | None = None,
    scarred: Disc | None = None,
    touched: Touched = NOWHERE,
    limited: bool = False,
) -> Truth:
    places, _ = plane(0.11, 0.0025)
    xy = places[:, :2]
    factors = np.array([factor(xy, lump, contrast) for lump in lumps]).reshape(len(lumps), len(xy))
    tense, scar = (np.ones(len(xy)) if area is None else factor(xy, area, 2.0) for area in (guarded, scarred))
    force = 2.0 * tense * scar * factors.prod(axis=0)
    pressed = Pressed(places, force, np.full(len(xy), limited), 2.0 * tense * scar, force / factors, force / tense, force / scar)
    body = TrueBody(*plane(), np.eye(4))
    return Truth(body, Felt(pressed, TrueSurface(body), EXAM), touched, np.eye(4))


@cache
def one_lump() -> Truth:
    return truth([(CENTRE, RADIUS)])


@cache
def no_lump() -> Truth:
    return truth([])


def found_map(findings: Sequence[Disc], off: float = 1.0, scanned: float = 0.10) -> Map:
    vertices, _ = plane(0.12, 0.004)
    finding = np.full(len(vertices), -1, dtype=np.int32)
    for i, (centre, radius) in enumerate(findings):
        finding[np.linalg.norm(vertices[:, :2] - centre, axis=1) < radius] = i
    apparent = np.full(len(vertices), 2.0 * off)
    reached = (np.abs(vertices[:, :2]) <= scanned + 1e-9).all(axis=1)
    return Map(vertices, apparent, 0.9 * apparent, 1.1 * apparent, reached, finding)


def found(findings: Sequence[Disc], ratio: float = 2.6) -> list[FindingRow]:
    band = (0.9 * ratio, 1.1 * ratio)
    return [
        FindingRow(centroid_m=(*c, 0.0), quadrant="", area_m2=np.pi * r**2, ratio=ratio, ratio_90=band, confidence=1, guarding=0)
        for c, r in findings
    ]


def score(findings: Sequence[Disc], true: Truth) -> Scores:
    return scoring.score(found(findings), found_map(findings), true)


@pytest.mark.parametrize("shift", [0.0, 0.012])
def test_a_finding_shares_with_the_lump_the_lens_of_two_circles(shift: float) -> None:
    s = score([(CENTRE + np.array((shift, 0.0)), RADIUS)], one_lump())
    half = shift / 2 / RADIUS
    lens = 2 * (np.arccos(half) - half * np.sqrt(1 - half**2)) / np.pi
    assert (s.matched, s.missed, s.not_palpable, s.false_findings) == (1, 0, 0, 0)
    assert s.dice == pytest.approx(lens, abs=0.04)  # the map says which vertices, not where the edge runs between
    assert (s.place_error_m, s.absolute_error_m) == (pytest.approx(shift, abs=5e-4),) * 2
    assert s.size_error == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize(("true", "missed"), [(no_lump, 0), (one_lump, 1)])
def test_no_finding(true: Callable[[], Truth], missed: int) -> None:
    s = score([], true())
    assert (s.matched, s.missed, s.false_findings) == (0, missed, 0)
    assert (s.dice, s.place_error_m, s.size_error, s.ratio_error, s.ratio_coverage_90) == (None,) * 5


def test_a_finding_where_no_lump_is_felt_is_false() -> None:
    s = score([(CENTRE, RADIUS)], no_lump())
    assert (s.matched, s.missed, s.false_findings, s.on_guarding) == (0, 0, 1, 0)
    assert s.findings[0].true_ratio == pytest.approx(1.0)
    assert s.findings[0].ratio_held is False


@pytest.mark.parametrize(("aside", "radius", "dice"), [(1.05 * RADIUS, RADIUS, 0.36), (0.01, 0.009, 0.20)])
def test_a_third_of_overlap_or_a_centroid_in_the_area_is_a_match(aside: float, radius: float, dice: float) -> None:
    s = score([(CENTRE + np.array((aside, 0.0)), radius)], one_lump())
    assert s.dice == pytest.approx(dice, abs=0.02)
    assert s.matched == 1


def test_two_findings_on_one_lump_count_once() -> None:
    areas = [(CENTRE + np.array((0.014, 0.0)), 0.012), (CENTRE - np.array((0.016, 0.0)), 0.010)]
    s = score(areas, one_lump())
    assert (s.matched, s.missed, s.false_findings) == (1, 0, 1)
    assert s.place_error_m == pytest.approx(0.014, abs=1e-3)  # the one with the greater overlap
    assert [row.lump for row in s.findings] == [0, None]


def test_one_finding_over_two_lumps_matches_one() -> None:
    lumps = [(CENTRE - np.array((0.02, 0.0)), 0.015), (CENTRE + np.array((0.02, 0.0)), 0.015)]
    s = score([(CENTRE, 0.034)], truth(lumps))
    assert (s.matched, s.missed, s.false_findings) == (1, 1, 0)


def test_findings_are_matched_to_their_own_lumps() -> None:
    lumps = [(CENTRE, RADIUS), (np.array((0.05, 0.05)), 0.02)]
    s = score(lumps[::-1], truth(lumps))
    assert (s.matched, s.missed, s.false_findings) == (2, 0, 0)
    assert [row.lump for row in s.findings] == [1, 0]


def test_a_lump_that_cannot_be_felt_is_counted_apart() -> None:
    true = truth([(CENTRE, RADIUS)], contrast=1.04)
    s = score([], true)
    assert (s.missed, s.not_palpable) == (0, 1)
    s = score([(CENTRE, RADIUS)], true)
    assert (s.matched, s.false_findings, s.not_palpable) == (0, 1, 1)
    assert score([], truth([(CENTRE, RADIUS)], contrast=1.07)).missed == 1


def test_a_soft_lump_is_matched() -> None:
    s = score([(CENTRE, RADIUS)], truth([(CENTRE, RADIUS)], contrast=0.5))
    assert (s.matched, s.dice) == (1, pytest.approx(1.0, abs=0.04))
    assert s.findings[0].true_ratio < 0.7


@pytest.mark.parametrize(("area", "count", "false"), [("guarded", "on_guarding", 2), ("scarred", "on_structure", 1)])
def test_a_finding_on_guarding_is_false_and_one_on_a_structure_is_not_and_both_are_counted_apart(
    area: str, count: str, false: int
) -> None:
    there, away = (np.array((0.05, 0.0)), 0.02), (np.array((-0.05, 0.0)), 0.02)
    true = truth([], **{area: there})  # type: ignore[arg-type]
    s = score([there, away], true)
    assert (s.matched, s.false_findings, getattr(s, count)) == (0, false, 1)
    weighed = scoring.score([], None, true, found([there, away])).candidates
    assert [getattr(row, count) for row in weighed] == [True, False]
    over_both = score([there], truth([there], **{area: there}))  # type: ignore[arg-type]
    assert (over_both.matched, getattr(over_both, count)) == (1, 0)


def test_findings_are_compared_where_the_tool_truly_touched() -> None:
    """The arm is 15 mm off: the finding is right relative to the tissue and wrong in the room."""
    shift = np.array((0.015, 0.0, 0.0))
    believed, _ = plane(0.1, 0.01)
    true = truth([(CENTRE + shift[:2], RADIUS)], touched=Touched(believed, believed + shift))
    s = score([(CENTRE, RADIUS)], true)
    assert s.dice == pytest.approx(1.0, abs=0.04)
    assert s.place_error_m == pytest.approx(0.0, abs=3e-4)
    assert s.absolute_error_m == pytest.approx(0.015, abs=3e-4)


@pytest.mark.parametrize(("off", "coverage"), [(1.0, 1.0), (1.05, 1.0), (1.2, 0.0)])
def test_coverage_is_the_area_where_the_band_holds(off: float, coverage: float) -> None:
    s = scoring.score([], found_map([], off), no_lump())
    assert (s.coverage_90, s.coverage_90_in_lumps) == (pytest.approx(coverage), None)


def test_coverage_on_guarding_is_apart() -> None:
    guarded = (np.array((0.05, 0.0)), 0.03)
    s = scoring.score([], found_map([]), truth([], guarded=guarded))
    assert s.coverage_90_on_guarding == 0.0
    assert s.coverage_90 == pytest.approx(1 - np.pi * 0.03**2 / 0.04, abs=0.05)
    assert scoring.score([], found_map([]), no_lump()).coverage_90_on_guarding is None


def test_a_band_above_a_press_that_ended_at_its_limit_holds() -> None:
    true = truth([], limited=True)
    assert scoring.score([], found_map([], 1.5), true).coverage_90 == 1.0
    assert scoring.score([], found_map([], 0.5), true).coverage_90 == 0.0


def test_the_ratio_is_held_against_the_felt_contrast_over_the_findings_own_area() -> None:
    inner = (CENTRE, RADIUS - 0.008)  # where it has its full height
    for ratio, held in ((3.0, True), (4.0, False)):
        s = scoring.score(found([inner], ratio), found_map([inner]), one_lump())
        assert s.findings[0].true_ratio == pytest.approx(3.0, rel=1e-3)
        assert s.ratio_error == pytest.approx(ratio / 3.0 - 1, abs=1e-3)
        assert s.ratio_coverage_90 == float(held)


def test_a_lumps_area_is_in_one_piece() -> None:
    """Another place with the same contrast is not part of it."""
    true = truth([(CENTRE, 0.02), (np.array((0.06, 0.05)), 0.019)])
    one = true.felt.pressed._replace(alone=true.felt.pressed.healthy[None])
    (lump,) = Felt(one, true.felt.surface, EXAM).lumps
    assert lump.area == pytest.approx(np.pi * 0.02**2, rel=0.02)


def test_without_a_map_a_finding_matches_if_its_place_is_in_the_area() -> None:
    inside, outside = CENTRE + np.array((0.01, 0.0)), CENTRE + np.array((RADIUS + 0.02, 0.0))
    s = scoring.score(found([(inside, RADIUS), (outside, RADIUS)]), None, one_lump())
    assert (s.matched, s.missed, s.false_findings, s.dice, s.coverage_90) == (1, 0, 1, None, None)
    assert s.place_error_m == pytest.approx(0.01, abs=3e-4)


def test_a_candidate_matches_a_lump_that_no_finding_has() -> None:
    other = (CENTRE + np.array((0.08, 0.06)), 0.015)
    true, reported = truth([(CENTRE, RADIUS), other]), [(CENTRE, RADIUS)]
    nowhere = (CENTRE + np.array((0.0, 0.08)), RADIUS)
    weighed = found([(CENTRE + 0.002, RADIUS), other, (other[0] + 0.001, 0.01), nowhere])
    s = scoring.score(found(reported), found_map(reported), true, weighed)
    assert [row.lump for row in s.findings] == [0]
    assert [row.lump for row in s.candidates] == [None, 1, None, None]
    assert s.candidates[1].place_error_m == pytest.approx(0.0, abs=1e-3)
    assert (s.matched, s.missed, s.false_findings) == (1, 1, 0)


def test_surface_error_is_along_the_normal() -> None:
    body = TrueBody(*plane(slope=0.75), np.eye(4))
    off = body.vertices + np.array((0.0, 0.0, 0.001))
    low, high = np.array((-0.1, -0.1)), np.array((0.1, 0.1))
    assert scoring.surface_error(off, body, low, high) == pytest.approx(0.0008, rel=1e-3)
    assert scoring.surface_error(off[:0], body, low, high) is None


def test_depth_errors_in_all_outside_and_in_lumps() -> None:
    wanted, in_lump = np.full(4, 0.01), np.array((False, False, True, True))
    errors = scoring.depth_errors(wanted + np.array((0.001, -0.001, 0.002, 0.002)), wanted, in_lump)
    assert list(errors.values()) == pytest.approx([np.sqrt(2.5e-6), 0.001, 0.002])
    assert list(scoring.depth_errors(wanted[:0], wanted[:0], in_lump[:0]).values()) == [None] * 3


FLAT = """
from palpate_models.patient.phantom import flat_phantom
from palpate_models.section import Pose
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_tissue.service import TissueService

def create(scenario):
    model = flat_phantom(0.12, 0.006, scenario.phantom.stiffness.k_w_n_per_m3, scenario.phantom.lesions)
    return TissueService(WinklerTissue(model, scenario.phantom.stiffness), model, Pose(), {})
"""
LESION = Lesion(centre_m=(0.005, 0.0), radii_m=(0.015, 0.015), contrast=4.0)
REGION = "exam.region_m=[0.08, 0.08]"


@pytest.fixture(autouse=True, scope="module")
def pressed_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Return a new cache, shared by the tests of this file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def flat(folder: Path, *lesions: Lesion, k_w: float = 1.7e5) -> Scenario:
    file = folder / "flat.py"
    file.write_text(FLAT, encoding="utf-8")
    scenario = load_scenario("healthy", [f"services.tissue={file}", REGION, f"phantom.stiffness.k_w_n_per_m3={k_w}"])
    return scenario.model_copy(update={"phantom": scenario.phantom.model_copy(update={"lesions": lesions})})


def skin(tissue: TissueBackend) -> TrueSurface:
    return TrueSurface(TrueBody(tissue.model.vertices, tissue.model.triangles, np.eye(4)))


def felt(scenario: Scenario) -> tuple[Pressed, Felt]:
    found = press_patient(scenario)
    return found, Felt(found, skin(resting_tissue(scenario, lesions=())), scenario.exam)


def nearest(found: Pressed, xy: tuple[float, float]) -> int:
    """Return the number of the place nearest to `xy`."""
    return int(np.argmin(np.linalg.norm(found.places[:, :2] - xy, axis=1)))


def test_felt_contrast_is_that_of_a_direct_pair_of_presses(tmp_path: Path) -> None:
    """On the whole wall, with its friction, step by step, as the service presses it."""
    found, _ = felt(flat(tmp_path, LESION))
    places = [nearest(found, xy) for xy in ((0.005, 0.0), (0.02, 0.0), (-0.03, 0.02))]
    walls = (WinklerTissue(flat_phantom(0.12, 0.006, lesions=lesions)) for lesions in ((LESION,), ()))
    up = np.tile((0.0, 0.0, 1.0), (3, 1))
    ill, healthy = (TissueBackend.press(wall, found.places[places], up, 0.015)[0] for wall in walls)
    assert found.force[places] == pytest.approx(ill, rel=2e-3)
    assert (found.force / found.healthy)[places] == pytest.approx(ill / healthy, rel=2e-3)
    assert ill[0] / healthy[0] > 2.0


def test_a_lump_is_felt_at_its_place_and_places_are_fine_about_its_outline(tmp_path: Path) -> None:
    found, what = felt(flat(tmp_path, LESION))
    xy = found.places[:, :2]
    assert (xy.min(), xy.max()) == (pytest.approx(-0.05), pytest.approx(0.05))
    apart = np.sort(np.linalg.norm(xy[:, None] - xy, axis=2), axis=1)[:, 1]
    rim = np.abs(np.linalg.norm(xy - LESION.centre_m, axis=1) - 0.015) < 0.004
    assert (apart[rim].max(), apart.max()) == (pytest.approx(0.005), pytest.approx(0.010))
    (lump,) = what.lumps
    assert lump.palpable
    assert lump.centroid == pytest.approx(LESION.centre_m, abs=0.002)
    assert np.pi * 0.014**2 < lump.area < np.pi * 0.021**2
    assert what.in_lump(np.array([LESION.centre_m, (0.035, 0.03)])).tolist() == [True, False]


def test_each_lump_of_a_pair_is_removed_alone(tmp_path: Path) -> None:
    left, right = (Lesion(centre_m=(x, 0.0), radii_m=(0.010, 0.010), contrast=5.0) for x in (-0.016, 0.016))
    found, what = felt(flat(tmp_path, left, right))
    centres = [lump.centroid[0] for lump in what.lumps]
    assert centres == pytest.approx([-0.016, 0.016], abs=0.003)
    middle = nearest(found, (0.0, 0.0))
    assert found.healthy[middle] < found.alone[0][middle] < found.force[middle]
    single, there = press_patient(flat(tmp_path, right)), nearest(found, (0.015, 0.0))
    same = nearest(single, found.places[there, :2])
    assert found.alone[0][there] == pytest.approx(single.force[same], rel=1e-6)


def guarded(centre: tuple[float, float], radius: float, kind: str, lesions: str = "") -> Scenario:
    guarding = f"{{centre_m: {list(centre)}, radii_m: [{radius}, {radius}], ratio: 2.6, kind: {kind}}}"
    return load_scenario("clean", [REGION, f"phantom.lesions=[{lesions}]", f"phantom.guarding=[{guarding}]"])


def test_guarding_is_felt_at_the_muscle_and_not_counted_as_a_lump() -> None:
    """A lump on the other side is not counted as guarding."""
    muscle, lump = (-0.03, 0.0), (0.03, 0.0)
    found, what = felt(guarded(muscle, 0.03, "involuntary", "{centre_m: [0.03, 0.0], radii_m: [0.01, 0.01], contrast: 4}"))
    at = found.places[:, :2]
    within, beyond = np.linalg.norm(at - muscle, axis=1) < 0.005, at[:, 0] > 0.02
    contrast = found.force / found.relaxed
    assert contrast[within].min() > 1.5
    assert contrast[beyond].max() < 1.3
    assert what.inside(what.guarded, np.array([muscle, lump])).tolist() == [True, False]
    assert what.in_lump(np.array([muscle, lump])).tolist() == [False, True]


def test_the_truth_of_guarding_is_that_of_a_slow_press() -> None:
    """Step by step, on the whole wall: a muscle that stays tense, and one that relaxes."""
    felt_there = {}
    for kind in ("involuntary", "voluntary"):
        scenario = guarded((-0.01, 0.0), 0.04, kind)
        found, tissue = press_patient(scenario), resting_tissue(scenario, lesions=())
        at = [nearest(found, (-0.01, 0.0))]
        normals = skin(tissue).points(found.places[at, :2])[1]
        slow, _ = TissueBackend.press(tissue, found.places[at], normals, scenario.robot.indenter_radius_m)
        assert found.force[at] == pytest.approx(slow, rel=5e-3)
        felt_there[kind] = found.force[at] / found.relaxed[at]
    assert felt_there["involuntary"] > 2.0
    assert 1.5 < felt_there["voluntary"] < 0.9 * felt_there["involuntary"]


def test_a_press_ends_at_its_limit(tmp_path: Path) -> None:
    found, _ = felt(flat(tmp_path, LESION, k_w=6e5))
    assert found.force.max() == LIMIT_N
    assert np.array_equal(found.limited, found.force == LIMIT_N)
    assert not found.limited.all()


def test_a_patient_is_pressed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = press_patient(flat(tmp_path, LESION))

    def refuse(*_: object) -> None:
        raise AssertionError("pressed again")

    monkeypatch.setattr(WinklerTissue, "press", refuse)
    again = press_patient(flat(tmp_path, LESION))
    assert np.array_equal(again.force, first.force)
    with pytest.raises(AssertionError, match="pressed again"):
        press_patient(flat(tmp_path, LESION.model_copy(update={"contrast": 3.0})))


def test_bodies_that_differ_in_youngs_modulus_alone_do_not_share_a_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    model, keys = flat_phantom(0.12, 0.006), set()

    def remember(key: str, _: object) -> np.ndarray:
        keys.add(key)
        return np.zeros((5, 1))

    monkeypatch.setattr(pressed, "remember", remember)
    for young in (1e4, 2e4):
        wall = WinklerTissue(replace(model, young=np.full(len(model.vertices), young)))
        monkeypatch.setattr(pressed, "resting_tissue", lambda _, wall=wall: wall)
        press_patient(load_scenario("healthy", [REGION]))
    assert len(keys) == 2


@pytest.mark.parametrize("settings", [("none",), ("fmu", "tissue.fmu=theirs.fmu"), ("fmu", "tissue.fmu_map=theirs.yaml")])
def test_no_copy_is_made_of_a_foreign_or_a_real_tissue(settings: tuple[str, ...]) -> None:
    assert press_patient(load_scenario("healthy", [f"services.tissue={settings[0]}", *settings[1:]])) is None


def test_no_copy_is_made_of_a_service_without_a_backend(tmp_path: Path) -> None:
    file = tmp_path / "own.py"
    file.write_text(
        "from palpate_bus.service import Service\nclass Own(Service):\n    role = 'tissue'\n"
        "    def step(self, t, inbox): return {}\ndef create(scenario): return Own()\n"
    )
    assert press_patient(load_scenario("healthy", [f"services.tissue={file}"])) is None


def test_true_places_of_the_touches() -> None:
    believed = np.array([(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (0.1, 0.1, 0.0), (0.05, 0.05, 0.0)])
    shift = np.array((0.004, -0.002, 0.0))
    places = Touched(believed, believed + shift).places(np.array(((0.02, 0.03), (0.0, 0.0))))
    assert places == pytest.approx(np.array(((0.024, 0.028), (0.004, -0.002))))
    turned = Touched(believed, believed * (1.1, 1.0, 1.0))
    assert turned.places(np.array(((0.1, 0.0),)))[0] == pytest.approx((0.11, 0.0), abs=1e-4)
    nowhere = Touched(np.empty((0, 3)), np.empty((0, 3)))
    assert nowhere.places(np.array(((0.02, 0.03),))).tolist() == [[0.02, 0.03]]
