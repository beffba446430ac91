"""Services placed on processes in any way: one run hash, and a lost process is all its roles lost."""

from __future__ import annotations

import signal
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import pytest
from examination import SHORT, Finished, palpate_run
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from toy_runs import ROLES, Running, at, composed_hash, run_toys, toy_services

from palpate_bus.contract import MS
from palpate_bus.messages.stamps import NS
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


def test_when_a_process_dies_each_of_its_roles_is_named_and_the_others_run_one_more_second() -> None:
    done: list[bool] = []

    def kill(running: Running) -> None:
        if at(running, 0.5, done):
            running.processes["control"].kill()

    pair = ("control", "planning")
    outcome = run_toys(kill, {"TOY_END_S": "30"}, groups=[pair, *((role,) for role in ROLES if role not in pair)])
    assert outcome.lost.keys() == set(pair), outcome.trouble
    assert outcome.failure is not None
    for role in pair:
        assert f"{role} lost at" in outcome.failure
    assert outcome.last_tick >= outcome.lost["control"] + NS - MS


def test_when_the_loop_dies_the_run_ends_at_once_and_names_its_roles() -> None:
    done: list[bool] = []

    def kill(running: Running) -> None:
        if at(running, 0.3, done):
            running.processes["tissue"].kill()

    outcome = run_toys(kill, {"TOY_END_S": "30"}, groups=[LOOP, *REST])
    assert outcome.lost.keys() == set(LOOP), outcome.trouble


def test_of_a_process_the_service_that_raised_is_named() -> None:
    outcome = run_toys(environment={"TOY_CONTROL_FAILS_AT": "700"}, groups=[LOOP, *REST])
    assert outcome.lost.keys() == set(LOOP), outcome.trouble
    assert outcome.failure is not None
    assert "control: ArithmeticError: toy failure" in outcome.failure


def test_a_frozen_process_is_blamed() -> None:
    done: list[bool] = []

    def freeze(running: Running) -> None:
        if at(running, 0.3, done):
            running.processes["planning"].send_signal(signal.SIGSTOP)

    pair = ("planning", "perception")
    others = [LOOP, *((role,) for role in ROLES if role not in (*LOOP, *pair))]
    outcome = run_toys(freeze, {"TOY_END_S": "30"}, Patience(soft=0.5, hard=60.0, frozen=1.0), groups=[pair, *others])
    assert outcome.failure is not None
    assert outcome.lost.keys() == set(pair)
    assert "is stopped and has used no processor time" in outcome.failure


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
