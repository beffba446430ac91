"""Tests of the recorder's process and its chunks."""

import json
import signal
from collections import deque
from collections.abc import Mapping
from contextlib import nullcontext
from typing import Any

import pytest
from hypothesis import given, strategies as st
from toy_services import joint_state

from palpate_bus.contract import Topic, contract
from palpate_bus.messages import MS, RunControl, ServiceReport, codec
from palpate_bus.runtime.conductor_link import CONTROL_TYPE, RunAborted
from palpate_bus.runtime.member import ChunkWriter, unpack_chunk
from palpate_bus.runtime.observer import RecorderNode
from palpate_bus.service import Inbox, Outbox, Service
from palpate_bus.wire.transport import ReceivedSample

TOPICS = ("joint_states", "ft/wrench")
messages = st.lists(
    st.tuples(st.sampled_from(TOPICS), st.binary(max_size=300), st.integers(0, 2**40), st.integers(0, 2**32 - 1)), max_size=40
)


@given(messages)
def test_a_chunk_round_trips(sent: list[tuple[str, bytes, int, int]]) -> None:
    spool = ChunkWriter("robot", TOPICS)
    for message in sent:
        spool.add(*message)
    tick, received = unpack_chunk(spool.chunk(7))
    assert tick == 7
    assert list(received) == sent


PRODUCERS = [name for name, role in contract().roles.items() if not role.observer]
STATE = codec.encode(joint_state(0), "sensor_msgs/msg/JointState")


class Queue:
    hello_received = True
    garbage = 0

    def __init__(self, *payloads: bytes) -> None:
        self.waiting = deque(enumerate(payloads, 1))

    def get(self, timeout: float | None) -> ReceivedSample | None:
        number, payload = self.waiting.popleft() if self.waiting else (0, None)
        return None if payload is None else ReceivedSample(number, 0, payload)


class Kept(Service):
    role = "recorder"
    trouble = ""

    def __init__(self) -> None:
        self.messages: list[tuple[str, int, int]] = []
        self.finished = False

    def step(self, t: int, inbox: Inbox) -> Outbox:
        return {}

    def record(self, topic: Topic, payload: bytes, stamp: int, sequence: int) -> None:
        self.messages.append((topic.name, stamp, sequence))

    def finish(self) -> Mapping[str, Any]:
        self.finished = True
        return {"kept": len(self.messages)}


def chunk(topic: str, stamp: int, sequence: int) -> bytes:
    writer = ChunkWriter("robot", (topic,))
    writer.add(topic, STATE, stamp, sequence)
    return writer.chunk(50 * MS)


class Bus:
    """Member of a bus on which a conductor sends `commands`, one per poll, and the robot has sent a chunk."""

    role = "recorder"

    def __init__(self, *commands: RunControl) -> None:
        self.contract = contract()
        self.conductor_there = bool(commands)
        self.commands = [codec.encode(command, CONTROL_TYPE) for command in commands]
        self.reports: list[ServiceReport] = []
        self.chunks = Queue(chunk("joint_states", 7 * MS, 8))
        self.there: deque[str] = deque()
        """Return the roles on the bus, one set per call, then none."""

    def internal_subscription(self, name: str, type_name: str) -> Queue:
        if name == "palpate/control":
            return Queue(*self.commands)
        return self.chunks if name == "palpate/record/robot" else Queue()

    def subscription(self, topic: Topic) -> Queue:
        return Queue()

    def internal_publisher(self, name: str, type_name: str, qos: str) -> Any:
        return self

    def put(self, payload: bytes, sequence: int) -> None:
        self.reports.append(codec.decode(payload, "palpation_msgs/msg/ServiceReport"))

    def gone(self) -> frozenset[str]:
        return frozenset() if self.conductor_there else frozenset({"conductor"})

    def alive(self, roles: frozenset[str]) -> frozenset[str]:
        return frozenset({self.there.popleft()} & roles) if self.there else frozenset()

    def transport_lost(self) -> bool:
        return False

    def suspicions(self) -> list[str]:
        return []

    complaints = suspicions


def said(command: int, role: str = "") -> RunControl:
    return RunControl(command, 0, False, role, "")


HELLO, END, ABORT = (said(command) for command in (RunControl.HELLO, RunControl.END, RunControl.ABORT))
FIRST = ("joint_states", 7 * MS, 8)


@pytest.fixture
def kept() -> Kept:
    return Kept()


def run(kept: Kept, member: Any) -> Any:
    RecorderNode(kept, member).run()
    return json.loads(member.reports[-1].detail)


def test_received_messages_are_recorded_and_reported(kept: Kept) -> None:
    member = Bus(HELLO, said(RunControl.HELLO, "camera"), said(RunControl.GRANT), END)
    detail = run(kept, member)
    assert kept.messages == [FIRST]
    states = [report.state for report in member.reports if report.state != ServiceReport.PROGRESS]
    assert states == [ServiceReport.READY, ServiceReport.FINISHED]
    assert (detail["messages"], detail["garbage"], detail["facts"]) == (1, 0, {"kept": 1})


def test_a_lost_role_is_not_waited_for(kept: Kept) -> None:
    member = Bus(HELLO, *(said(RunControl.LOST, role) for role in PRODUCERS if role != "robot"), END)
    run(kept, member)
    assert member.reports[-1].tick == 50 * MS  # tick of the robot, the only remaining role


def test_without_conductor_and_services_the_recording_is_completed(kept: Kept) -> None:
    with pytest.raises(RunAborted):
        run(kept, Bus())
    assert kept.messages == [FIRST]


def test_a_signal_completes_the_recording(kept: Kept) -> None:
    member: Any = Bus(HELLO)
    member.alive = lambda roles: signal.raise_signal(signal.SIGTERM)
    member.conductor_there = False
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            run(kept, member)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert kept.finished
    assert kept.messages == [FIRST]


@pytest.mark.parametrize("command", [END, ABORT], ids=["end", "abort"])
def test_messages_in_transit_at_the_end_are_recorded(kept: Kept, command: RunControl) -> None:
    member: Any = Bus(HELLO, command)
    member.there = deque(["robot", "robot"])
    alive, looks = member.alive, []

    def sends_once_more(roles: frozenset[str]) -> frozenset[str]:
        looks.append(roles)
        if len(looks) == 2:
            member.chunks.waiting.append((2, chunk("joint_states", 57 * MS, 58)))
        return frozenset(alive(roles))

    member.alive = sends_once_more
    with pytest.raises(RunAborted) if command is ABORT else nullcontext():
        run(kept, member)
    assert [stamp for _, stamp, _ in kept.messages] == [7 * MS, 57 * MS]
    assert kept.finished


@pytest.mark.parametrize(
    ("number", "message"),
    [(1, FIRST), (2, ("joint_states", -1, 9)), (2, ("planning/setpoint", 8 * MS, 9))],
    ids=["again", "before the start", "another's topic"],
)
def test_an_invalid_chunk_is_garbage(kept: Kept, number: int, message: tuple[str, int, int]) -> None:
    member = Bus(HELLO, END)
    member.chunks.waiting.append((number, chunk(*message)))
    assert run(kept, member)["garbage"] == 1
    assert kept.messages == [FIRST]
