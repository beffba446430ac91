"""Poses, twists and wrenches of messages to arrays and back; rotations against scipy's."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from palpate_bus.messages import Quaternion
from palpate_bus.messages.geometry import (
    pose_matrix,
    pose_message,
    quaternion,
    rotation,
    transform_matrix,
    transform_message,
    twist,
    twist_message,
    wrench,
    wrench_message,
)


@pytest.mark.parametrize("size", [0.0, 1e-9, 5e-4, 2e-3, 0.3, 2.0, 3.1])
def test_rotations_are_as_scipy_has_them(size: float) -> None:
    for direction in np.random.default_rng(1).normal(size=(50, 3)):
        expected = Rotation.from_rotvec(size * direction / np.linalg.norm(direction))
        given = quaternion(expected.as_matrix())
        np.testing.assert_allclose(given, expected.as_quat(canonical=True), rtol=0, atol=1e-15)
        np.testing.assert_allclose(rotation(Quaternion(*given)), expected.as_matrix(), rtol=0, atol=1e-15)


def test_messages_come_back_as_the_same_arrays() -> None:
    X = np.eye(4)
    X[:3, :3] = Rotation.from_rotvec((0.3, -0.8, 1.9)).as_matrix()
    X[:3, 3] = 1.0, 2.0, 3.0
    six = np.arange(6.0)
    np.testing.assert_allclose(transform_matrix(transform_message(X)), X, atol=1e-15)
    np.testing.assert_allclose(pose_matrix(pose_message(X[:3, :3], X[:3, 3])), X, atol=1e-15)
    assert np.array_equal(twist(twist_message(six)), six)
    assert np.array_equal(wrench(wrench_message(six)), six)


@pytest.mark.parametrize("orientation", [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.02), (float("nan"), 0.0, 0.0, 1.0)])
def test_an_orientation_that_is_no_rotation_is_refused(orientation: tuple[float, float, float, float]) -> None:
    with pytest.raises(ValueError, match="must be 1"):
        rotation(Quaternion(*orientation))
