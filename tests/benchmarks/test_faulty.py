"""What a fault makes of a message."""

from __future__ import annotations

import signal

import numpy as np
import pytest

from palpate_benchmarks.faulty import JUMP_NS, FaultySender, FaultyTransport, InjectedFault
from palpate_bus.contract import contract
from palpate_bus.messages import JointTorqueCommand, codec
from palpate_bus.messages.stamps import NS, duration_message, header, nanoseconds
from palpate_bus.wire.zenoh_config import BusOptions, session

TOPIC = contract().topics["control/joint_torque"]


class Sent:
    def __init__(self) -> None:
        self.messages: list[tuple[int, bytes]] = []

    def put(self, payload: bytes, sequence: int) -> None:
        self.messages.append((sequence, payload))

    def hello(self) -> None:
        self.messages.append((0, b""))

    def close(self) -> None:
        pass


def payload() -> bytes:
    message = JointTorqueCommand(header(7_000_000_000_000), np.arange(7.0), duration_message(50_000_000), "")
    return codec.encode(message, TOPIC.type)


def sent(kind: str, count: int = 1, messages: int = 5) -> list[tuple[int, bytes]]:
    out = Sent()
    sender = FaultySender(out, TOPIC, InjectedFault(TOPIC.name, kind, count, at=2_000_000), lambda: False)
    for sequence in range(1, messages + 1):
        sender.put(payload(), sequence)
    return out.messages


def test_it_begins_at_its_time_and_hits_as_many_as_it_should() -> None:
    assert [sequence for sequence, _ in sent("drop")] == [1, 2, 4, 5]
    assert [sequence for sequence, _ in sent("drop", count=0)] == [1, 2]
    assert [sequence for sequence, _ in sent("duplicate")] == [1, 2, 3, 3, 4, 5]


def test_nan_is_in_every_float_and_nowhere_else() -> None:
    message = codec.decode(sent("nan")[2][1], TOPIC.type)
    assert np.isnan(message.torque).all()
    assert nanoseconds(message.valid_for) == 50_000_000
    assert not np.isnan(codec.decode(sent("nan")[3][1], TOPIC.type).torque).any()


def test_stamp_is_an_hour_ago() -> None:
    message = codec.decode(sent("stamp")[2][1], TOPIC.type)
    assert nanoseconds(message.header.stamp) == 7_000_000_000_000 - 3_600_000_000_000


def test_corrupt_changes_bytes_and_truncate_takes_them() -> None:
    assert len(sent("corrupt")[2][1]) == len(payload()) and sent("corrupt")[2][1] != payload()
    with pytest.raises(codec.CodecError):
        codec.decode(sent("truncate")[2][1], TOPIC.type)


def test_a_transport_is_faulty_in_its_topic_only_and_from_the_signal_on() -> None:
    qos = contract().qos["control"]
    with session(BusOptions()) as opened:
        transport = FaultyTransport(opened, InjectedFault(TOPIC.name, "nan", at=0))
        assert isinstance(transport.publisher(TOPIC.name, "a", qos, bytes(16)), FaultySender)
        assert not isinstance(transport.publisher("joint_states", "b", qos, bytes(16)), FaultySender)
        late = FaultyTransport(opened, InjectedFault("clock", "jump"))
        before = late.now()
        assert before < late.now() < before + NS
        signal.raise_signal(signal.SIGUSR1)
        assert JUMP_NS <= late.now() - before < 2 * JUMP_NS


@pytest.mark.parametrize(
    ("topic", "kind", "at", "allowed"),
    [
        ("joint_states", "melt", None, "duplicate"),
        ("joint_stakes", "nan", None, "joint_states"),
        ("joint_states", "jump", None, "clock"),
        ("exam/findings", "nan", 0, "joint_states"),
    ],
)
def test_a_fault_that_is_none_says_what_is_allowed(topic: str, kind: str, at: int | None, allowed: str) -> None:
    with pytest.raises(ValueError, match=allowed):
        InjectedFault(topic, kind, at=at)
