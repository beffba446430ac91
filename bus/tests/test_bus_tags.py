"""Keyed tags: whose key is another, or whose message was changed, is found out; what ROS 2 reads stays as it was."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate_bus.contract import contract
from palpate_bus.settings import BusConfigError
from palpate_bus.wire import rmw
from palpate_bus.wire.tags import KEY_SIZE, TAG_SIZE, Tagger, make_key, read_key

KEY = bytes(range(KEY_SIZE))
ATTACHMENT = rmw.AttachmentWriter(b"g" * 16).pack(7, 8)


@given(payload=st.binary(max_size=300), at=st.integers(0), flip=st.integers(1, 255))
def test_any_changed_byte_is_found_out(payload: bytes, at: int, flip: int) -> None:
    tagger = Tagger(KEY, "0/a")
    whole = bytearray(ATTACHMENT + tagger.tag(ATTACHMENT, payload) + payload)
    size = len(ATTACHMENT) + TAG_SIZE
    assert tagger.holds(bytes(whole[:size]), payload)
    whole[at % len(whole)] ^= flip
    assert not tagger.holds(bytes(whole[:size]), bytes(whole[size:]))


def test_another_key_or_another_topic_makes_another_tag() -> None:
    tag = Tagger(KEY, "0/a").tag(ATTACHMENT, b"x")
    assert not Tagger(KEY, "0/b").holds(ATTACHMENT + tag, b"x")
    assert not Tagger(KEY[::-1], "0/a").holds(ATTACHMENT + tag, b"x")
    assert not Tagger(KEY, "0/a").holds(ATTACHMENT, b"x")


def test_what_ros_2_reads_of_the_attachment_stays_as_it_is() -> None:
    tagged = ATTACHMENT + Tagger(KEY, "0/a").tag(ATTACHMENT, b"x")
    assert rmw.unpack(tagged) == rmw.unpack(ATTACHMENT)


def test_a_key_is_its_owners_alone(tmp_path: Path) -> None:
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


def test_who_moves_the_arm_or_conducts_is_tagged() -> None:
    rules = contract()
    for name in ("control/joint_torque", "planning/setpoint", "supervisor/state", "palpate/control", "palpate/report/robot"):
        assert rules.tagged(name)
    assert not rules.tagged("operator/request"), "anyone may ask for a stop, ROS 2 too"
    assert not rules.tagged("palpate/record/robot")
    assert not rules.tagged("nothing")
