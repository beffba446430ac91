"""`import palpate`: its examples, its patients and assessments, and its examinations."""

import doctest
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from examination import TINY, palpate_run

import palpate
from palpate.quick.patient import Touch
from palpate.truth.pressed import true_tissue
from palpate_models.scenario import press
from palpate_models.scenario.load import ScenarioError, dump_scenario, load_scenario

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "docs/notebooks").glob("*.py"))
SMALL = {"region_m": [0.04, 0.04], "centre_m": [-0.055, -0.055]}
REGION = {"region_m": [0.1, 0.1], "centre_m": [-0.055, -0.055]}
LAZY = """
import sys
import palpate
heavy = {"numpy", "pandas", "matplotlib", "scipy", "numba", "pydantic", "palpate.interface"} & set(sys.modules)
assert not heavy, heavy
assert set(palpate.__all__) <= set(dir(palpate))
import palpate.run.folder
import palpate.study.folder
from palpate.run import folder
assert folder.usual_folder("x").parent.name == "out"
assert palpate.run.__module__ == "palpate.interface.examination", palpate.run
assert palpate.study.__module__ == "palpate.interface.studies", palpate.study
"""


@pytest.fixture(scope="module")
def patient() -> palpate.Patient:
    return palpate.Patient(palpate.scenario("clean", exam=SMALL))


def test_nothing_is_imported_before_it_is_used_and_packages_do_not_hide_functions() -> None:
    subprocess.run([sys.executable, "-c", LAZY], check=True, timeout=120)


INTERFACE = ("scenarios", "assessment", "examination")


@pytest.mark.parametrize("module", ["palpate", "palpate.quick.patient", *(f"palpate.interface.{name}" for name in INTERFACE)])
def test_the_examples_hold(module: str) -> None:
    failed, tried = doctest.testmod(import_module(module))
    assert tried > 0
    assert failed == 0


# --- settings ------------------------------------------------------------------------------------------------------------


def test_keywords_are_the_settings_of_the_command_line() -> None:
    given = {"exam": {"depth_m": 0.008, "pattern": "raster"}, "phantom.breathing.kind": "deep"}
    by_keywords = palpate.scenario("clean", seed=3, **given)
    words = ["exam.depth_m=0.008", "exam.pattern=raster", "phantom.breathing.kind=deep"]
    assert dump_scenario(by_keywords) == dump_scenario(load_scenario("clean", words, 3))


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"exam": {"dept_m": 0.008}}, "exam.dept_m"),
        ({"exam": {"depth_m": 8}}, "exam.depth_m"),
        ({"sead": 3}, "sead"),
        ({"exam": {"depth_m": {1, 2}}}, "exam.depth_m"),
        ({"services": {"assessment": "nosuch"}}, "services.assessment"),
    ],
)
def test_unusable_settings_are_refused_by_name(settings: dict[str, object], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        palpate.scenario("clean", **settings)


def test_a_scenario_is_whole_and_takes_neither_settings_nor_another_seed() -> None:
    chosen = palpate.scenario("person", seed=4)
    assert palpate.scenario(chosen) == chosen
    with pytest.raises(ScenarioError, match=r"exam\.depth_m"):
        palpate.scenario(chosen, exam={"depth_m": 0.008})
    with pytest.raises(ScenarioError, match="seed = 5"):
        palpate.Patient(chosen, 5)


# --- patients ------------------------------------------------------------------------------------------------------------


def test_a_press_has_the_force_of_the_tissue_of_the_system(patient: palpate.Patient) -> None:
    """The standard press by hand, against the one that scores an examination, in steps ten times as fine."""
    xy = np.array([(-0.055, -0.055), (-0.02, -0.055)])
    places, normals = patient.surface.points(xy)
    tissue = true_tissue(patient.scenario)
    known, _ = tissue.press(places, normals, patient.radius)
    for place, force in zip(xy, known, strict=True):
        patient.rest(120.0)
        touch = patient.press(place, press.DEPTH_M, press.SPEED_MPS, press.HOLD_S)
        assert touch.force[touch.time > touch.time[-1] - press.READ_S].mean() == pytest.approx(force, rel=0.02)


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"depth": 10.0}, "depth = 10.0 m"),
        ({"depth": float("nan")}, "depth = nan m"),
        ({"speed": 0.0}, "speed = 0.0 m/s"),
        ({"hold": -1.0}, "hold = -1.0 s"),
        ({"xy": (5.0, 0.0)}, "off the body"),
        ({"xy": (0.0, 0.0, 0.0)}, "expected x and y"),
    ],
)
def test_an_unusable_press_is_refused(patient: palpate.Patient, given: dict[str, object], named: str) -> None:
    usual = {"xy": (-0.055, -0.055), "depth": 0.01, "speed": 0.02, "hold": 0.1}
    with pytest.raises(ValueError, match=named):
        patient.press(**{**usual, **given})  # type: ignore[arg-type]


