"""What a run that leaves out a role says, and what a process that joins it is given."""

from __future__ import annotations

from pathlib import Path

import pytest

from palpate.run.implementations import ImplementationError, installed_command
from palpate.run.join import Absent, JoinError, given_to
from palpate_bus.runs.announcement import Run

ENVIRONMENT = {"PALPATE_LISTEN": "unixsock-stream//tmp/x/control.sock", "PALPATE_SCENARIO": "/out/exam.yaml"}
COMMAND = ("python", "-m", "palpate_control")


def absent(folder: Path) -> tuple[Absent, list[str]]:
    said: list[str] = []
    waiting = Absent(("control",), 30.0, said.append)
    waiting.call(folder, {"control": (COMMAND, ENVIRONMENT)})
    return waiting, said


def run(folder: Path) -> Run:
    return Run(folder.name, {}, 0, "lockstep", None, str(folder))


def test_it_says_who_is_awaited_where_and_what_joins(tmp_path: Path) -> None:
    _, (sentence,) = absent(tmp_path)
    for words in ("control is awaited", ENVIRONMENT["PALPATE_LISTEN"], "30 s", f"palpate join control --run {tmp_path.name}"):
        assert words in sentence


def test_a_process_that_joins_is_given_what_the_run_would_have_given_it(tmp_path: Path) -> None:
    absent(tmp_path)
    assert given_to("control", run(tmp_path)) == (COMMAND, ENVIRONMENT)
    with pytest.raises(JoinError, match="does not wait for 'robot', but for control"):
        given_to("robot", run(tmp_path))


def test_a_run_that_lacks_nobody_says_how_one_is_started(tmp_path: Path) -> None:
    with pytest.raises(JoinError, match="palpate run --without robot"):
        given_to("robot", run(tmp_path))


def test_only_a_failure_for_want_of_an_answer_is_explained(tmp_path: Path) -> None:
    waiting, (sentence,) = absent(tmp_path)
    assert waiting.explain("control lost at tick 8.000 s: killed") == "control lost at tick 8.000 s: killed"
    assert sentence in waiting.explain("not ready after 30 s: no answer from control. ")


def test_unknown_roles_and_implementations_are_answered_with_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(JoinError, match="--without arm: allowed are robot"):
        Absent(("arm",), 1.0, print)
    with pytest.raises(ImplementationError, match="--implementation dart: for robot there are default"):
        installed_command("robot", "dart", None)
    with pytest.raises(ImplementationError, match="is no file"):
        installed_command("robot", "default", tmp_path / "mine.py")
