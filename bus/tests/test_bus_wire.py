"""Keys and attachments: as rmw_zenoh writes them, and any garbage is a WireError."""

import struct

import pytest
import zenoh.ext as ze
from hypothesis import given
from hypothesis import strategies as st

from palpate_bus.contract import contract
from palpate_bus.wire import rmw as wire

INT64 = st.integers(-(2**63), 2**63 - 1)


@given(sequence=INT64, stamp=INT64, gid=st.binary(min_size=16, max_size=16))
def test_attachment_is_what_zenohs_own_serializer_writes(sequence: int, stamp: int, gid: bytes) -> None:
    packed = wire.AttachmentWriter(gid).pack(sequence, stamp)
    serialised = ze.z_serialize((ze.Int64(sequence), ze.Int64(stamp), [ze.UInt8(byte) for byte in gid]))
    assert packed == serialised.to_bytes()
    assert wire.unpack(packed) == (sequence, stamp, gid)
    assert wire.unpack(memoryview(packed)) == (sequence, stamp, gid)


@given(st.binary(max_size=80))
def test_garbage_attachments_raise_wire_error_at_most(data: bytes) -> None:
    try:
        sequence, stamp, gid = wire.unpack(data)
    except wire.WireError:
        return
    assert wire.AttachmentWriter(gid).pack(sequence, stamp) == data[: wire.ATTACHMENT_SIZE]


def test_attachment_of_older_rmw_zenoh_is_refused() -> None:
    """Before 0.2.4 the fields were named."""
    old = b"\x0fsequence_number" + struct.pack("<q", 1) + b"\x10source_timestamp" + struct.pack("<q", 2)
    with pytest.raises(wire.WireError, match="33 bytes"):
        wire.unpack(old + b"\x0asource_gid\x10" + bytes(16))


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
def test_what_is_no_type_name_is_refused(name: str) -> None:
    with pytest.raises(wire.WireError, match="not a ROS type name"):
        wire.dds_type(name)


@pytest.mark.parametrize("domain", [-1, 65536])
def test_what_is_no_domain_is_refused(domain: int) -> None:
    with pytest.raises(wire.WireError, match=r"outside 0\.\.65535"):
        wire.message_key("a", "std_msgs/msg/String", domain)


@given(
    st.one_of(
        st.text(max_size=120), st.lists(st.sampled_from(["0", "a", "std_msgs::msg::dds_::String_", "RIHS01_", "%"])).map("/".join)
    )
)
def test_garbage_keys_raise_wire_error_at_most(key: str) -> None:
    try:
        parsed = wire.parse_key(key)
    except wire.WireError:
        return
    assert wire.parse_key(str(parsed)) == parsed


def test_hellos_have_a_key_of_their_own() -> None:
    """On a topic's key an empty message would be a broken one to every ROS 2 client."""
    key = wire.topic_key(contract().topics["joint_states"], 0)
    hello = wire.hello_key(key)
    assert hello == f"0/palpate/hello/{key.removeprefix('0/')}"
    assert wire.parse_key(hello).type == "sensor_msgs/msg/JointState"


def test_any_type_key_meets_topics_whose_definition_differs() -> None:
    import zenoh

    theirs = "3/ft/wrench/geometry_msgs::msg::dds_::Wrench_/RIHS01_" + "0" * 64
    assert zenoh.KeyExpr(wire.any_type_key("ft/wrench", 3)).intersects(theirs)
    assert not zenoh.KeyExpr(wire.any_type_key("wrench", 3)).intersects(theirs)
