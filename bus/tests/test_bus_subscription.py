"""Subscriptions and authentication tags."""

import threading
from pathlib import Path
from time import sleep, time_ns
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given, strategies as st
from zenoh import ZBytes

from palpate_bus.contract import contract
from palpate_bus.messages import OperatorRequest, codec, header
from palpate_bus.settings import BusConfigError
from palpate_bus.wire import rmw
from palpate_bus.wire.rmw import KEY_SIZE, TAG_SIZE, AttachmentWriter, Tagger, make_key, read_key
from palpate_bus.wire.transport import HELLO, Subscription, TagCheck

KEY = bytes(range(KEY_SIZE))
ATTACHMENT = rmw.AttachmentWriter(b"g" * 16).pack(7, 8)


@given(payload=st.binary(max_size=300), at=st.integers(0), flip=st.integers(1, 255))
def test_a_tag_detects_any_changed_byte(payload: bytes, at: int, flip: int) -> None:
    tagger = Tagger(KEY, "0/a")
    whole = bytearray(ATTACHMENT + tagger.tag(ATTACHMENT, payload) + payload)
    size = len(ATTACHMENT) + TAG_SIZE
    assert tagger.holds(bytes(whole[:size]), payload)
    whole[at % len(whole)] ^= flip
    assert not tagger.holds(bytes(whole[:size]), bytes(whole[size:]))


def test_a_tag_depends_on_key_and_topic() -> None:
    tag = Tagger(KEY, "0/a").tag(ATTACHMENT, b"x")
    assert not Tagger(KEY, "0/b").holds(ATTACHMENT + tag, b"x")
    assert not Tagger(KEY[::-1], "0/a").holds(ATTACHMENT + tag, b"x")
    assert not Tagger(KEY, "0/a").holds(ATTACHMENT, b"x")


def test_a_key_is_readable_to_its_owner_only(tmp_path: Path) -> None:
    file = make_key(tmp_path / "run.key")
    assert file.stat().st_mode & 0o777 == 0o600
    assert len(read_key(file) or b"") == KEY_SIZE
    assert read_key(None) is None
    with pytest.raises(FileExistsError):
        make_key(file)
    file.chmod(0o644)
    with pytest.raises(BusConfigError, match=r"others may read it \(mode 0644\); allowed is 0600"):
        read_key(file)
    file.chmod(0o600)
    file.write_bytes(b"short")
    with pytest.raises(BusConfigError, match="has 5 bytes"):
        read_key(file)
    with pytest.raises(BusConfigError, match="cannot be read"):
        read_key(tmp_path / "none")


def test_messages_that_move_the_arm_or_conduct_are_tagged() -> None:
    moving = ("control/joint_torque", "planning/setpoint", "supervisor/state", "operator/request")
    assert all(contract().tagged(name) for name in (*moving, "palpate/control", "palpate/report/robot"))
    assert not any(contract().tagged(name) for name in ("palpate/record/robot", "nothing"))


OURS, STRANGER = b"o" * 16, b"s" * 16


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
        attachment = AttachmentWriter(gid).pack(sequence, 0)
        sample: Any = SimpleNamespace(attachment=ZBytes(attachment), payload=ZBytes(payload))
        self.subscription._queue.put(sample)

    def numbers(self) -> list[int]:
        return [sample.sequence for sample in iter(lambda: self.subscription.get(0), None)]


@pytest.fixture
def wire(monkeypatch: pytest.MonkeyPatch) -> Wire:
    return Wire(monkeypatch)


def test_the_sender_of_the_hello_replaces_an_earlier_one(wire: Wire) -> None:
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


def test_on_an_open_topic_no_sender_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    wire = Wire(monkeypatch, open_to_all=True)
    for gid in (OURS, STRANGER, OURS):
        wire.bring(gid, 1)
    assert wire.numbers() == [1, 1, 1]
    assert not wire.subscription.replaced


def test_dropped_messages_do_not_extend_the_timeout(wire: Wire) -> None:
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


@pytest.mark.parametrize(("request_", "obeyed"), [("STOP", True), ("SOFT_STOP", True), ("RELEASE", False), ("END", False)])
def test_only_holders_of_the_key_move_the_arm_and_anyone_stops_it(request_: str, obeyed: bool) -> None:
    topic = contract().topics["operator/request"]
    tagger = Tagger(KEY, "0/a")
    check = TagCheck(tagger, topic)
    payload = codec.encode(OperatorRequest(header(0), getattr(OperatorRequest, request_), ""), topic.type)
    tagged = ATTACHMENT + tagger.tag(ATTACHMENT, payload)
    now = time_ns()
    assert check.is_valid(ATTACHMENT, now, payload) is obeyed
    assert check.is_valid(tagged, now, payload)
    assert check.is_valid(tagged, now, payload) is obeyed, "replayed"
