"""The codec, whose bytes are those of rosbags, and messages to arrays and back."""

from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from message_strategies import messages
from message_stubs import CODES_STUB, STUB, codes_stub, stub
from scipy.spatial.transform import Rotation
from toy_services import torque_command

from palpate_bus.contract import contract
from palpate_bus.messages import Advance, Image, JointState, Quaternion, codec, duration_message, geometry, header, nanoseconds
from palpate_bus.messages.typestore import palpation_definitions
from palpate_bus.setpoint import TOPIC, ControlMode, Setpoint

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


@pytest.mark.parametrize("size", [0.0, 1e-9, 5e-4, 2e-3, 0.3, 2.0, 3.1])
def test_rotations_match_scipy(size: float) -> None:
    for direction in np.random.default_rng(1).normal(size=(50, 3)):
        expected = Rotation.from_rotvec(size * direction / np.linalg.norm(direction))
        given = geometry.quaternion(expected.as_matrix())
        np.testing.assert_allclose(given, expected.as_quat(canonical=True), rtol=0, atol=1e-15)
        np.testing.assert_allclose(geometry.rotation(Quaternion(*given)), expected.as_matrix(), rtol=0, atol=1e-15)


def test_arrays_survive_a_round_trip() -> None:
    X = np.eye(4)
    X[:3, :3] = Rotation.from_rotvec((0.3, -0.8, 1.9)).as_matrix()
    X[:3, 3] = 1.0, 2.0, 3.0
    six = np.arange(6.0)
    np.testing.assert_allclose(geometry.transform_matrix(geometry.transform_message(X)), X, atol=1e-15)
    np.testing.assert_allclose(geometry.pose_matrix(geometry.pose_message(X[:3, :3], X[:3, 3])), X, atol=1e-15)
    assert np.array_equal(geometry.twist(geometry.twist_message(six)), six)
    assert np.array_equal(geometry.wrench(geometry.wrench_message(six)), six)
    points = np.arange(6.0).reshape(2, 3)
    assert np.array_equal(geometry.vectors([geometry.point_message(points[0]), geometry.vector_message(points[1])]), points)
    assert geometry.vectors([]).shape == (0, 3)
    depth = geometry.depth_message(header(0), METRES)
    np.testing.assert_array_equal(geometry.depth_in_metres("camera", depth), METRES)


def test_meshes_survive_a_round_trip_and_missing_arrays_are_empty() -> None:
    vertices = np.arange(9.0).reshape(3, 3)
    mesh = geometry.mesh_message(header(5, "world"), vertices, -vertices, [[0, 1, 2]], [0.0, 0.5, 1.0])
    expected = (vertices, -vertices, [[0, 1, 2]], [0.0, 0.5, 1.0])
    assert all(np.array_equal(found, wanted) for found, wanted in zip(geometry.mesh_arrays(mesh), expected, strict=True))
    bare = geometry.mesh_arrays(geometry.mesh_message(header(5), vertices))
    assert [array.shape for array in bare] == [(3, 3), (0, 3), (0, 3), (0,)]


@pytest.mark.parametrize("orientation", [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.02), (float("nan"), 0.0, 0.0, 1.0)])
def test_rotation_rejects_a_quaternion_that_is_not_a_unit(orientation: tuple[float, float, float, float]) -> None:
    with pytest.raises(ValueError, match="must be 1"):
        geometry.rotation(Quaternion(*orientation))


METRES = np.array([[1.0, np.nan, 0.731], [0.5, 2.25, np.nan]], np.float32)


def image(encoding: str, pixels: np.ndarray, big_endian: bool, padding: int) -> Any:
    rows = np.zeros((2, 3 * pixels.itemsize + padding), np.uint8)
    rows[:, : 3 * pixels.itemsize] = pixels.view(np.uint8).reshape(2, -1)
    return Image(header(0, "c"), 2, 3, encoding, int(big_endian), rows.shape[1], rows.ravel())


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize("encoding", ["32FC1", "16UC1", "mono16"])
def test_depth_is_in_metres_and_nan_where_invalid(encoding: str, big_endian: bool, padding: int) -> None:
    order = ">" if big_endian else "<"
    millimetres = np.nan_to_num(1000 * METRES).round().astype(f"{order}u2")
    pixels = METRES.astype(f"{order}f4") if encoding == "32FC1" else millimetres
    found = geometry.depth_in_metres("camera", image(encoding, pixels, big_endian, padding))
    np.testing.assert_allclose(found, METRES, rtol=1e-6)


@pytest.mark.parametrize(
    ("encoding", "invalid"),
    [
        *(("32FC1", value) for value in (0.0, -1.0, np.inf, -np.inf, np.nan, 65.535, 65535.0)),
        *((encoding, value) for encoding in ("16UC1", "mono16") for value in (0, 65535)),
    ],
)
def test_what_is_not_a_measurement_is_nan(encoding: str, invalid: float) -> None:
    pixels = METRES.copy() if encoding == "32FC1" else np.nan_to_num(1000 * METRES).round().astype("<u2")
    pixels[0, 0] = invalid
    depth = geometry.depth_in_metres("camera", image(encoding, pixels, False, 0))
    assert np.isnan(depth[0, 0])
    assert depth[1, 1] == 2.25


def test_a_set_point_survives_its_message() -> None:
    rng = np.random.default_rng(1)
    sizes = {"p_WD": 3, "V_WD": 6, "F_W": 6, "stiffness": 6, "damping_ratio": 6, "q": 7, "qd": 7, "joint_stiffness": 7}
    arrays: dict[str, Any] = {name: rng.uniform(-10, 10, size) for name, size in sizes.items()}
    arrays["R_WD"] = Rotation.from_rotvec((0.3, -2.0, 0.9)).as_matrix()
    message = Setpoint(stamp=1_234_567_890, mode=ControlMode.CARTESIAN, **arrays).message()
    after = Setpoint.from_message(message)
    assert (after.stamp, after.mode) == (1_234_567_890, ControlMode.CARTESIAN)
    for name, array in arrays.items():
        np.testing.assert_allclose(getattr(after, name), array, atol=1e-14, err_msg=name)
    assert nanoseconds(message.valid_for) == contract().topics[TOPIC].expiry
