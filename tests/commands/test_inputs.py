"""Bad input ends with a line and status 2 before anything starts; the plan of an examination."""

import re
import shlex
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from palpate.commands import app_for
from palpate.run.folder import lock_output
from palpate.run.inputs import scan_over
from palpate_errors import ExitStatus
from palpate_models.patient.phantom import build_phantom
from palpate_models.scenario.load import load_scenario, scenario_names

SPIRAL = Path(__file__).parents[2] / "docs" / "examples" / "spiral.py"


@pytest.fixture(autouse=True)
def nothing_starts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No process is started, and files are written to a temporary folder."""

    def started(*words: object, **_: object) -> None:
        raise AssertionError(f"started {words}")

    monkeypatch.setattr(subprocess, "run", started)
    monkeypatch.setattr(subprocess.Popen, "__init__", started)
    monkeypatch.setattr("palpate_benchmarks.bench.run_cases", started)
    monkeypatch.chdir(tmp_path)


def refused(*words: str) -> str:
    """Return the output of a command that refuses its input, on one line."""
    called = CliRunner().invoke(app_for(words[0]), words)
    assert called.exit_code == ExitStatus.BAD_INPUT, called.output
    return " ".join(called.output.replace("│", " ").split())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("nosuch", ("nosuch: no such scenario", "clean")),
        ("--set exam.depth_m=0.5", ("exam.depth_m", "0.5", "less than or equal to 0.05")),
        ("--set phantom.kind=mesh --set phantom.mesh=/nowhere.stl", ("phantom.mesh = /nowhere.stl: no such file",)),
        ("--set exam.pattern=nosuch.py", ("there is no such file",)),
        ("--set services.tissue=none", ("--wallclock",)),
        ("--service robot=bullet", ("services.robot = 'bullet'",)),
        ("--service assessment=mine.py --composed --record none", ("line 2: AttributeError",)),
        ("--service tissue=fmu --set tissue.fmu=nosuch.fmu --composed", ("there is no such file",)),
        ("--service tissue=fmu --set tissue.fmu=mine.fmu --composed", ("not an FMU",)),
        ("--composed --realtime", ("--composed", "--realtime")),
        ("--composed --secure", ("--secure",)),
        ("--secure --keys none", ("ca.pem",)),
        ("--without arm", ("--without arm: this run has no arm, but robot, tissue",)),
        ("--group robot,arm", ("there is no role 'arm'",)),
        ("--group robot,control --group tissue,robot", ("robot is in a group already",)),
        ("--group robot,dashboard", ("an observer has its own process",)),
        ("--group robot,tissue --wallclock", ("--wallclock",)),
        ("--group robot,tissue --without tissue", ("--without tissue",)),
        ("--processes 9", ("allowed are 1 to 8",)),
        ("--processes 2 --group robot,tissue", ("give one of them",)),
        ("--processes 2 --composed", ("--composed",)),
    ],
)
def test_a_run_that_cannot_be_is_refused(words: str, said: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("def create(scenario):\n    return scenario.nothing\n")
    (tmp_path / "mine.fmu").write_text("hello")
    scenario = [] if words == "nosuch" else ["clean"]
    output = refused("run", *scenario, "--set", "phantom.edge_m=0.02", *shlex.split(words), "--out", "out")
    assert all(word in output for word in said), output
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("run --resume nowhere", "nowhere"),
        ("plan clean --set exam.centre_m=[0.3,0.0]", "lie off the body, the first at"),
        ("plan clean --set exam.mode=point --set exam.spacing_m=0.004", "s of simulated time, and 3480 s is the limit"),
        ("run --resume . --seed 3", "cannot be combined"),
        ("bench nosuch", "nosuch: no such scenario; known are"),
        ("reproduce --set exam.depth_m=-1", "exam.depth_m"),
        ("study smoke --set exam.depth_m=-1", "exam.depth_m"),
        ("bench --out file/figures.json", "file: cannot be made a folder"),
        ("study smoke --out file", "file: cannot be made a folder"),
        ("reproduce --out file", "file: cannot be made a folder"),
        ("reproduce --docs file/page.md", "file: cannot be made a folder"),
        ("bench --out .", "is not a writable file"),
        ("faults", "faults.csv: holds no results"),
    ],
)
def test_other_commands_refuse_bad_input(words: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    if words == "faults":
        (tmp_path / "faults.csv").write_text("[1, 2")
    assert said in refused(*words.split())


def test_a_second_campaign_into_the_same_file_is_refused(tmp_path: Path) -> None:
    with lock_output(tmp_path / "faults.csv"):
        assert "faults.csv: a run is writing into it" in refused("faults", "--out", str(tmp_path / "faults.csv"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", scenario_names())
def test_the_region_of_every_scenario_is_on_the_body(name: str) -> None:
    scenario = load_scenario(name, seed=1000)
    assert len(scan_over(scenario, build_phantom(scenario.phantom, scenario.seed)).targets) > 100


def plan(tmp_path: Path, *settings: str) -> str:
    words = [word for setting in ("exam.region_m=[0.06, 0.06]", *settings) for word in ("--set", setting)]
    called = CliRunner().invoke(app_for("plan"), ["plan", "clean", *words, "--out", str(tmp_path / "plan.png")])
    assert called.exit_code == 0, called.output
    return called.output


def test_the_plan_of_a_user_defined_pattern_is_drawn(tmp_path: Path) -> None:
    assert "18 targets in 1 line, palpated in" in plan(tmp_path, "robot.base_height_m=0.8", f"exam.pattern={SPIRAL}")
    assert np.asarray(Image.open(tmp_path / "plan.png").convert("L")).std() > 10


def test_the_plan_of_a_search_states_its_budget_and_no_strokes(tmp_path: Path) -> None:
    output = plan(tmp_path, "exam.pattern=search", "exam.budget.presses=10")
    assert re.search(r"\d+ places, at most 10 presses; .*; at most \d+ s", output)
    assert "stroke" not in output
