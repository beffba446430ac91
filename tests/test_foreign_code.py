"""Services and files that exit, crash, hang or print: none takes the command or its output with it."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from time import sleep

import pytest
from toy_runs import ROLES, composed_hash, run_toys, toy_services

from palpate import apart
from palpate.apart import ChildLost, Send, TimeLimit, run_apart
from palpate.check.perform import check_here
from palpate.check.rig import RigSettings
from palpate.run import composed
from palpate.run.inputs import scan_safely
from palpate.run.roles import check_choices
from palpate_bus.runtime.failure import FailureCode
from palpate_conductor.outcome import Patience, RunProgress, RunResult
from palpate_errors import RunError
from palpate_models.scenario.load import load_scenario
from palpate_plugins import PluginError

SCENARIO = load_scenario("clean", ["services.tissue=mine.py"])
LOST, FAILED, BLOCKED = FailureCode.ROLE_LOST, FailureCode.ROLE_FAILED, FailureCode.BLOCKED
ENDS = [
    ("exit3", LOST, "left with status 3"),
    ("leave", FAILED, "SystemExit: 0"),
    ("crash", LOST, "killed by signal 11 (SIGSEGV)"),
    ("terminate", FAILED, "ChildLost: raised signal 15 (SIGTERM) itself"),
    ("hang", BLOCKED, "did not return within 0.5 s in its step (PALPATE_STEP_LIMIT_S)"),
    ("spin", BLOCKED, "did not return within 0.5 s in its step (PALPATE_STEP_LIMIT_S)"),
]


class Toys:
    """Makes the toy services; `at_load` and `at_end` misbehave in the tissue."""

    at_load = at_end = ""

    def create(self, role: str, _: str, __: object) -> object:
        if role == "tissue" and self.at_load:
            toy_services.misbehave(self.at_load)
        service = toy_services.TOYS[role]()
        if role == "tissue" and self.at_end:
            service.finish = lambda: toy_services.misbehave(self.at_end) or {}  # type: ignore[method-assign, func-returns-value]
        return service


@pytest.fixture
def toys(monkeypatch: pytest.MonkeyPatch) -> Toys:
    made = Toys()
    monkeypatch.setattr(composed, "create", made.create)
    monkeypatch.setattr(composed, "workers", lambda _: ROLES)
    monkeypatch.setenv("PALPATE_STEP_LIMIT_S", "0.5")
    monkeypatch.setenv("PALPATE_START_LIMIT_S", "0.5")
    monkeypatch.setattr(apart, "PARENT_S", 0.1)
    return made


def run(out: Path, shown: list[RunProgress] | None = None) -> RunResult:
    return composed.run_composed(SCENARIO, out, (shown if shown is not None else []).append, observers=())


@pytest.mark.usefixtures("toys")
def test_a_composed_run_gives_what_its_child_has_collected(tmp_path: Path) -> None:
    shown: list[RunProgress] = []
    result = run(tmp_path, shown)
    collected, facts = result.collected, result.counters["conductor"]["facts"]
    assert (result.failure, result.run_hash, result.sim_time_s) == (None, composed_hash(), toy_services.END / 1e9)
    assert (len(collected.exam_states), len(collected.samples)) == (facts["exam_states"], facts["samples"])
    assert facts["samples"] > 0
    assert collected.end_tick == toy_services.END
    assert collected.phantom is not None
    assert shown[-1].collected is collected


@pytest.mark.usefixtures("toys")
@pytest.mark.parametrize(("how", "code", "text"), ENDS)
def test_a_composed_run_names_the_service_and_how_it_ended(
    how: str, code: FailureCode, text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TOY_TISSUE_DOES", how)
    result = run(tmp_path)
    assert result.failure.text.startswith(f"tissue lost at 0.500 s: {text}")
    assert (result.failure.code, result.failure.roles) == (code, ("tissue",))
    assert (result.lost, result.run_hash) == ({"tissue": 500_000_000}, None)
    printed = capfd.readouterr()
    assert printed.out == ""
    assert f"{how} by file descriptor 1" in printed.err


@pytest.mark.parametrize(
    ("how", "code", "text"),
    [
        ("exit0", FailureCode.START_FAILED, "tissue lost at start: left with status 0"),
        ("crash", FailureCode.START_FAILED, "tissue lost at start: killed by signal 11 (SIGSEGV)"),
        ("hang", FailureCode.NO_ANSWER, "tissue lost at start: did not return within 0.5 s (PALPATE_START_LIMIT_S)"),
    ],
)
def test_a_service_that_cannot_be_loaded_is_named(
    how: str, code: FailureCode, text: str, toys: Toys, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    toys.at_load = how
    failure = run(tmp_path).failure
    assert (failure.code, failure.text, failure.roles) == (code, text, ("tissue",))
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize(
    ("how", "text"), [("exit0", "tissue lost at its end: left with status 0"), ("leave", "tissue lost at 1.200 s: SystemExit: 0")]
)
def test_a_service_that_exits_at_its_end_leaves_what_was_measured(how: str, text: str, toys: Toys, tmp_path: Path) -> None:
    toys.at_end = how
    result = run(tmp_path)
    assert result.failure.text == text
    assert result.collected.end_tick == toy_services.END


@pytest.mark.usefixtures("toys")
def test_an_interruption_is_that_of_the_child(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TOY_TISSUE_DOES", "interrupt")
    monkeypatch.setenv("PALPATE_STEP_LIMIT_S", "20")
    result = run(tmp_path)
    assert (result.interrupted, result.failure.code) == (True, FailureCode.INTERRUPTED)


def test_an_interruption_that_a_library_swallows_is_not_an_error_of_its_own() -> None:
    def compile_it(send: Send) -> None:
        send("begun")
        with suppress(KeyboardInterrupt):  # as a callback of ctypes does
            sleep(20)
        raise RuntimeError("no compiled object yet")

    with pytest.raises(KeyboardInterrupt):
        run_apart(compile_it, receive=lambda _: signal.raise_signal(signal.SIGINT))


def test_a_signal_that_foreign_code_raises_is_no_interruption() -> None:
    with pytest.raises(ChildLost, match=r"raised signal 15 \(SIGTERM\) itself"):
        run_apart(lambda _: signal.raise_signal(signal.SIGTERM))
    assert run_apart(lambda _: signal.raise_signal(signal.SIGINT) or "done") == "done"  # type: ignore[func-returns-value]


class Called:
    """Is unpickled as what a function returns."""

    def __init__(self, function: Callable[..., object], argument: object) -> None:
        self._call = function, (argument,)

    def __reduce__(self) -> tuple[Callable[..., object], tuple[object]]:
        return self._call


def test_a_child_that_closes_its_pipe_is_lost_at_its_time_limit() -> None:
    with pytest.raises(ChildLost, match=r"did not return within 0\.3 s"):
        run_apart(lambda _: os.closerange(3, 64) or sleep(20), check=TimeLimit(tuple, lambda: 0.3).check)  # type: ignore[func-returns-value]


def test_a_child_whose_message_cannot_be_read_is_lost() -> None:
    def work(send: Send) -> None:
        send(Called(import_module, "only_the_child_has_this"))
        sleep(20)

    with pytest.raises(
        ChildLost, match="sent what cannot be read: ModuleNotFoundError: No module named 'only_the_child_has_this'"
    ):
        run_apart(work, check=TimeLimit(tuple, lambda: 5.0).check)


def test_a_result_that_takes_longer_to_read_than_its_child_to_end_is_returned() -> None:
    assert run_apart(lambda _: Called(sleep, 0.4)) is None


@pytest.mark.parametrize("how", ["leave", "terminate", "hang"])
def test_separate_processes_name_it_too(how: str) -> None:
    rest = ("planning", *(role for role in ROLES if role not in ("tissue", "planning")))
    patience = Patience(foreign=frozenset({"tissue"}), foreign_step=2.0)
    outcome = run_toys(environment={"TOY_TISSUE_DOES": how}, patience=patience, groups=(("tissue",), rest))
    assert "tissue" in outcome.failure.roles
    assert outcome.failure.code in ((BLOCKED,) if how == "hang" else (LOST, FAILED))


@pytest.mark.parametrize("does", ["os._exit(0)", "sys.exit(0)", "ctypes.string_at(0)", "time.sleep(600)"])
@pytest.mark.parametrize(("field", "function"), [("exam.pattern", "scan"), ("search.policy", "next_press")])
def test_a_file_that_is_loaded_before_the_run_is_named(
    field: str, function: str, does: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PALPATE_START_LIMIT_S", "1")
    file = tmp_path / "mine.py"
    file.write_text(f"import ctypes, os, sys, time\n{does}\ndef {function}(*_): pass\n")
    settings = [f"{field}={file}", *(["exam.pattern=search"] if field == "search.policy" else [])]
    scenario = load_scenario("clean", settings)
    with pytest.raises(PluginError, match=f"{field} = '{file}'"):
        if function == "scan":
            scan_safely(scenario.exam, lambda xy: (xy, xy))
        else:
            check_choices(scenario)


def test_a_check_of_a_service_that_exits_does_not_pass(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("import os\ndef create(scenario): os._exit(0)\n")
    with pytest.raises(RunError, match=r"services.control = .*left with status 0"):
        check_here("control", str(file), RigSettings(load_scenario("clean"), 0.0, motion=False))


def test_a_document_on_standard_output_is_alone() -> None:
    program = "from palpate.console import *; reserve_output(); print('a'); os.write(1, b'b'); print_json({'c': 1})"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == {"c": 1}
    assert set("ab") <= set(done.stderr)
