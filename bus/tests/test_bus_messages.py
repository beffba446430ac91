"""Messages to arrays and back: geometry, depth images, set-points."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from palpate_bus.contract import contract
from palpate_bus.messages import Image, Quaternion, geometry, header, nanoseconds
from palpate_bus.setpoint import TOPIC, ControlMode, Setpoint


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
