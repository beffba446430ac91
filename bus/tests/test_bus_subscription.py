"""rmw_zenoh's wire format, subscriptions and authentication tags."""

import threading
from pathlib import Path
from time import sleep, time_ns
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh.ext as ze
from hypothesis import given, strategies as st
from waiting import wait_until
from zenoh import ZBytes

from palpate_bus.contract import contract
from palpate_bus.messages import OperatorRequest, codec, header
from palpate_bus.settings import BusConfigError
from palpate_bus.wire import liveliness, rmw
from palpate_bus.wire.liveliness import Endpoint, Entity, EntityKind, GraphWatch, NodeTokens, parse_token
from palpate_bus.wire.rmw import KEY_SIZE, TAG_SIZE, AttachmentWriter, Tagger, make_key, read_key
from palpate_bus.wire.transport import HELLO, Subscription, TagCheck
from palpate_bus.wire.zenoh_config import mesh, session

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


INT64 = st.integers(-(2**63), 2**63 - 1)


@given(sequence=INT64, stamp=INT64, gid=st.binary(min_size=16, max_size=16))
def test_attachment_is_what_zenohs_own_serializer_writes(sequence: int, stamp: int, gid: bytes) -> None:
    packed = rmw.AttachmentWriter(gid).pack(sequence, stamp)
    serialised = ze.z_serialize((ze.Int64(sequence), ze.Int64(stamp), [ze.UInt8(byte) for byte in gid]))
    assert packed == serialised.to_bytes()
    assert rmw.unpack(packed) == (sequence, stamp, gid)
    assert rmw.unpack(memoryview(packed)) == (sequence, stamp, gid)


def test_a_gid_of_another_length_is_refused() -> None:
    with pytest.raises(rmw.WireError, match="16 bytes, not 15"):
        rmw.AttachmentWriter(bytes(15))
    with pytest.raises(rmw.WireError, match="not 15"):
        rmw.unpack(bytes(16) + b"\x0f" + bytes(16))


@pytest.mark.parametrize("topic", contract().topics.values(), ids=str)
def test_keys_round_trip(topic: object) -> None:
    key = rmw.topic_key(topic, 7)
    parsed = rmw.parse_key(key)
    assert (parsed.domain, parsed.topic, parsed.type, parsed.type_hash) == (7, topic.name, topic.type, topic.type_hash)
    assert str(parsed) == key


def test_key_of_design_document() -> None:
    """The example of rmw_zenoh's docs/design.md."""
    expected = "0/chatter/std_msgs::msg::dds_::String_/RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    assert rmw.message_key("/chatter", "std_msgs/msg/String", 0) == expected


@pytest.mark.parametrize(
    "name", ["", "String", "std_msgs/String", "std_msgs/msg/", "/msg/A", "Std/msg/A", "a/msg/b/c", "a/xyz/B"]
)
def test_an_invalid_type_name_is_refused(name: str) -> None:
    with pytest.raises(rmw.WireError, match="not a ROS type name"):
        rmw.dds_type(name)


@pytest.mark.parametrize("domain", [-1, 65536])
def test_an_invalid_domain_is_refused(domain: int) -> None:
    with pytest.raises(rmw.WireError, match=r"outside 0\.\.65535"):
        rmw.message_key("a", "std_msgs/msg/String", domain)


def test_hellos_have_a_key_of_their_own() -> None:
    """On a topic's key an empty message would be a broken one to every ROS 2 client."""
    key = rmw.topic_key(contract().topics["joint_states"], 0)
    hello = rmw.hello_key(key)
    assert hello == f"0/palpate/hello/{key.removeprefix('0/')}"
    assert rmw.parse_key(hello).type == "sensor_msgs/msg/JointState"


# From rmw_zenoh's docs/design.md.
LISTENER = "@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
TALKER = (
    "@ros2_lv/0/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/"
    "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18/::,7:,:,:,,"
)
RULES = contract()


def test_tokens_of_the_design_document() -> None:
    listener, talker = parse_token(LISTENER), parse_token(TALKER)
    assert (listener.token, talker.token) == (LISTENER, TALKER)
    assert (listener.kind, listener.node, listener.namespace, listener.endpoint) == (EntityKind.NODE, "listener", "/", None)
    assert (talker.domain, talker.node_id, talker.entity_id, talker.kind) == (0, 0, 10, EntityKind.PUBLISHER)
    assert talker.endpoint is not None
    assert (talker.endpoint.topic, talker.endpoint.type) == ("chatter", "std_msgs/msg/String")
    qos = RULES.qos["control"].model_copy(update={"depth": 7})
    assert liveliness.qos_token(qos) == talker.endpoint.qos


def test_gid_is_xxh3_of_the_token_low_half_first() -> None:
    # XXH3-128 of the empty string is 99aa06d3014798d86001c324468d497f (high half first), xxHash's own sanity value.
    assert liveliness.gid("") == bytes.fromhex("99aa06d3014798d86001c324468d497f")[::-1]
    assert parse_token(TALKER).gid == liveliness.gid(TALKER) != parse_token(LISTENER).gid


def test_a_different_definition_is_named_with_both_sides() -> None:
    def entity(kind: EntityKind, node: str, type_hash: str) -> Entity:
        return Entity(0, "a", 0, 1, kind, node, endpoint=Endpoint("ft/wrench", "geometry_msgs/msg/WrenchStamped", type_hash, ""))

    same = [entity(EntityKind.PUBLISHER, "robot", "RIHS01_1"), entity(EntityKind.SUBSCRIPTION, "planning", "RIHS01_1")]
    assert liveliness.mismatches(same) == []
    (sentence,) = liveliness.mismatches([*same, entity(EntityKind.SUBSCRIPTION, "viewer", "RIHS01_2")])
    for part in ("ft/wrench", "robot", "viewer", "RIHS01_1", "RIHS01_2"):
        assert part in sentence


def test_watch_sees_roles_come_and_go_and_late_joiners_see_all(tmp_path: Path) -> None:
    options = mesh(["robot", "control"], tmp_path, lowlatency=("robot", "control"))
    topic = RULES.topics["joint_states"]
    with session(options["control"]) as watching:
        watch = GraphWatch(watching, domain=5)
        with session(options["robot"]) as robot:
            tokens = NodeTokens(robot, "robot", domain=5)
            publisher_gid = tokens.publisher(topic, RULES.qos[topic.qos])
            seen = []
            assert wait_until(lambda: bool(seen.extend(watch.changes()) or len(watch.alive) == 2))
            assert all(appeared for _, appeared in seen)
            assert watch.roles() == {"robot"}
            assert publisher_gid in {entity.gid for entity in watch.alive.values()}
            late = GraphWatch(watching, domain=5)
            assert wait_until(lambda: bool(seen.extend(late.changes()) or len(late.alive) == 2))
            assert {entity.kind for entity in late.alive.values()} == {EntityKind.NODE, EntityKind.PUBLISHER}
            NodeTokens(robot, "elsewhere", domain=6)
        assert wait_until(lambda: bool(seen.extend(watch.changes()) or watch.gone() == {"robot"}))
        assert watch.roles() == frozenset()
        watch.close()
