"""Compiled rotations against pinocchio's."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from palpate_control.kernel import spd_inverse
from palpate_control.rotations import exp3, jlog3_times, log3

ANGLES = (0.0, 1e-12, 1e-6, 3e-5, 0.9e-4, 1.1e-4, 1e-3, 9.9e-3, 1.01e-2, 0.3, 1.5, 2.9, 3.0, 3.1, np.pi - 1e-6)


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_and_log(angle: float) -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        axis = rng.normal(size=3)
        phi = axis / np.linalg.norm(axis) * angle
        R, back = np.empty((3, 3)), np.empty(3)
        exp3(phi, R)
        np.testing.assert_allclose(R, pin.exp3(phi), atol=2e-15)
        assert log3(R, back) == pytest.approx(angle, abs=1e-9)
        np.testing.assert_allclose(back, phi, rtol=1e-8, atol=1e-9)


def test_jlog_is_the_derivative_of_log() -> None:
    rng = np.random.default_rng(4)
    for angle in (1e-3, 9e-3, 1.1e-2, 0.1, 1.0, 2.5):
        axis, w = rng.normal(size=3), rng.normal(size=3)
        phi = axis / np.linalg.norm(axis) * angle
        step = 1e-6
        slope = (pin.log3(pin.exp3(phi) @ pin.exp3(w * step)) - pin.log3(pin.exp3(phi) @ pin.exp3(-w * step))) / (2 * step)
        jlog3_times(phi, angle, w)
        np.testing.assert_allclose(w, slope, atol=1e-7)


def test_inverse_and_what_has_none() -> None:
    rng = np.random.default_rng(5)
    A = rng.normal(size=(6, 9))
    A = A @ A.T
    out = np.empty((6, 6))
    assert spd_inverse(A, out, 0.0)
    np.testing.assert_allclose(out @ A, np.eye(6), atol=1e-9)
    A[:, 5] = A[5, :] = 0.0
    assert not spd_inverse(A, out, 0.0)
    assert spd_inverse(A, out, 1e-3)
