"""A conductor stood still if it was silent for longer than its services wait: less by the wall clock than in lockstep."""

from __future__ import annotations

import pytest

from palpate_bus.contract import contract
from palpate_bus.runtime.member import Member
from palpate_bus.wire.zenoh_config import BusOptions, close_session, open_session
from palpate_conductor import heartbeat
from palpate_conductor.heartbeat import Heartbeat


@pytest.mark.parametrize(("wallclock", "stood_still_s"), [(True, 0.4), (False, 0.0)])
def test_less_than_the_services_wait_is_no_standstill(
    monkeypatch: pytest.MonkeyPatch, wallclock: bool, stood_still_s: float
) -> None:
    session = open_session(BusOptions())
    now = 100.0
    monkeypatch.setattr(heartbeat, "monotonic", lambda: now)
    try:
        heart = Heartbeat(Member(session, "conductor", contract(), 0), contract(), wallclock)
        heart.turn()
        now += 0.4
        heart.turn()
        assert heart.stood_still_s == pytest.approx(stood_still_s)
    finally:
        close_session(session)


def test_a_loop_that_stands_still_while_the_heart_beats_is_missed_by_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else what really ended a run would be overwritten by "conductor lost"."""
    session = open_session(BusOptions())
    now = 100.0
    monkeypatch.setattr(heartbeat, "monotonic", lambda: now)
    try:
        heart = Heartbeat(Member(session, "conductor", contract(), 0), contract(), wallclock=True)
        heart.turn()
        now += 0.4
        heart._beaten = now - 0.1
        heart.turn()
        assert heart.stood_still_s == 0.0
    finally:
        close_session(session)
