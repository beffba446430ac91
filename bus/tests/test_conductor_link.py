"""Tests of the detection of a lost conductor, with a clock that the test sets."""

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import pytest

from palpate_bus.contract import contract
from palpate_bus.messages import RunControl, codec
from palpate_bus.runtime import conductor_link
from palpate_bus.runtime.conductor_link import CONTROL_TYPE, HEARTBEAT, TIMES, ConductorLink, RunAborted
from palpate_bus.runtime.process import pid_space
from palpate_bus.wire.transport import ReceivedSample

STEP_S = 0.01
PID = 4711
DEADLINE_S = contract().internal[HEARTBEAT].deadline / 1e9


@dataclass
class Queue:
    waiting: deque[tuple[int, bytes]] = field(default_factory=deque)
    garbage: int = 0
    latest: tuple[int, bytes] = (0, b"")
    """The last message with its number; a replayed one repeats it."""

    def get(self, timeout: float | None) -> ReceivedSample | None:
        number, payload = self.waiting.popleft() if self.waiting else (0, b"")
        return ReceivedSample(number, 0, payload) if payload else None

    def put(self, payload: bytes) -> None:
        self.latest = (self.latest[0] + 1, payload)
        self.waiting.append(self.latest)

    def replay(self) -> None:
        self.waiting.append(self.latest)


class Bus:
    """Member of a bus with a conductor only, and the time."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, runtime: str) -> None:
        monkeypatch.setenv("PALPATE_RUNTIME", runtime)
        monkeypatch.setattr(conductor_link, "monotonic", lambda: self.now)
        monkeypatch.setattr(conductor_link, "is_running", lambda pid: self.runs and pid == PID)
        self.contract = contract()
        self.now = 100.0
        self.runs = False
        self.token = True
        self.queues = {"palpate/control": Queue(), HEARTBEAT: Queue()}

    def internal_subscription(self, name: str, type_name: str) -> Queue:
        assert type_name == CONTROL_TYPE
        return self.queues[name]

    def gone(self) -> frozenset[str]:
        return frozenset() if self.token else frozenset({"conductor"})

    def transport_lost(self) -> bool:
        return False

    def say(self, command: int) -> None:
        name = HEARTBEAT if command == RunControl.HEARTBEAT else "palpate/control"
        message = RunControl(command, PID, False, "", pid_space())
        self.queues[name].put(codec.encode(message, CONTROL_TYPE))

    def link(self, grace_s: float = 0.0) -> ConductorLink:
        """Return a link that has received the start and a heartbeat."""
        member: Any = self
        link = ConductorLink(member, grace_s)
        self.say(RunControl.GRANT)
        assert link.poll() is not None
        self.say(RunControl.HEARTBEAT)
        link.poll()
        return link

    def silence(self, link: ConductorLink, seconds: float, step_s: float = STEP_S) -> float:
        """Advance the clock by `seconds`; return the time at which the conductor was lost, infinity if it was not."""
        begin = self.now
        while self.now - begin < seconds:
            self.now += step_s
            link.poll()
            if link.lost:
                return self.now - begin
        return float("inf")


@pytest.fixture
def wallclock(monkeypatch: pytest.MonkeyPatch) -> Bus:
    return Bus(monkeypatch, "wallclock")


@pytest.mark.parametrize(
    ("runtime", "runs", "limit_s"),
    [
        ("wallclock", False, DEADLINE_S),
        ("wallclock", True, TIMES.busy_s),
        ("lockstep", False, TIMES.lockstep_heartbeat_s),
        ("lockstep", True, TIMES.lockstep_busy_s),
    ],
)
def test_silence_is_noticed_later_in_lockstep_and_while_the_process_runs_without_a_core(
    runtime: str, runs: bool, limit_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus = Bus(monkeypatch, runtime)
    bus.runs = runs
    assert limit_s < bus.silence(bus.link(grace_s=9.0), 60.0) <= limit_s + 0.1


def test_a_service_that_was_itself_kept_from_a_core_does_not_blame_the_conductor(wallclock: Bus) -> None:
    link = wallclock.link(grace_s=9.0)
    assert wallclock.silence(link, 0.9, step_s=0.45) == float("inf")


def test_a_conductor_whose_token_is_gone_is_lost_at_once(wallclock: Bus) -> None:
    link = wallclock.link(grace_s=9.0)
    wallclock.token = False
    assert wallclock.silence(link, 1.0) <= 5 * STEP_S


def test_services_leave_after_the_grace_period(wallclock: Bus) -> None:
    link = wallclock.link(grace_s=2.0)
    assert wallclock.silence(link, 1.0) < 1.0
    lost_at = wallclock.now
    with pytest.raises(RunAborted, match="no heartbeat for"):
        for _ in range(1000):
            wallclock.now += STEP_S
            link.poll()
    assert 2.0 <= wallclock.now - lost_at < 2.1


def test_a_conductor_that_returns_is_not_lost(wallclock: Bus) -> None:
    link = wallclock.link(grace_s=2.0)
    wallclock.silence(link, 1.0)
    wallclock.say(RunControl.HEARTBEAT)
    link.poll()
    assert not link.lost


def test_a_conductor_without_a_heartbeat_has_the_limit_of_a_start(wallclock: Bus) -> None:
    member: Any = wallclock
    link = ConductorLink(member, 9.0)
    wallclock.say(RunControl.GRANT)
    link.poll()
    assert wallclock.silence(link, 9.0) == float("inf")


def test_a_replayed_heartbeat_is_ignored(wallclock: Bus) -> None:
    link = wallclock.link(grace_s=9.0)
    for _ in range(30):
        wallclock.queues[HEARTBEAT].replay()
        wallclock.silence(link, STEP_S)
    assert link.lost


def test_a_replayed_control_message_is_ignored(wallclock: Bus) -> None:
    link = wallclock.link()
    wallclock.queues["palpate/control"].replay()
    assert link.poll() is None
    assert link.garbage == 1
