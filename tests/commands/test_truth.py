"""The truth by pressing: a copy of the patient, felt with its lumps and without."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.truth import pressed
from palpate.truth.pressed import Felt, Pressed, Touched, TrueBody, TrueSurface, press_patient, resting_tissue
from palpate_models.patient.phantom import flat_phantom
from palpate_models.patient.schema import Lesion
from palpate_models.scenario.load import load_scenario
from palpate_models.scenario.press import LIMIT_N
from palpate_models.scenario.schema import Scenario
from palpate_tissue.backend import TissueBackend
from palpate_tissue.backends.winkler.tissue import WinklerTissue

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
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
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