# --- assessments ---------------------------------------------------------------------------------------------------------


def presses(patient: palpate.Patient, count: int) -> list[Touch]:
    places = [(x, y) for x in (-0.095, -0.055, -0.015) for y in (-0.095, -0.055, -0.015)]
    return [patient.press(xy, depth=0.010, speed=0.05, hold=0.5) for xy in places[:count]]


def test_the_scenario_of_the_assessment_does_not_depend_on_the_patient() -> None:
    lump = {"centre_m": [-0.055, -0.055], "radii_m": [0.03, 0.03], "contrast": 6.0}
    with_lump = palpate.scenario("person", seed=3, exam=SMALL, phantom={"lesions": [lump]})
    scenarios = [palpate.scenario("clean", exam=SMALL), with_lump]
    assert len({dump_scenario(palpate.Patient(s).seen.scenario, "exam") for s in scenarios}) == 1


def test_an_assessment_needs_touches_of_one_patient(patient: palpate.Patient) -> None:
    of_two = [*presses(patient, 1), *presses(palpate.Patient(patient.scenario), 1)]
    for touches, named in ((of_two, "several patients"), ([], "there are none")):
        with pytest.raises(ValueError, match=named):
            palpate.assess(touches)


def test_the_order_of_touches_does_not_matter_and_few_give_no_map() -> None:
    touches = presses(palpate.Patient(palpate.scenario("clean", exam=REGION)), 9)
    there, back = palpate.assess(touches), palpate.assess(reversed(touches))
    assert np.array_equal(there.map.apparent, back.map.apparent)
    assert there.samples.equals(back.samples)
    few = palpate.assess(touches[0])
    assert (few.map, len(few.findings)) == (None, 0)


def test_a_lump_is_found_while_the_hand_follows_the_breath() -> None:
    breathing = palpate.scenario("clean", exam=REGION, phantom={"breathing": {"kind": "deep"}})
    assert palpate.assess(presses(palpate.Patient(breathing), 9)).findings.quadrant.tolist() == ["RLQ"]


def test_the_assessment_is_the_one_that_the_scenario_names() -> None:
    own = str(ROOT / "docs/examples/threshold_assessment.py")
    found = palpate.assess(presses(palpate.Patient(palpate.scenario("clean", exam=REGION, services={"assessment": own})), 9))
    assert found.map is None  # it draws none
    assert found.findings.quadrant.tolist() == ["RLQ"]
    assert found.findings.confidence.tolist() == [0.5]


# --- examinations --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_an_examination_is_that_of_the_command_line(tmp_path: Path) -> None:
    given = {"exam": {**SMALL, "region_m": [0.03, 0.03]}, "phantom": {"edge_m": 0.02}, "camera": {"frames": 2}}
    made = palpate.run("clean", out=tmp_path / "made", record="none", quiet=True, **given)
    command = palpate_run("clean", tmp_path / "command", "--composed", "--record", "none", settings=TINY)
    assert made.report.run_hash == command.report["run_hash"] is not None


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_study_gives_its_tables(tmp_path: Path) -> None:
    file = tmp_path / "toy.yaml"
    file.write_text("tier: quick\npopulations: {clean: {scenario: clean, number: {test: 2}}}\n", encoding="utf-8")
    with pytest.raises(ValueError, match="nosuch"):
        palpate.study(file, methods=["nosuch"])
    given = {"number": 1, "workers": 1, "out": tmp_path / "done", "exam": {"region_m": [0.03, 0.03]}}
    done, again = (palpate.study(file, **given) for _ in range(2))
    assert (done.record.done, len(done.cases), done.page.is_file()) == (1, 1, True)
    assert (again.record.digest, len(again.record.sessions)) == (done.record.digest, 1)


# --- notebooks -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(notebook: Path, tmp_path: Path) -> None:
    jupytext = pytest.importorskip("jupytext")
    nbclient = pytest.importorskip("nbclient")
    cells = jupytext.read(notebook)
    nbclient.NotebookClient(cells, timeout=1500, kernel_name="python3", resources={"metadata": {"path": tmp_path}}).execute()
    outputs = [output for cell in cells.cells for output in cell.get("outputs", ())]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert [output for output in outputs if output.get("name") == "stderr"] == []
