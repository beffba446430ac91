"""Tutorials and quick start: shown files are the tested examples, commands are valid, and the Python code runs."""

from __future__ import annotations

import re
import runpy
import shlex
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from examination import palpate_run
from typer.testing import CliRunner

from palpate.commands import app_for
from palpate.run.roles import checked, settings_of
from palpate_bus.contract import MS, contract
from palpate_bus.contract.conformance import violations
from palpate_bus.implementations import create
from palpate_bus.messages import JointState, codec
from palpate_bus.messages.stamps import header
from palpate_bus.runtime.lockstep import Stepper
from palpate_models.patient.phantom import build_phantom
from palpate_models.scenario.load import load_scenario
from palpate_tissue.backend import TissueBackend

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "docs" / "examples"
PAGES = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
SHOWN = re.compile(r"```(?:python|yaml)\n(.*?)```", re.DOTALL)


@pytest.mark.pages
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_shown_files_are_the_examples(page: Path) -> None:
    examples = {path.read_text(encoding="utf-8") for path in EXAMPLES.iterdir() if path.is_file()}
    for shown in SHOWN.findall(page.read_text(encoding="utf-8")):
        assert shown in examples or shown.startswith("# run"), shown


def test_python_of_the_tutorials_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)  # pages assume the root of the repository
    count = 0
    for page in PAGES:
        for shown in SHOWN.findall(page.read_text(encoding="utf-8")):
            if shown.startswith("# run"):
                (tmp_path / "shown.py").write_text(shown, encoding="utf-8")
                runpy.run_path(str(tmp_path / "shown.py"))
                count += 1
    assert count >= 3


def test_the_example_tissue_resists_a_sphere() -> None:
    scenario = load_scenario("clean", ["phantom.edge_m=0.015"])
    service = create("tissue", str(EXAMPLES / "springs.py"), scenario)
    springs = service.backend  # type: ignore[attr-defined]
    model = build_phantom(scenario.phantom, scenario.seed)
    top = int(np.argmin(np.hypot(*model.vertices[:, :2].T)))
    n, radius = model.normals[top], 0.015
    forces = []
    for depth in (-0.001, 0.005, 0.010):
        force, torque = springs.step(0.0, model.vertices[top] + (radius - depth) * n, np.zeros(3), radius)
        forces.append(float(force @ n))
        assert np.isfinite(torque).all()
    assert forces[0] == 0.0
    assert 0 < forces[1] < forces[2]
    vertex, pressed = springs.deepest
    assert pressed == pytest.approx(0.010, abs=1e-6)
    assert vertex == top
    places, normals = model.vertices[[top]], model.normals[[top]]
    at_once, step_by_step = springs.press(places, normals, radius), TissueBackend.press(springs, places, normals, radius)
    np.testing.assert_allclose(at_once[0], step_by_step[0], rtol=1e-9)


def test_the_example_tissue_conforms() -> None:
    called = CliRunner().invoke(app_for("check"), ["check", "tissue", "--service", str(EXAMPLES / "springs.py"), "--failures"])
    assert called.exit_code == 0, called.output


QUICK_START = (ROOT / "docs" / "quick-start.md").read_text(encoding="utf-8")
OVER_THE_LUMP = ("exam.region_m=[0.1, 0.1]", "exam.centre_m=[-0.055, -0.055]")


def commands() -> list[list[str]]:
    """Return the arguments of every indented `palpate run`."""
    lines = [line.partition("#")[0] for line in re.findall(r"^    palpate run(.*)$", QUICK_START, re.MULTILINE)]
    return [shlex.split(line) for line in lines]


@pytest.mark.pages
def test_the_page_shows_the_example() -> None:
    (shown,) = re.findall(r"```python\n(.*?)```", QUICK_START, re.DOTALL)
    assert shown == (EXAMPLES / "threshold_assessment.py").read_text(encoding="utf-8")
    assert len([line for line in shown.splitlines() if line.strip()]) <= 40


@pytest.mark.pages
def test_every_command_is_valid(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    assert len(commands()) >= 6
    for words in commands():
        settings = [value for flag, value in pairwise(words) if flag == "--set"]
        settings += settings_of([value for flag, value in pairwise(words) if flag == "--service"])
        name = words[0] if words and not words[0].startswith("--") else "clean"
        checked(load_scenario(name, settings))


def test_the_mesh_is_an_abdomen(tmp_path: Path) -> None:
    target = tmp_path / "my_abdomen.stl"
    subprocess.run([sys.executable, str(EXAMPLES / "make_abdomen.py"), str(target)], check=True, timeout=120)
    scenario = load_scenario("healthy", ["phantom.kind=mesh", f"phantom.mesh={target}"])
    phantom = build_phantom(scenario.phantom, scenario.seed)
    assert phantom.vertices[:, 2].max() == pytest.approx(0.0, abs=2e-3)


@pytest.mark.parametrize(("page", "name"), [("services", "Limp"), ("bus", "Damper")])
def test_the_service_on_a_page_keeps_the_contract(page: str, name: str, tmp_path: Path) -> None:
    """Step the service as the runtime does; its messages obey the contract."""
    (lines,) = re.findall(r"```python\n(.*?)```", (ROOT / page / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "mine.py").write_text(lines, encoding="utf-8")
    stepper = Stepper(runpy.run_path(str(tmp_path / "mine.py"), run_name="mine")[name](), contract())
    assert stepper.start() == []
    for k, t in enumerate((0, MS), 1):
        joints = JointState(header(t), [f"A{i}" for i in range(1, 8)], np.zeros(7), np.full(7, 0.1), np.zeros(7))
        stepper.buffers["joint_states"].accept(k, codec.encode(joints, "sensor_msgs/msg/JointState"))
        ((port, packet),) = stepper.step(t)
        assert violations(port.topic, codec.decode(packet.payload, port.topic.type), t) == []


@pytest.mark.slow
def test_the_example_assessment_finds_the_lesion(tmp_path: Path) -> None:
    place = f"assessment={EXAMPLES / 'threshold_assessment.py'}"
    settings = ("exam.region_m=[0.1, 0.1]", "exam.centre_m=[-0.04, -0.04]", "camera.frames=6")
    ran = palpate_run("clean", tmp_path, "--composed", "--record", "none", "--service", place, settings=settings)
    assert ran.status == 0, ran.output
    assert ran.report["scores"]["matched"] == 1
    assert ran.report["scores"]["place_error_m"] < 0.02
    assert (tmp_path / "report.html").is_file()


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_example_patient_and_mesh_are_examined(tmp_path: Path) -> None:
    patient = palpate_run(
        str(EXAMPLES / "my_patient.yaml"), tmp_path / "patient", "--composed", "--record", "none",
        settings=("exam.region_m=[0.08, 0.08]", "exam.centre_m=[-0.05, 0.0]", "camera.frames=6"),
    )  # fmt: skip
    assert patient.status == 0, patient.output
    assert patient.report["scores"]["matched"] == 1
    mesh = tmp_path / "my_abdomen.stl"
    subprocess.run([sys.executable, str(EXAMPLES / "make_abdomen.py"), str(mesh)], check=True, timeout=120)
    ran = palpate_run(
        *("clean", tmp_path / "mesh", "--composed", "--record", "none"),
        settings=("phantom.kind=mesh", f"phantom.mesh={mesh}", "camera.frames=6", *OVER_THE_LUMP),
    )
    assert ran.status == 0, ran.output
    assert [finding["quadrant"] for finding in ran.report["findings"]] == ["RLQ"]
    assert ran.report["scores"]["matched"] == 1
