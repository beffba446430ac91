"""Placement of services on processes: one run hash, and all roles of a lost process are lost."""

from __future__ import annotations

import signal
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import pytest
from examination import SHORT, Finished, palpate_run
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from toy_runs import ROLES, Running, assert_failed, at, composed_hash, run_toys, toy_services

from palpate_bus.contract import MS
from palpate_bus.messages.stamps import NS
from palpate_bus.runtime.failure import FailureCode
from palpate_conductor.outcome import Patience

LOOP = ("robot", "tissue", "control")
REST = tuple((role,) for role in ROLES if role not in LOOP)


def grouped(process: Sequence[int]) -> list[tuple[str, ...]]:
    """The roles by the number of their process."""
    groups = defaultdict(list)
    for role, number in zip(ROLES, process, strict=True):
        groups[number].append(role)
    return [tuple(roles) for roles in groups.values()]


@settings(max_examples=4, deadline=None, derandomize=True, database=None, phases=[Phase.explicit, Phase.generate])
@given(process=st.lists(st.integers(0, 3), min_size=len(ROLES), max_size=len(ROLES)))
def test_every_placement_gives_the_run_hash_of_the_composed_run(process: Sequence[int]) -> None:
    outcome = run_toys(groups=grouped(process))
    assert outcome.failure is None
    assert outcome.last_tick == toy_services.END
    assert outcome.run_hash == composed_hash()
    assert set(outcome.reports) == set(ROLES)


def test_all_roles_of_a_killed_process_are_lost_and_the_others_run_one_more_second() -> None:
    done: list[bool] = []

    def kill(running: Running) -> None:
        if at(running, 0.5, done):
            running.processes["control"].kill()

    pair = ("control", "planning")
    outcome = run_toys(kill, {"TOY_END_S": "30"}, groups=[pair, *((role,) for role in ROLES if role not in pair)])
    assert outcome.lost.keys() == set(pair), outcome.trouble
    assert_failed(outcome, FailureCode.ROLE_LOST, *pair)
    assert outcome.last_tick >= outcome.lost["control"] + NS - MS


def test_a_killed_loop_ends_the_run() -> None:
    done: list[bool] = []

    def kill(running: Running) -> None:
        if at(running, 0.3, done):
            running.processes["tissue"].kill()

    outcome = run_toys(kill, {"TOY_END_S": "30"}, groups=[LOOP, *REST])
    assert outcome.lost.keys() == set(LOOP), outcome.trouble


def test_of_a_shared_process_the_service_that_raised_is_named() -> None:
    outcome = run_toys(environment={"TOY_CONTROL_FAILS_AT": "700"}, groups=[LOOP, *REST])
    assert outcome.lost.keys() == set(LOOP), outcome.trouble
    assert outcome.failure is not None
    assert outcome.failure.code is FailureCode.ROLE_FAILED
    assert "control: ArithmeticError: toy failure" in str(outcome.failure)


def test_all_roles_of_a_frozen_process_are_lost() -> None:
    done: list[bool] = []

    def freeze(running: Running) -> None:
        if at(running, 0.3, done):
            running.processes["planning"].send_signal(signal.SIGSTOP)

    pair = ("planning", "perception")
    others = [LOOP, *((role,) for role in ROLES if role not in (*LOOP, *pair))]
    outcome = run_toys(freeze, {"TOY_END_S": "30"}, Patience(soft=0.5, hard=60.0, frozen=1.0), groups=[pair, *others])
    assert outcome.lost.keys() == set(pair)
    assert_failed(outcome, FailureCode.FROZEN, *pair)


@pytest.fixture(scope="module")
def one_process(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    return palpate_run("clean", tmp_path_factory.mktemp("one"), "--composed", "--record", "none", settings=SHORT)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        ("--group", "robot,tissue,control"),
        ("--group", "robot,camera", "--group", "control,perception,planning", "--record", "none"),
        ("--processes", "2", "--secure", "--record", "none"),
    ],
)
def test_an_examination_has_one_run_hash_however_it_is_placed(
    options: tuple[str, ...], one_process: Finished, tmp_path: Path
) -> None:
    placed = palpate_run("clean", tmp_path, *options, settings=SHORT)
    assert placed.status == 0, placed.output
    assert placed.report["run_hash"] == one_process.report["run_hash"]
