"""The process list."""

from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from palpate import service
from palpate.commands import app_for
from palpate.console import EXIT_BAD_INPUT
from palpate.run.processes import compose_file, how, override_files, read_processes
from palpate.run.roles import OBSERVERS, WORKERS, checked, choice, workers
from palpate.study.spec import load_study
from palpate_errors import UserError
from palpate_models.scenario.load import load_scenario

INHERITED = "${PALPATE_SETTINGS:-}"


def test_every_role_of_a_run_is_in_the_compose_file() -> None:
    processes = read_processes(compose_file(), (*WORKERS, *OBSERVERS))
    assert processes["robot"].command == service.command("robot")
    assert processes["robot"].environment["OMP_NUM_THREADS"] == "1"


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("services: {}", "no service 'robot'"),
        ("services: {robot: {command: python -m x}}", "services.robot.command = 'python -m x': want a list of words"),
        ("services: {robot: {command: [a], environment: [B=1]}}", "services.robot.environment: want a mapping"),
    ],
)
def test_errors_name_file_service_and_field(tmp_path: Path, text: str, error: str) -> None:
    path = tmp_path / "docker-compose.yml"
    path.write_text(text)
    with pytest.raises(UserError) as caught:
        read_processes(path, ("robot",))
    assert str(path) in str(caught.value)
    assert error in str(caught.value)


def test_a_missing_compose_file_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PALPATE_COMPOSE", "no/such/file.yml")
    with pytest.raises(UserError, match=r"no/such/file\.yml"):
        compose_file()


def test_the_compose_file_of_whatever_folder_one_is_in_is_not_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "docker-compose.yml").write_text("services: {}")
    monkeypatch.chdir(tmp_path)
    assert compose_file() == Path(__file__).parents[2] / "docker-compose.yml"


def test_overrides_are_merged_as_docker_compose_merges_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    base, one, two = (tmp_path / name for name in ("base.yml", "one.yml", "two.yml"))
    base.write_text("services: {robot: {command: [a], environment: {B: 1, C: 2}}, tissue: {command: [t]}}")
    one.write_text("services: {robot: {environment: {C: 3}}}")
    two.write_text("services: {robot: {command: [python, -m, x], environment: {D: 4}}, prepare: {environment: {E: 5}}}")
    monkeypatch.setenv("PALPATE_COMPOSE", f"{base}:{one}:{two}")
    processes = read_processes(compose_file(), ("robot", "tissue"), override_files())
    assert processes["robot"].command == ("python", "-m", "x")
    assert processes["robot"].environment == {"B": "1", "C": "3", "D": "4"}
    assert processes["tissue"].command == ("t",)


def test_every_swap_is_an_override_whose_settings_choose_what_its_container_runs() -> None:
    root = compose_file().parent
    for name in ("tissue-fmu", "tissue-elastic", "robot-mujoco", "camera-replay", "planning-raster", "planning-point"):
        role = name.partition("-")[0]
        file = root / "compose" / f"{name}.yml"
        document = yaml.safe_load(file.read_text(encoding="utf-8"))
        words = document["services"]["prepare"]["environment"]["PALPATE_SETTINGS"].removesuffix(INHERITED).split()
        settings = dict(setting.split("=", 1) for setting in words)
        chosen = settings.get(f"services.{role}")
        method = load_study("swaps").methods.get(name)
        if method is not None:
            assert settings == {**method.settings, **{f"services.{role}": choice for role, choice in method.services.items()}}
        if role == "planning":
            assert chosen is None
            continue
        assert name == f"{role}-{chosen}"
        entry = document["services"][role]
        assert choice(checked(load_scenario("healthy", words)), role) == chosen
        processes = read_processes(compose_file(), (role,), (file,))
        assert processes[role].command == service.command(role), "which goes by the scenario"
        assert entry["build"]["args"]["GROUP"] == name
        assert entry["image"].endswith(f"-{name}"), "else `up` would take the image of what it replaces"


def test_the_override_for_hardware_starts_no_simulation() -> None:
    root = compose_file().parent
    file = root / "compose" / "hardware.yml"
    document = yaml.safe_load(file.read_text(encoding="utf-8"))
    words = document["services"]["prepare"]["environment"]["PALPATE_SETTINGS"].split()
    scenario = load_scenario("clean", [word for word in words if "=" in word])
    roles = workers(scenario)
    assert set(WORKERS) - set(roles) == {"tissue"}
    assert document["services"]["tissue"]["profiles"] == ["simulated"]
    processes = read_processes(compose_file(), (*roles, "search", *OBSERVERS), (file,))
    assert (scenario.services.robot, scenario.services.camera) == ("lbr", "ros")
    assert {process.command for process in processes.values()} == {service.command(role) for role in processes}
    assert {process.environment["PALPATE_RUNTIME"] for process in processes.values()} == {"wallclock"}
    assert "--wallclock" in document["services"]["conductor"]["command"]


@pytest.mark.parametrize("words", [["run"], ["run", "--composed"], ["run", "--realtime"]])
def test_real_tissue_waits_for_no_simulated_time(words: list[str], tmp_path: Path) -> None:
    called = CliRunner().invoke(app_for("run"), [*words, "--set", "services.tissue=none", "--out", str(tmp_path / "out")])
    assert called.exit_code == EXIT_BAD_INPUT
    assert "--wallclock" in called.output
    assert not (tmp_path / "out").exists()


def test_how_a_process_ended_is_said_in_its_own_words(tmp_path: Path) -> None:
    log = tmp_path / "tissue.log"
    log.write_text("Traceback (most recent call last):\n  File ...\nMeshError: two holes\n\n")
    assert how(3, log) == "left with status 3: MeshError: two holes"
    assert how(-9, log) == "killed by signal 9"
    log.write_text("")
    assert how(1, log) == "left with status 1: its log is empty"
    assert how(0, log).endswith("?")


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (["phantom.lesions=[{centre_m: [-55, 10]}]"], "phantom.lesions[0]"),
        (["phantom.kind=mesh", "phantom.mesh=/nowhere.stl"], "phantom.mesh = /nowhere.stl: no such file"),
    ],
)
def test_a_phantom_that_cannot_be_made_is_named_before_anything_starts(settings: list[str], words: str, tmp_path: Path) -> None:
    options = [word for setting in settings for word in ("--set", setting)]
    called = CliRunner().invoke(app_for("run"), ["run", *options, "--out", str(tmp_path / "out")])
    assert called.exit_code == EXIT_BAD_INPUT
    assert words in called.output
    assert not (tmp_path / "out").exists()
