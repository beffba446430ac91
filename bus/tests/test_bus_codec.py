"""The codec: the bytes are those of rosbags, every message survives the round trip, and no bytes do worse than a CodecError."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from message_strategies import messages
from message_stubs import CODES_STUB, STUB, codes_stub, stub
from toy_services import torque_command

from palpate_bus.contract import contract
from palpate_bus.messages import Advance, JointState, codec, duration_message, header
from palpate_bus.messages.typestore import palpation_definitions

TYPES = sorted(
    {row.type for row in contract().topics.values()}
    | {row.type for row in contract().internal.values()}
    | set(palpation_definitions())
    # Shapes that our rows do not have: arrays of messages and of strings, bytes, eight-byte numbers behind one-byte ones.
    | {"visualization_msgs/msg/Marker", "std_msgs/msg/ByteMultiArray", "sensor_msgs/msg/BatteryState", "std_msgs/msg/Char"}
    | {"shape_msgs/msg/SolidPrimitive", "trajectory_msgs/msg/JointTrajectory", "geometry_msgs/msg/PolygonStamped"}
    | {"std_msgs/msg/Empty", "std_msgs/msg/Int64MultiArray", "rcl_interfaces/msg/ParameterValue"}
)
FAST = settings(max_examples=15, suppress_health_check=[HealthCheck.too_slow])


@pytest.mark.parametrize("name", TYPES)
@FAST
@given(data=st.data())
def test_bytes_are_those_of_rosbags_and_decode_to_the_same_message(name: str, data: st.DataObject) -> None:
    message = data.draw(messages(name))
    expected = bytes(codec.store.serialize_cdr(message, name))
    encoded = codec.encode(message, name)
    assert encoded == expected
    decoded = codec.decode(encoded, name)
    assert type(decoded) is codec.message_type(name)
    assert bytes(codec.store.serialize_cdr(decoded, name)) == expected
    assert codec.encode(decoded, name) == expected
    passed = codec.passer(name)(message)
    assert passed is None or codec.encode(passed, name) == expected
    # Others may send big-endian.
    big = bytes(codec.store.serialize_cdr(message, name, little_endian=False))
    assert codec.encode(codec.decode(big, name), name) == expected


@pytest.mark.parametrize("length", [2**31, 2**32 - 1])
@pytest.mark.parametrize(
    "name", ["palpation_msgs/msg/SurfaceMesh", "tf2_msgs/msg/TFMessage", "diagnostic_msgs/msg/DiagnosticStatus"]
)
def test_a_length_bomb_allocates_nothing(name: str, length: int) -> None:
    import tracemalloc

    bomb = b"\x00\x01\x00\x00" + length.to_bytes(4, "little") * 400
    tracemalloc.start()
    with pytest.raises(codec.CodecError):
        codec.decode(bomb, name)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1_000_000


def test_trailing_padding_is_accepted_and_trailing_data_is_not() -> None:
    joints = JointState(header(5), [], np.zeros(0), np.zeros(0), np.zeros(0))
    advance = Advance(5, np.zeros(1, np.uint32))
    for message, name in ((joints, "sensor_msgs/msg/JointState"), (advance, "palpation_msgs/msg/Advance")):
        payload = codec.encode(message, name)
        assert codec.encode(codec.decode(payload + b"\0\0\0", name), name) == payload
        with pytest.raises(codec.CodecError, match=f"{name}: cannot decode {len(payload) + 4} bytes: "):
            codec.decode(payload + bytes(4), name)


TORQUE = "palpation_msgs/msg/JointTorqueCommand"


def encoded(torque: object) -> bytes:
    return codec.encode(torque_command(0, torque), TORQUE)


@pytest.mark.parametrize(
    ("torque", "reason"),
    [
        (np.zeros((2, 3)), "torque: has shape"),
        (np.array(["a"] * 7), "torque: has"),
        (np.zeros(7, complex), "torque: has complex128"),
        (None, "torque: has object"),
    ],
)
def test_a_field_that_does_not_fit_is_named(torque: object, reason: str) -> None:
    with pytest.raises(codec.CodecError, match=f"{TORQUE}.*{reason}"):
        encoded(torque)


@pytest.mark.parametrize(
    "torque", [list(range(7)), np.arange(7), np.arange(7, dtype=np.float32), np.arange(14.0)[::2] / 2, np.arange(7, dtype=">f8")]
)
def test_numbers_of_another_kind_or_layout_are_converted(torque: object) -> None:
    np.testing.assert_array_equal(codec.decode(encoded(torque), TORQUE).torque, np.arange(7.0))


def test_arrays_within_a_sequence_of_messages_are_converted() -> None:
    name = "trajectory_msgs/msg/JointTrajectory"
    point = codec.message_type("trajectory_msgs/msg/JointTrajectoryPoint")
    empty = np.zeros(0)
    trajectory = codec.message_type(name)(header(0), ["a"], [point(np.arange(3), empty, empty, empty, duration_message(0))])
    np.testing.assert_array_equal(codec.decode(codec.encode(trajectory, name), name).points[0].positions, np.arange(3.0))
    trajectory.points[0].positions = np.zeros(3, complex)
    with pytest.raises(codec.CodecError, match=r"points\.positions: has complex128"):
        codec.encode(trajectory, name)


def test_readers_in_the_process_do_not_share_arrays_and_lists_with_the_sender() -> None:
    names, zeros = ["a"], np.zeros(1)
    passed = codec.passer("sensor_msgs/msg/JointState")(JointState(header(0), names, zeros, zeros, zeros))
    names[0], zeros[0] = "b", 1.0
    assert passed.name == ["a"]
    assert passed.position.tolist() == [0.0]
    assert not passed.position.flags.writeable


def test_unknown_type_is_named() -> None:
    for call in (lambda: codec.encoder("no/msg/Such"), lambda: codec.decode(b"", "no/msg/Such"), lambda: codec.type_hash("x")):
        with pytest.raises(codec.CodecError, match="no such message type"):
            call()


def test_type_stubs_are_those_of_the_definitions() -> None:
    assert STUB.read_text(encoding="utf-8") == stub(), "run python bus/tests/message_stubs.py"
    assert CODES_STUB.read_text(encoding="utf-8") == codes_stub(), "run python bus/tests/message_stubs.py"
