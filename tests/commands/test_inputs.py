"""Bad input ends with a line and status 2 before anything starts; implementations of roles; the plan of an examination."""

import re
import shlex
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

import palpate_plugins
from palpate.commands import app_for
from palpate.run import roles
from palpate.run.composed import load_services
from palpate.run.folder import lock_output
from palpate.run.inputs import scan_over
from palpate.run.roles import OBSERVERS, WORKERS, check_choices, choice, settings_of
from palpate_bus.implementations import create, kind
from palpate_bus.runtime.failure import Failure
from palpate_bus.testing import HandInbox
from palpate_errors import ExitStatus
from palpate_models.patient.phantom import build_phantom
from palpate_models.scenario.load import load_scenario, scenario_names
from palpate_models.scenario.schema import Scenario, Services
from palpate_plugins import PluginError, PluginKind

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


EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "threshold_assessment.py"


def chosen(*options: str) -> Scenario:
    return check_choices(load_scenario("healthy", settings_of(options)))


def test_every_role_has_a_choice_and_its_default_is_installed() -> None:
    assert set(Services.model_fields) == {*WORKERS, *OBSERVERS, "search"}
    scenario = chosen()
    for role in Services.model_fields:
        assert choice(scenario, role) in kind(role).names()


@pytest.mark.parametrize("option", ["assessment", "tisue=a.py", "conductor=a.py"])
def test_an_unknown_role_is_named(option: str) -> None:
    with pytest.raises(PluginError, match=rf"--service {option}: expected ROLE=NAME_OR_FILE with ROLE one of robot, tissue"):
        settings_of([option])


def test_an_unknown_implementation_is_refused_with_the_allowed_ones() -> None:
    known = r"services\.robot = 'bullet': expected one of dart, lbr, mujoco, ros2_control, or the path"
    with pytest.raises(PluginError, match=known):
        chosen("robot=bullet")
    with pytest.raises(PluginError, match=r"services\.robot = 'none'"):
        chosen("robot=none")
    assert chosen("tissue=none").services.tissue == "none"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "there is no such file"),
        ("def create(:", r"is not Python: .*line 1"),
        ("x = 1", "no function create"),
        ("1 / 0\ndef create(scenario): ...", "line 1: ZeroDivisionError"),
        ("import math\ndef create(scenario):\n    return math.nosuch", "line 3: AttributeError"),
        ("def create(scenario):\n    return 5", r"create\(\) returned 5, expected a palpate_bus\.service\.Service"),
    ],
)
def test_a_file_without_a_service_is_refused_with_its_line(tmp_path: Path, text: str | None, said: str) -> None:
    file = tmp_path / "mine.py"
    if text is not None:
        file.write_text(text)
    with pytest.raises(PluginError, match=said):
        load_services(chosen(f"assessment={file}"), ("assessment",))


def test_an_exception_in_a_step_is_reported_with_its_line(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(
        "from palpate_bus.service import Service\nclass Mine(Service):\n    role = 'assessment'\n"
        "    def step(self, t, inbox):\n        return self.nothing\ndef create(scenario):\n    return Mine()\n"
    )
    service = create("assessment", str(file), load_scenario("healthy"))
    with pytest.raises(AttributeError) as raised:
        service.step(0, HandInbox())
    assert Failure.of(raised.value, "tissue", ()).text.startswith(f"{file}, line 5: AttributeError: ")


def test_a_file_takes_the_place_of_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(EXAMPLE.parent)
    scenario = chosen(f"assessment={EXAMPLE.name}")
    assert scenario.services.assessment == str(EXAMPLE)
    (service,) = load_services(scenario, ("assessment",))
    assert type(service).__name__ == "Threshold"


def test_a_run_has_an_optional_role_if_that_has_an_implementation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(roles, "_ROLES", {**roles._ROLES, "thermometer": roles._ROLES["search"]})
    without, with_it = (roles.workers(load_scenario("clean", more)) for more in ([], ["services.thermometer=mine.py"]))
    assert {*with_it} - {*without} == {"thermometer"}


def test_a_file_may_import_modules_of_its_folder(tmp_path: Path) -> None:
    (tmp_path / "module_of_mine.py").write_text(EXAMPLE.read_text(encoding="utf-8"))
    (tmp_path / "mine.py").write_text("from module_of_mine import create\n")
    assert create("assessment", str(tmp_path / "mine.py"), load_scenario("healthy")).role == "assessment"


def test_files_of_two_folders_import_their_own_modules_of_one_name(tmp_path: Path) -> None:
    scan = PluginKind("patterns", "exam.pattern", "scan")
    for folder in ("v1", "v2"):
        (tmp_path / folder / "package_of_mine").mkdir(parents=True)
        (tmp_path / folder / "package_of_mine" / "inner.py").write_text(f"value = '{folder}'\n")
        (tmp_path / folder / "helper_of_mine.py").write_text(f"value = '{folder}'\n")
        (tmp_path / folder / "later_of_mine.py").write_text(f"value = '{folder}'\n")
        text = "import helper_of_mine\nfrom package_of_mine import inner\ndef scan():\n    import later_of_mine\n"
        text += "    return helper_of_mine.value, inner.value, later_of_mine.value\n"
        (tmp_path / folder / "mine.py").write_text(text)
    for folder in ("v1", "v2", "v1"):
        assert scan.load(str(tmp_path / folder / "mine.py"))() == (folder,) * 3
    (tmp_path / "v1" / "helper_of_mine.py").write_text("value = 'changed'\n")
    assert scan.load(str(tmp_path / "v1" / "mine.py"))() == ("changed", "v1", "v1")


def test_a_missing_library_is_named_with_the_extra_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(_: object) -> None:
        raise ModuleNotFoundError("No module named 'mujoco'", name="mujoco")

    kind("robot").check_libraries("mujoco")
    palpate_plugins.missing_libraries.cache_clear()
    monkeypatch.setattr(palpate_plugins, "_installed", lambda name: name != "mujoco")
    monkeypatch.setattr("importlib.metadata.EntryPoint.load", fails)
    kind("robot").check("mujoco")
    for use in (kind("robot").check_libraries, kind("robot").load):
        with pytest.raises(PluginError, match=r"services\.robot = 'mujoco': needs mujoco, .* pip install 'palpate\[mujoco\]'"):
            use("mujoco")
    palpate_plugins.missing_libraries.cache_clear()
