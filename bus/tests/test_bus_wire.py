"""rmw_zenoh's wire format: keys, attachments, liveliness tokens."""

from pathlib import Path

import pytest
import zenoh.ext as ze
from hypothesis import given, strategies as st
from waiting import wait_until

from palpate_bus.contract import contract
from palpate_bus.wire import liveliness, rmw as wire
from palpate_bus.wire.liveliness import Endpoint, Entity, EntityKind, GraphWatch, NodeTokens, parse_token
from palpate_bus.wire.zenoh_config import mesh, session

INT64 = st.integers(-(2**63), 2**63 - 1)


@given(sequence=INT64, stamp=INT64, gid=st.binary(min_size=16, max_size=16))
def test_attachment_is_what_zenohs_own_serializer_writes(sequence: int, stamp: int, gid: bytes) -> None:
    packed = wire.AttachmentWriter(gid).pack(sequence, stamp)
    serialised = ze.z_serialize((ze.Int64(sequence), ze.Int64(stamp), [ze.UInt8(byte) for byte in gid]))
    assert packed == serialised.to_bytes()
    assert wire.unpack(packed) == (sequence, stamp, gid)
    assert wire.unpack(memoryview(packed)) == (sequence, stamp, gid)


def test_a_gid_of_another_length_is_refused() -> None:
    with pytest.raises(wire.WireError, match="16 bytes, not 15"):
        wire.AttachmentWriter(bytes(15))
    with pytest.raises(wire.WireError, match="not 15"):
        wire.unpack(bytes(16) + b"\x0f" + bytes(16))


@pytest.mark.parametrize("topic", contract().topics.values(), ids=str)
def test_keys_round_trip(topic: object) -> None:
    key = wire.topic_key(topic, 7)
    parsed = wire.parse_key(key)
    assert (parsed.domain, parsed.topic, parsed.type, parsed.type_hash) == (7, topic.name, topic.type, topic.type_hash)
    assert str(parsed) == key


def test_key_of_design_document() -> None:
    """The example of rmw_zenoh's docs/design.md."""
    expected = "0/chatter/std_msgs::msg::dds_::String_/RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    assert wire.message_key("/chatter", "std_msgs/msg/String", 0) == expected


@pytest.mark.parametrize(
    "name", ["", "String", "std_msgs/String", "std_msgs/msg/", "/msg/A", "Std/msg/A", "a/msg/b/c", "a/xyz/B"]
)
def test_an_invalid_type_name_is_refused(name: str) -> None:
    with pytest.raises(wire.WireError, match="not a ROS type name"):
        wire.dds_type(name)


@pytest.mark.parametrize("domain", [-1, 65536])
def test_an_invalid_domain_is_refused(domain: int) -> None:
    with pytest.raises(wire.WireError, match=r"outside 0\.\.65535"):
        wire.message_key("a", "std_msgs/msg/String", domain)


def test_hellos_have_a_key_of_their_own() -> None:
    """On a topic's key an empty message would be a broken one to every ROS 2 client."""
    key = wire.topic_key(contract().topics["joint_states"], 0)
    hello = wire.hello_key(key)
    assert hello == f"0/palpate/hello/{key.removeprefix('0/')}"
    assert wire.parse_key(hello).type == "sensor_msgs/msg/JointState"


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
