"""Rotation matrices and quaternions against scipy's."""

import numpy as np
import pytest
from palpate_models.rotations import quaternion, rotation
from scipy.spatial.transform import Rotation


@pytest.mark.parametrize("size", [0.0, 1e-9, 5e-4, 2e-3, 0.3, 2.0, 3.1])
def test_both_ways_are_as_scipy_has_them(size: float) -> None:
    for direction in np.random.default_rng(1).normal(size=(50, 3)):
        r = size * direction / np.linalg.norm(direction)
        expected = Rotation.from_rotvec(r)
        R = rotation(r.tolist())
        np.testing.assert_allclose(R, expected.as_matrix(), rtol=0, atol=1e-15)
        np.testing.assert_allclose(quaternion(R), expected.as_quat(canonical=True), rtol=0, atol=1e-15)
