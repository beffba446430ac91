"""Pose generation: from point and normal to the indenter's pose."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from palpate_planning.poses import angular_velocity, centre, least_twist, orientations, pose, quaternion
from scipy.spatial.transform import Rotation

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
def test_orientations_along_a_path_are_carried_without_spin(normals: list[np.ndarray], R0: np.ndarray) -> None:
    out = orientations(np.array(normals), R0)
    assert out[:, :, 2] == pytest.approx(-np.array(normals), abs=1e-9)
    for a, b in pairwise(out):
        between = np.arccos(np.clip(a[:, 2] @ b[:, 2], -1, 1))
        turn = np.arccos(np.clip((np.trace(a.T @ b) - 1) / 2, -1, 1))
        assert turn == pytest.approx(between, abs=1e-4)


@given(rotations)
@settings(deadline=None)
def test_quaternion_agrees_with_scipy(R: np.ndarray) -> None:
    assert Rotation.from_quat(quaternion(R)).as_matrix() == pytest.approx(R, abs=1e-9)
    assert quaternion(R)[3] >= 0


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
