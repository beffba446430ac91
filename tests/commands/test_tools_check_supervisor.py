"""The supervisor's suite: ours passes, and one that fails in what a supervisor is for is caught by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from palpate.check.rig import RigSettings, ServiceRig
from palpate.check.suites import check
from palpate_bus.service import Inbox, Outbox, Service
from palpate_models.scenario.load import load_scenario
from palpate_supervisor.service import create

SCENARIO = load_scenario("clean")


class Spoilt(Service):
    """Our supervisor, whose state is changed before it is sent."""

    role = "supervisor"

    def __init__(self, change: Callable[[Any], None]) -> None:
        self._inner, self._change = create(SCENARIO), change

    def step(self, t: int, inbox: Inbox) -> Outbox:
        outbox = dict(self._inner.step(t, inbox))
        self._change(outbox["supervisor/state"])
        return outbox


def sound(state: Any) -> None:
    pass


def never_stops(state: Any) -> None:
    state.level = state.cause = 0


def forgets(state: Any) -> None:
    """Stops only as long as its cause stands: of the operator's word it keeps nothing."""
    if state.cause == 8:
        state.level = 0


def half_force(state: Any) -> None:
    state.force /= 2


def soft_only(state: Any) -> None:
    state.level = min(state.level, 1)


@pytest.mark.parametrize(
    ("change", "caught_by"),
    [
        pytest.param(sound, "", id="sound"),
        pytest.param(half_force, "force is what pushes the tool", id="half_force"),
        pytest.param(never_stops, "stops for a tool too fast", id="never_stops", marks=pytest.mark.slow),
        pytest.param(forgets, "it stays, with the operator's reason", id="forgets", marks=pytest.mark.slow),
        pytest.param(soft_only, "stops for a force over the emergency limit", id="soft_only", marks=pytest.mark.slow),
    ],
)
def test_the_suite_catches_what_is_wrong_and_nothing_else(change: Callable[[Any], None], caught_by: str) -> None:
    report = check(ServiceRig(Spoilt(change), RigSettings(SCENARIO)))
    failed = [result.name for result in report.failed]
    assert (caught_by in failed) if caught_by else (failed == [] and report.passed)
