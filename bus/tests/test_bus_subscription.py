"""Whose messages a subscription takes, and for how long it waits for one."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass
from time import sleep
from typing import Any

import pytest

from palpate_bus.wire.rmw import AttachmentWriter
from palpate_bus.wire.transport import HELLO, Subscription

OURS, STRANGER = b"o" * 16, b"s" * 16


@dataclass
class Bytes:
    held: bytes

    def to_bytes(self) -> bytes:
        return self.held


@dataclass
class Sample:
    attachment: Bytes
    payload: Bytes


class Wire:
    """A subscription, and what comes in on it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, open_to_all: bool = False) -> None:
        session: Any = self
        key = "0/joint_states/sensor_msgs::msg::dds_::JointState_/RIHS01_0"
        self.subscription = Subscription(session, key, decode=bytes if open_to_all else None)
        monkeypatch.setattr(self.subscription, "close", lambda: None)

    def declare_subscriber(self, key: str, handler: Any) -> object:
        return object()

    def bring(self, gid: bytes, sequence: int, payload: bytes = b"data") -> None:
        sample: Any = Sample(Bytes(AttachmentWriter(gid).pack(sequence, 0)), Bytes(payload))
        self.subscription._queue.put(sample)

    def numbers(self) -> list[int]:
        return [sample.sequence for sample in iter(lambda: self.subscription.get(0), None)]


@pytest.fixture
def wire(monkeypatch: pytest.MonkeyPatch) -> Iterator[Wire]:
    yield Wire(monkeypatch)


def test_who_says_hello_is_the_sender_and_not_who_was_there_before(wire: Wire) -> None:
    wire.bring(STRANGER, 4711)
    assert wire.numbers() == [4711]
    wire.bring(OURS, HELLO, b"")
    wire.bring(STRANGER, 4712)
    wire.bring(OURS, 1)
    assert wire.numbers() == [1]
    assert wire.subscription.replaced
    assert wire.subscription.foreign == 1
    assert "second sender" in wire.subscription.suspicion


def test_a_second_hello_changes_nothing(wire: Wire) -> None:
    wire.bring(OURS, HELLO, b"")
    wire.bring(STRANGER, HELLO, b"")
    wire.bring(STRANGER, 1)
    wire.bring(OURS, 1)
    assert wire.numbers() == [1]
    assert wire.subscription.foreign == 2


def test_where_all_may_speak_nobody_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    wire = Wire(monkeypatch, open_to_all=True)
    for gid in (OURS, STRANGER, OURS):
        wire.bring(gid, 1)
    assert wire.numbers() == [1, 1, 1]
    assert not wire.subscription.replaced


def test_what_is_set_aside_wins_no_time(wire: Wire) -> None:
    wire.bring(OURS, HELLO, b"")

    def meddle() -> None:
        for _ in range(100):
            wire.bring(STRANGER, 1)
            sleep(0.01)

    meddler = threading.Thread(target=meddle)
    meddler.start()
    assert wire.subscription.get(0.1) is None
    assert wire.subscription.foreign < 50
    meddler.join()
