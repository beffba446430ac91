"""Quaternions against scipy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from palpate_models.rotations import quaternion


@pytest.mark.parametrize("size", [0.0, 1e-9, 5e-4, 2e-3, 0.3, 2.0, 3.1])
def test_quaternions_are_as_scipy_has_them(size: float) -> None:
    for direction in np.random.default_rng(1).normal(size=(50, 3)):
        expected = Rotation.from_rotvec(size * direction / np.linalg.norm(direction))
        given = quaternion(expected.as_matrix().tolist())
        np.testing.assert_allclose(given, expected.as_quat(canonical=True), rtol=0, atol=1e-15)
