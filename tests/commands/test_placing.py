"""`palpate run --group` and `--processes`: which services share a process, and what is refused before the start."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from palpate import service
from palpate.commands import app_for
from palpate.console import EXIT_BAD_INPUT
from palpate.environment import given
from palpate.run.group import placement
from palpate.run.processes import LocalProcesses, ServiceProcess, compose_file, read_processes
from palpate.run.roles import OBSERVERS, WORKERS, write_scenario_files
from palpate_bus.contract import contract
from palpate_bus.runtime.group import Group
from palpate_bus.service import Inbox, Outbox, Service
from palpate_conductor.outcome import Timing
from palpate_errors import UserError
from palpate_models.scenario.load import load_scenario

ROLES = (*WORKERS, *OBSERVERS)
LOOP = ("robot", "tissue", "control")


def test_a_group_shares_a_process_and_all_others_have_their_own() -> None:
    groups = placement(ROLES, ["robot, tissue,control", "camera,perception"], None)
    assert groups[:2] == (LOOP, ("camera", "perception"))
    assert all(len(group) == 1 for group in groups[2:])
    assert {role for group in groups for role in group} == set(ROLES)


@pytest.mark.parametrize("number", range(1, len(WORKERS) + 1))
def test_as_many_processes_as_are_wanted_hold_every_service_once(number: int) -> None:
    groups = placement(ROLES, (), number)
    assert sorted(role for group in groups for role in group) == sorted(ROLES)
    assert len([group for group in groups if not set(group) & set(OBSERVERS)]) == number
    assert any(set(LOOP) <= set(group) for group in groups) == (number <= len(WORKERS) - 2)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--group", "robot,arm"], "there is no role 'arm'"),
        (["--group", "robot,robot"], "robot is in a group already"),
        (["--group", "robot,control", "--group", "tissue,robot"], "robot is in a group already"),
        (["--group", "robot,dashboard"], "an observer has its own process"),
        (["--group", ""], "there is no role ''"),
        (["--processes", "0"], "allowed are 1 to 8"),
        (["--processes", "9"], "allowed are 1 to 8"),
        (["--processes", "2", "--group", "robot,tissue"], "give one of them"),
        (["--processes", "2", "--composed"], "--composed"),
        (["--group", "robot,tissue", "--wallclock"], "--wallclock"),
        (["--group", "robot,tissue", "--without", "tissue"], "--without tissue"),
    ],
)
def test_what_cannot_be_placed_is_refused_by_name(options: list[str], words: str, tmp_path: Path) -> None:
    done = CliRunner().invoke(app_for("run"), ["run", "--out", str(tmp_path / "out"), *options])
    assert done.exit_code == EXIT_BAD_INPUT
    assert words in " ".join(done.output.split())


def test_a_program_that_is_none_of_ours_shares_no_process() -> None:
    with pytest.raises(UserError, match=r"tissue is played by `\./my_tissue`"):
        ServiceProcess("tissue", ("./my_tissue",), {}).shared_words()
    assert ServiceProcess("tissue", service.command("tissue", "elastic"), {}).shared_words() == ("elastic",)


class Witness:
    """Stands where processes are started, and keeps what each was given."""

    def __init__(self) -> None:
        self.started: dict[str, tuple[tuple[str, ...], dict[str, str]]] = {}

    def start(self, command: tuple[str, ...], environment: dict[str, str], log: Path) -> None:
        self.started[log.stem] = (command, environment)


def test_each_service_of_a_process_keeps_the_scenario_of_its_view(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PALPATE_SCENARIO", raising=False)
    witness = Witness()
    groups = placement(ROLES, [",".join(LOOP)], None)
    files = write_scenario_files(load_scenario("clean"), tmp_path)
    local = LocalProcesses(groups, tmp_path, files, Timing(), forks=witness)  # type: ignore[arg-type]
    try:
        processes = read_processes(compose_file(), ROLES)
        local.start(*(processes[role] for role in LOOP))
        command, environment = witness.started["robot+tissue+control"]
        rows = json.loads(Path(command[-1]).read_text(encoding="utf-8"))
        assert local.bus["robot"] == local.bus["tissue"] != local.bus["planning"]
        assert local.bus["robot"].lowlatency
    finally:
        local.running.clear()
        local.stop()
    assert "PALPATE_SCENARIO" not in environment
    seen = {role: Path(row["environment"]["PALPATE_SCENARIO"]).name for role, row in rows.items()}
    assert seen == {"robot": "plant.yaml", "tissue": "scenario.yaml", "control": "exam.yaml"}


def test_two_runs_on_one_machine_want_no_port_unless_their_user_names_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PALPATE_VIEWER", raising=False)
    dashboard = read_processes(compose_file(), ("dashboard",))["dashboard"]
    files = write_scenario_files(load_scenario("clean"), tmp_path)
    local = LocalProcesses(placement(ROLES, (), None), tmp_path, files, Timing())
    try:
        assert not local.environment(dashboard).get("PALPATE_VIEWER")
        monkeypatch.setenv("PALPATE_VIEWER", "serve:9900")
        assert local.environment(dashboard)["PALPATE_VIEWER"] == "serve:9900"
    finally:
        local.stop()


def test_a_stopped_process_is_woken_at_the_end_and_closes_what_it_has_open(tmp_path: Path) -> None:
    files = write_scenario_files(load_scenario("clean"), tmp_path)
    local = LocalProcesses(placement(ROLES, (), None), tmp_path, files, Timing())
    closed = tmp_path / "closed"
    words = "import os, pathlib, signal, sys; os.kill(os.getpid(), signal.SIGSTOP); pathlib.Path(sys.argv[1]).touch()"
    process = subprocess.Popen([sys.executable, "-c", words, str(closed)])
    os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WNOWAIT)
    local.running["recorder"] = process
    local.stop()
    assert process.returncode == 0
    assert closed.exists()


def test_what_is_given_for_a_while_is_taken_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PALPATE_A", "before")
    with given({"PALPATE_A": "meanwhile", "PALPATE_B": "new"}):
        assert (os.environ["PALPATE_A"], os.environ["PALPATE_B"]) == ("meanwhile", "new")
    assert os.environ["PALPATE_A"] == "before"
    assert "PALPATE_B" not in os.environ


class Idle(Service):
    """A service that is never stepped."""

    def __init__(self, role: str) -> None:
        self.role = role  # type: ignore[misc]

    def step(self, t: int, inbox: Inbox) -> Outbox:
        raise NotImplementedError


def test_every_group_steps_in_the_order_of_all_roles() -> None:
    """Else two groups could wait for each other for ever."""
    rules = contract()
    whole = list(Group([Idle(role) for role in WORKERS], rules).steppers)
    for pair in ((a, b) for a in WORKERS for b in WORKERS if a != b):
        assert sorted(pair, key=whole.index) == list(Group([Idle(role) for role in pair], rules).steppers)
