"""What a run that leaves out a role says, and what a process that joins it is given."""

from __future__ import annotations

from pathlib import Path

import pytest

from palpate import service
from palpate.run.places import Absent, ServicePlace, command_for, place_to_join, place_to_take, write_places
from palpate_bus.runs.announcement import Run
from palpate_bus.runtime.failure import Failure, FailureCode
from palpate_errors import UserError
from palpate_plugins import PluginError

ENVIRONMENT = {"PALPATE_LISTEN": "unixsock-stream//tmp/x/control.sock", "PALPATE_SCENARIO": "/out/exam.yaml"}
COMMAND = service.command("control")
PLACE = ServicePlace(COMMAND, ENVIRONMENT, True)


def absent(folder: Path) -> tuple[Absent, list[str]]:
    said: list[str] = []
    waiting = Absent(("control",), 30.0, said.append)
    write_places(folder, {"control": PLACE})
    waiting.call(folder, {"control": PLACE})
    return waiting, said


def run(folder: Path, runtime: str = "lockstep") -> Run:
    return Run(folder.name, {"camera": "tcp/a:1", "robot": "tcp/b:2"}, 0, runtime, None, str(folder))


def test_it_says_who_is_awaited_where_and_what_joins(tmp_path: Path) -> None:
    _, (sentence,) = absent(tmp_path)
    for words in ("control is awaited", ENVIRONMENT["PALPATE_LISTEN"], "30 s", f"palpate join control --run {tmp_path.name}"):
        assert words in sentence


def test_a_process_that_joins_is_given_what_the_run_would_have_given_it(tmp_path: Path) -> None:
    absent(tmp_path)
    assert place_to_join("control", run(tmp_path)) == PLACE
    with pytest.raises(UserError, match="does not wait for 'robot', but for control"):
        place_to_join("robot", run(tmp_path))


def test_a_run_that_lacks_nobody_says_how_one_is_started(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="palpate run --without robot"):
        place_to_join("robot", run(tmp_path))


def test_only_a_failure_for_want_of_an_answer_is_explained(tmp_path: Path) -> None:
    waiting, (sentence,) = absent(tmp_path)
    lost = Failure(FailureCode.ROLE_LOST, "control lost at 8.000 s: killed", ("control",))
    assert waiting.explain(lost) == lost
    assert sentence in waiting.explain(Failure(FailureCode.NO_ANSWER, "not ready after 30 s", ("control",))).text


def test_unknown_roles_and_implementations_are_answered_with_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="--without arm: allowed are robot"):
        Absent(("arm",), 1.0, print)
    with pytest.raises(PluginError, match=r"services\.robot = 'bullet': want one of dart"):
        command_for("robot", PLACE, "bullet")
    with pytest.raises(PluginError, match="no such file"):
        command_for("robot", PLACE, str(tmp_path / "mine.py"))


def test_a_place_is_entered_by_what_was_there_or_by_what_is_named() -> None:
    assert command_for("control", PLACE, None) == COMMAND
    assert command_for("control", PLACE, "default") == (*COMMAND, "default")


def test_a_place_is_taken_in_a_wall_clock_run_that_keeps_it(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="robot: only assessment, camera can change hands"):
        place_to_take("robot", run(tmp_path, "wallclock"))
    with pytest.raises(UserError, match="in wall-clock runs only"):
        place_to_take("camera", run(tmp_path))
    with pytest.raises(UserError, match="--handover 60"):
        place_to_take("camera", run(tmp_path, "wallclock"))
    write_places(tmp_path, {"camera": PLACE._replace(awaited=False)})
    environment = place_to_take("camera", run(tmp_path, "wallclock")).environment
    assert environment["PALPATE_SCENARIO"] == ENVIRONMENT["PALPATE_SCENARIO"]
    assert environment["PALPATE_LISTEN"] == ""
    assert environment["PALPATE_CONNECT"] == "tcp/b:2"
