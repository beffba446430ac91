"""What a fault makes of a message."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from palpate_bus.contract import contract
from palpate_bus.messages import JointTorqueCommand, codec
from palpate_bus.messages.stamps import duration_message, header, nanoseconds
from palpate_bus.runtime import faults
from palpate_bus.runtime.faults import Fault, FaultError, FaultySender, faulty

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
    sender = FaultySender(out, TOPIC, Fault(TOPIC.name, kind, at=2_000_000, count=count), None)
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


def test_without_the_variable_nothing_is_wrapped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PALPATE_FAULT", raising=False)
    sender: Any = Sent()
    assert faulty(sender, TOPIC) is sender
    monkeypatch.setenv("PALPATE_FAULT", "joint_states:nan")
    monkeypatch.setenv("PALPATE_FAULT_AT", "1.5")
    assert faulty(sender, TOPIC) is sender, "another topic's fault"
    monkeypatch.setenv("PALPATE_FAULT", f"{TOPIC.name}:nan")
    assert isinstance(faulty(sender, TOPIC), FaultySender)


@pytest.mark.parametrize("text", ["nan", "joint_states:melt", ":nan"])
def test_a_fault_that_is_none_says_what_is_allowed(text: str) -> None:
    with pytest.raises(FaultError, match="duplicate"):
        Fault.from_env({"PALPATE_FAULT": text})
    assert set(faults.CHANGES) < set(faults.KINDS)
