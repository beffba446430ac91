"""Tests of the recorder's process and its chunks."""

import json
import signal
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from palpate_bus.contract import Topic, contract
from palpate_bus.messages import MS, JointState, RunControl, ServiceReport, codec, header
from palpate_bus.runtime.conductor_link import CONTROL_TYPE, RunAborted
from palpate_bus.runtime.observer import RecorderNode
from palpate_bus.runtime.output import ChunkMessage, ChunkWriter, unpack_chunk
from palpate_bus.service import Inbox, Outbox, Service
from palpate_bus.wire.transport import ReceivedSample

TOPICS = ("joint_states", "ft/wrench")
messages = st.lists(
    st.builds(ChunkMessage, st.sampled_from(TOPICS), st.binary(max_size=300), st.integers(0, 2**40), st.integers(0, 2**32 - 1)),
    max_size=40,
)


@given(messages)
def test_a_chunk_round_trips(sent: list[ChunkMessage]) -> None:
    spool = ChunkWriter("robot", TOPICS)
    for message in sent:
        spool.add(message.topic, message.payload, message.stamp, message.sequence)
    tick, received = unpack_chunk(spool.chunk(7))
    assert tick == 7
    assert list(received) == sent


PRODUCERS = [name for name, role in contract().roles.items() if not role.observer]
STATE = codec.encode(JointState(header(0), ["a"], np.zeros(1), np.zeros(1), np.zeros(1)), "sensor_msgs/msg/JointState")


class Queue:
    hello_received = True
    garbage = 0

    def __init__(self, *payloads: bytes) -> None:
        self.waiting = deque(enumerate(payloads, 1))

    def get(self, timeout: float | None) -> ReceivedSample | None:
        if not self.waiting:
            return None
        number, payload = self.waiting.popleft()
        return ReceivedSample(number, 0, payload)


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


def test_received_messages_are_recorded_and_reported() -> None:
    kept = Kept()
    member: Any = Bus(said(RunControl.HELLO), said(RunControl.GRANT), said(RunControl.END))
    RecorderNode(kept, member).run()
    assert kept.messages == [("joint_states", 7 * MS, 8)]
    states = [report.state for report in member.reports if report.state != ServiceReport.PROGRESS]
    assert states == [ServiceReport.READY, ServiceReport.FINISHED]
    detail = json.loads(member.reports[-1].detail)
    assert (detail["messages"], detail["garbage"], detail["facts"]) == (1, 0, {"kept": 1})


def test_a_lost_role_is_not_waited_for() -> None:
    lost = [said(RunControl.LOST, role) for role in PRODUCERS if role != "robot"]
    member: Any = Bus(said(RunControl.HELLO), *lost, said(RunControl.END))
    RecorderNode(Kept(), member).run()
    assert member.reports[-1].tick == 50 * MS  # tick of the robot, the only remaining role


def test_without_conductor_and_services_the_recording_is_completed() -> None:
    kept = Kept()
    member: Any = Bus()
    with pytest.raises(RunAborted, match="token is gone"):
        RecorderNode(kept, member).run()
    assert kept.messages == [("joint_states", 7 * MS, 8)]


def test_a_signal_completes_the_recording() -> None:
    kept = Kept()
    member: Any = Bus(said(RunControl.HELLO))
    member.alive = lambda roles: signal.raise_signal(signal.SIGTERM)
    member.conductor_there = False
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            RecorderNode(kept, member).run()
    finally:
        signal.signal(signal.SIGTERM, before)
    assert kept.finished
    assert kept.messages == [("joint_states", 7 * MS, 8)]


@pytest.mark.parametrize("command", [RunControl.END, RunControl.ABORT], ids=["end", "abort"])
def test_messages_in_transit_at_the_end_are_recorded(command: int) -> None:
    kept = Kept()
    member: Any = Bus(said(RunControl.HELLO), said(command))
    member.there = deque(["robot", "robot"])
    alive, looks = member.alive, []

    def sends_once_more(roles: frozenset[str]) -> frozenset[str]:
        looks.append(roles)
        if len(looks) == 2:
            member.chunks.waiting.append((2, chunk("joint_states", 57 * MS, 58)))
        return frozenset(alive(roles))

    member.alive = sends_once_more
    node = RecorderNode(kept, member)
    if command == RunControl.ABORT:
        with pytest.raises(RunAborted):
            node.run()
    else:
        node.run()
    assert [stamp for _, stamp, _ in kept.messages] == [7 * MS, 57 * MS]
    assert kept.finished


@pytest.mark.parametrize(
    "again",
    [(1, ("joint_states", 7 * MS, 8)), (2, ("joint_states", -1, 9)), (2, ("planning/setpoint", 8 * MS, 9))],
    ids=["again", "before the start", "another's topic"],
)
def test_an_invalid_chunk_is_garbage(again: tuple[int, tuple[str, int, int]]) -> None:
    kept = Kept()
    member: Any = Bus(said(RunControl.HELLO), said(RunControl.END))
    number, message = again
    member.chunks.waiting.append((number, chunk(*message)))
    RecorderNode(kept, member).run()
    assert kept.messages == [("joint_states", 7 * MS, 8)]
    assert json.loads(member.reports[-1].detail)["garbage"] == 1
