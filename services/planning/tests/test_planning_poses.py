"""Pose generation: from point and normal to the indenter's pose."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from palpate_planning.strokes.path import angular_velocity, centre, frame, least_twist, pose

coordinate = st.floats(-1.0, 1.0)
vectors = st.tuples(coordinate, coordinate, coordinate).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.05)
units = vectors.map(lambda v: v / np.linalg.norm(v))
rotations = st.tuples(vectors, st.floats(-3.1, 3.1)).map(
    lambda a: Rotation.from_rotvec(a[0] / np.linalg.norm(a[0]) * a[1]).as_matrix()
)


@given(units, rotations)
@settings(deadline=None)
def test_tool_axis_is_opposite_to_the_normal(normal: np.ndarray, R_near: np.ndarray) -> None:
    R = least_twist(-normal, R_near)
    assert R[:, 2] == pytest.approx(-normal, abs=1e-9)
    assert np.abs(R.T @ R - np.eye(3)).max() < 1e-9
    assert np.linalg.det(R) == pytest.approx(1.0)


@pytest.mark.parametrize("tilt", [0.0, 1e-12, 1e-9, 1.2e-7, 1e-6, 4.4e-5, 4.5e-5, 1e-3])
def test_stays_a_rotation_close_to_the_opposite_of_the_reference(tilt: float) -> None:
    R = least_twist(np.array((0.0, -tilt, -1.0)), np.eye(3))
    assert np.abs(R.T @ R - np.eye(3)).max() < 1e-12
    assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-12)


@given(units, rotations)
@settings(deadline=None)
def test_no_other_orientation_with_that_axis_is_nearer(normal: np.ndarray, R_near: np.ndarray) -> None:
    R = least_twist(-normal, R_near)
    turned = [R @ Rotation.from_rotvec((0, 0, a)).as_matrix() for a in (-0.3, -0.05, 0.05, 0.3)]
    assert all(np.trace(R_near.T @ R) >= np.trace(R_near.T @ other) - 1e-9 for other in turned)


@given(units, units, st.floats(0.005, 0.04), st.floats(-0.03, 0.02))
@settings(deadline=None)
def test_deepest_point_lies_at_depth_below_the_surface(p: np.ndarray, n: np.ndarray, radius: float, depth: float) -> None:
    deepest = centre(p, n, radius, depth) - radius * n
    assert deepest == pytest.approx(p - depth * n, abs=1e-12)


@given(st.lists(units, min_size=2, max_size=8), rotations)
@settings(deadline=None)
def test_many_at_once_are_the_same_as_one_by_one(normals: list[np.ndarray], R_ref: np.ndarray) -> None:
    many = least_twist(-np.array(normals), R_ref)
    assert many == pytest.approx(np.array([least_twist(-n, R_ref) for n in normals]), abs=1e-12)


@given(units, vectors, rotations)
@settings(deadline=None)
def test_near_normals_have_near_orientations(normal: np.ndarray, change: np.ndarray, R_ref: np.ndarray) -> None:
    assume(-normal @ R_ref[:, 2] > -0.5)
    other = normal + 0.01 * change
    a, b = least_twist(-normal, R_ref), least_twist(-other, R_ref)
    assert np.abs(a - b).max() < 0.06


@given(rotations, vectors)
@settings(deadline=None)
def test_angular_velocity_turns_one_into_the_other(R: np.ndarray, w: np.ndarray) -> None:
    dt = 0.1
    turned = Rotation.from_rotvec(w * dt).as_matrix() @ R
    assert angular_velocity(R, turned, dt) == pytest.approx(w, abs=1e-6)


def test_pose_is_homogeneous() -> None:
    X = pose(np.eye(3), np.array((1.0, 2.0, 3.0)))
    assert X[3].tolist() == [0, 0, 0, 1]
    assert X[:3, 3].tolist() == [1, 2, 3]


@given(rotations, vectors)
@settings(deadline=None)
def test_a_frame_has_the_given_z_axis_and_keeps_its_x_axis_near(R: np.ndarray, x_near: np.ndarray) -> None:
    z = R[:, 2].copy()
    assume(np.linalg.norm(np.cross(z, x_near)) > 1e-3)
    found = frame(z, x_near)
    assert found[:, 2] == pytest.approx(z, abs=1e-12)
    assert np.abs(found.T @ found - np.eye(3)).max() < 1e-9
    assert np.linalg.det(found) == pytest.approx(1.0)
    assert found[:, 1] @ x_near == pytest.approx(0.0, abs=1e-12)
    assert found[:, 0] @ x_near > 0.0
