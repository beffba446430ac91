"""Processes of a run: the compose file, groups, roles that join or are replaced, and the test of the machine's pace."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from itertools import permutations
from pathlib import Path

import pytest
import yaml
from toy_runs import run_toys, toy_services

from palpate import service
from palpate.run import examine
from palpate.run.group import placement
from palpate.run.places import Absent, ServicePlace, command_for, place_to_join, place_to_take, write_places
from palpate.run.processes import LocalProcesses, ServiceProcess, compose_file, how, read_processes
from palpate.run.roles import OBSERVERS, WORKERS, check_choices, choice, workers, write_scenario_files
from palpate.run.self_test import RATES, TimingResult
from palpate.study.spec import load_study
from palpate_bus.contract import contract
from palpate_bus.runs.announcement import Run
from palpate_bus.runtime.composed import Group
from palpate_bus.runtime.failure import Failure, FailureCode
from palpate_conductor.outcome import Timing
from palpate_errors import UserError
from palpate_models.scenario.load import load_scenario
from palpate_plugins import PluginError

ROLES = (*WORKERS, *OBSERVERS)
LOOP = ("robot", "tissue", "control")
ROOT = Path(__file__).parents[2]


# --- the compose file ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("services: {}", "no service 'robot'"),
        ("services: {robot: {command: python -m x}}", "services.robot.command = 'python -m x': expected a list of words"),
        ("services: {robot: {command: [a], environment: [B=1]}}", "services.robot.environment = ['B=1']: expected a mapping"),
    ],
)
def test_errors_name_file_service_and_field(tmp_path: Path, text: str, error: str) -> None:
    path = tmp_path / "docker-compose.yml"
    path.write_text(text)
    with pytest.raises(UserError, match=re.escape(str(path)) + ".*" + re.escape(error)):
        read_processes(path, ("robot",))


def test_the_compose_file_is_that_of_the_project_or_of_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "docker-compose.yml").write_text("services: {}")
    monkeypatch.chdir(tmp_path)
    assert compose_file() == ROOT / "docker-compose.yml"
    monkeypatch.setenv("PALPATE_COMPOSE", "no/such/file.yml")
    with pytest.raises(UserError, match=r"no/such/file\.yml"):
        compose_file()


def test_overrides_are_merged_as_docker_compose_merges_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    base, one, two = (tmp_path / name for name in ("base.yml", "one.yml", "two.yml"))
    base.write_text("services: {robot: {command: [a], environment: {B: 1, C: 2}}, tissue: {command: [t]}}")
    one.write_text("services: {robot: {environment: {C: 3}}}")
    two.write_text("services: {robot: {command: [python, -m, x], environment: {D: 4}}, prepare: {environment: {E: 5}}}")
    monkeypatch.setenv("PALPATE_COMPOSE", f"{base}:{one}:{two}")
    processes = read_processes(compose_file(), ("robot", "tissue"))
    assert processes["robot"].command == ("python", "-m", "x")
    assert processes["robot"].environment == {"B": "1", "C": "3", "D": "4"}
    assert processes["tissue"].command == ("t",)


@pytest.mark.parametrize(
    "name", ["tissue-fmu", "tissue-elastic", "robot-mujoco", "camera-replay", "planning-raster", "planning-point"]
)
def test_a_swap_is_an_override_whose_settings_select_the_service(name: str) -> None:
    role = name.partition("-")[0]
    file = ROOT / "compose" / f"{name}.yml"
    document = yaml.safe_load(file.read_text(encoding="utf-8"))["services"]
    words = document["prepare"]["environment"]["PALPATE_SETTINGS"].removesuffix("${PALPATE_SETTINGS:-}").split()
    settings = dict(setting.split("=", 1) for setting in words)
    if (method := load_study("swaps").methods.get(name)) is not None:
        assert settings == {**method.settings, **{f"services.{role}": choice for role, choice in method.services.items()}}
    if role == "planning":
        return
    chosen = name.partition("-")[2]
    scenario = load_scenario("healthy", words)  # the recording to replay is in the container
    assert choice(scenario if chosen == "replay" else check_choices(scenario), role) == chosen
    assert read_processes(compose_file(), (role,), (file,))[role].command == service.command(role)
    assert document[role]["build"]["args"]["GROUP"] == name
    assert document[role]["image"].endswith(f"-{name}"), "else `up` would use the image of the default service"


def test_the_override_for_hardware_starts_no_simulation() -> None:
    file = ROOT / "compose" / "hardware.yml"
    document = yaml.safe_load(file.read_text(encoding="utf-8"))["services"]
    words = document["prepare"]["environment"]["PALPATE_SETTINGS"].split()
    scenario = load_scenario("clean", [word for word in words if "=" in word])
    roles = workers(scenario)
    assert {*WORKERS} - {*roles} == {"tissue"}
    assert document["tissue"]["profiles"] == ["simulated"]
    processes = read_processes(compose_file(), (*roles, "search", *OBSERVERS), (file,))
    assert (scenario.services.robot, scenario.services.camera) == ("lbr", "ros")
    assert {process.command for process in processes.values()} == {service.command(role) for role in processes}
    assert {process.environment["PALPATE_RUNTIME"] for process in processes.values()} == {"wallclock"}
    assert "--wallclock" in document["conductor"]["command"]


def test_the_end_of_a_process_is_described_by_its_log(tmp_path: Path) -> None:
    log = tmp_path / "tissue.log"
    when = "2026-11-28 13:43:09,099 tissue"
    traceback = "Traceback (most recent call last):\n  File ...\nMeshError: two\nholes\n\n"
    for text, said in (
        (traceback, "MeshError: two holes"),
        (f"{when} ERROR tissue failed\n{traceback}", "MeshError: two holes"),
        (f"{when} INFO joined\n{when} ERROR x.fmu: refused:\n- touching\n- and f\n", "x.fmu: refused: - touching - and f"),
        ("free text\nof a library\n", "of a library"),
        ("", "its log is empty"),
    ):
        log.write_text(text)
        assert how(3, log) == f"left with status 3: {said}"
    assert how(-9, log) == "killed by signal 9 (SIGKILL)"


# --- groups --------------------------------------------------------------------------------------------------------------


def test_a_group_shares_a_process_and_all_others_have_their_own() -> None:
    groups = placement(ROLES, ["robot, tissue,control", "camera,perception"], None)
    assert groups[:2] == (LOOP, ("camera", "perception"))
    assert all(len(group) == 1 for group in groups[2:])
    assert {role for group in groups for role in group} == set(ROLES)


@pytest.mark.parametrize("number", range(1, len(WORKERS) + 1))
def test_any_number_of_processes_holds_every_service_once(number: int) -> None:
    groups = placement(ROLES, (), number)
    assert sorted(role for group in groups for role in group) == sorted(ROLES)
    assert len([group for group in groups if not set(group) & set(OBSERVERS)]) == number
    assert any(set(LOOP) <= set(group) for group in groups) == (number <= len(WORKERS) - 2)


def test_a_foreign_program_shares_no_process() -> None:
    with pytest.raises(UserError, match=r"tissue is played by `\./my_tissue`"):
        ServiceProcess("tissue", ("./my_tissue",), {}).shared_words()
    assert ServiceProcess("tissue", service.command("tissue", "elastic"), {}).shared_words() == ("elastic",)


def test_every_group_steps_in_the_order_of_all_roles() -> None:
    """Otherwise two groups could wait for each other for ever."""

    def order(roles: Iterable[str]) -> list[str]:
        return list(Group([toy_services.TOYS[role]() for role in roles], contract()).steppers)

    whole = order(toy_services.TOYS)
    for pair in permutations(whole, 2):
        assert sorted(pair, key=whole.index) == order(pair)


# --- local processes -----------------------------------------------------------------------------------------------------


@pytest.fixture
def local(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[LocalProcesses]:
    for name in ("PALPATE_SCENARIO", "PALPATE_VIEWER"):
        monkeypatch.delenv(name, raising=False)
    groups = placement(ROLES, [",".join(LOOP)], None)
    files = write_scenario_files(load_scenario("clean"), tmp_path)
    processes = LocalProcesses(groups, tmp_path, files, Timing())
    yield processes
    processes.stop()


def test_each_service_of_a_process_has_the_scenario_of_its_view(local: LocalProcesses, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local, "_start", lambda command, environment, _: (command, environment))
    processes = read_processes(compose_file(), ROLES)
    local.start(*(processes[role] for role in LOOP))
    command, environment = local.running.pop("robot")
    local.running.clear()
    rows = json.loads(Path(command[-1]).read_text(encoding="utf-8"))
    assert local.bus["robot"] == local.bus["tissue"] != local.bus["planning"]
    assert local.bus["robot"].lowlatency
    assert "PALPATE_SCENARIO" not in environment
    seen = {role: Path(environment["PALPATE_SCENARIO"]).name for role, (_, environment) in rows.items()}
    assert seen == {"robot": "plant.yaml", "tissue": "scenario.yaml", "control": "exam.yaml"}


def test_a_stopped_process_is_continued_at_the_end_and_closes_its_files(local: LocalProcesses, tmp_path: Path) -> None:
    closed = tmp_path / "closed"
    words = "import os, pathlib, signal, sys; os.kill(os.getpid(), signal.SIGSTOP); pathlib.Path(sys.argv[1]).touch()"
    process = subprocess.Popen([sys.executable, "-c", words, str(closed)])
    os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WNOWAIT)
    local.running["recorder"] = process
    local.stop()
    assert process.returncode == 0
    assert closed.exists()


# --- roles that join or are replaced -------------------------------------------------------------------------------------

ENVIRONMENT = {"PALPATE_LISTEN": "unixsock-stream//tmp/x/control.sock", "PALPATE_SCENARIO": "/out/exam.yaml"}
COMMAND = service.command("control")
PLACE = ServicePlace(COMMAND, ENVIRONMENT, True, False)


def run(folder: Path, runtime: str = "lockstep") -> Run:
    return Run(folder.name, {"camera": "tcp/a:1", "robot": "tcp/b:2"}, 0, runtime, None, str(folder))


def test_an_absent_role_is_announced_and_named_if_it_does_not_answer(tmp_path: Path) -> None:
    said: list[str] = []
    waiting = Absent(("control",), 30.0, said.append)
    waiting.call(tmp_path, {"control": PLACE})
    (sentence,) = said
    for words in ("control is awaited", ENVIRONMENT["PALPATE_LISTEN"], "30 s", f"palpate join control --run {tmp_path.name}"):
        assert words in sentence
    lost = Failure(FailureCode.ROLE_LOST, "control lost at 8.000 s: killed", ("control",))
    assert waiting.explain(lost) == lost
    assert sentence in waiting.explain(Failure(FailureCode.NO_ANSWER, "not ready after 30 s", ("control",))).text


def test_a_process_that_joins_is_given_command_and_environment(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="palpate run --without robot"):
        place_to_join("robot", run(tmp_path))
    write_places(tmp_path, {"control": PLACE})
    assert place_to_join("control", run(tmp_path)) == PLACE
    with pytest.raises(UserError, match="does not wait for 'robot', but for control"):
        place_to_join("robot", run(tmp_path))
    assert command_for("control", PLACE, None) == COMMAND
    assert command_for("control", PLACE, "default") == (*COMMAND, "default")
    with pytest.raises(PluginError, match=r"services\.robot = 'bullet'"):
        command_for("robot", PLACE, "bullet")


def test_a_place_is_taken_in_a_wall_clock_run_that_keeps_it(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="robot: only camera can change hands"):
        place_to_take("robot", run(tmp_path, "wallclock"))
    with pytest.raises(UserError, match="in wall-clock runs only"):
        place_to_take("camera", run(tmp_path))
    with pytest.raises(UserError, match="--handover 60"):
        place_to_take("camera", run(tmp_path, "wallclock"))
    write_places(tmp_path, {"camera": PLACE})
    with pytest.raises(UserError, match="--handover 60"):
        place_to_take("camera", run(tmp_path, "wallclock"))
    write_places(tmp_path, {"camera": PLACE._replace(kept=True)})  # left out at the start, and replaced later
    environment = place_to_take("camera", run(tmp_path, "wallclock")).environment
    assert environment["PALPATE_SCENARIO"] == ENVIRONMENT["PALPATE_SCENARIO"]
    assert environment["PALPATE_LISTEN"] == ""
    assert environment["PALPATE_CONNECT"] == "tcp/b:2"


@pytest.mark.parametrize(
    ("ticks", "late_ms", "rate"),
    [(1, 0.3, 1), (0.999, 0.3, 0.5), (1, 15, 0.5), (0.3, 1, 0.25), (0.5, 90, 0.1), (0.05, 1, None), (1, 500, None)],
)
def test_the_greatest_kept_rate_is_chosen(ticks: float, late_ms: float, rate: float | None) -> None:
    assert TimingResult(ticks, late_ms).rate == rate


def rate_of(monkeypatch: pytest.MonkeyPatch, kept: TimingResult, tissue: str = "winkler") -> float:
    monkeypatch.setattr(examine, "measure", lambda _: kept)
    return examine._rate(load_scenario("clean", [f"services.tissue={tissue}"]))


def test_a_run_reports_its_rate_or_why_it_does_not_begin(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("PALPATE_RATE", raising=False)
    assert rate_of(monkeypatch, TimingResult(1.0, 1.0)) == 1.0
    assert capsys.readouterr().err == ""
    assert rate_of(monkeypatch, TimingResult(0.4, 12.0)) == 0.25
    assert "keeps 0.25 of real time" in capsys.readouterr().err
    with pytest.raises(UserError, match=r"cannot keep 0\.1 of real time"):
        rate_of(monkeypatch, TimingResult(0.01, 900.0))
    with pytest.raises(UserError, match="hardware"):
        rate_of(monkeypatch, TimingResult(0.4, 1.0), "none")
    monkeypatch.setenv("PALPATE_RATE", "0.5")
    assert rate_of(monkeypatch, TimingResult(1.0, 1.0)) == RATES[1]


def test_time_runs_at_the_requested_rate() -> None:
    outcome = run_toys(environment={"PALPATE_RATE": "0.5", "TOY_END_S": "1.2"}, wallclock=True)
    assert outcome.failure is None
    assert outcome.sim_time_s == pytest.approx(1.2, abs=0.2)
    assert outcome.wall_time_s > 0.9 * 1.2 / 0.5
    assert 200 < outcome.blame["control"]["steps"] <= 1e3 * outcome.sim_time_s + 1, "a late service continues at the present tick"
