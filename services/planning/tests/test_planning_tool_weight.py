"""Weight compensation: whatever the orientation, only contact force is left."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from palpate_models.numerics.gravity import GRAVITY
from palpate_models.scenario.schema import Robot
from palpate_planning.contact import ToolWeight


def reading(R_WS: np.ndarray, force_W: np.ndarray, bias: np.ndarray, mass: float, com: np.ndarray) -> np.ndarray:
    """What a sensor reads, written down independently: weight at the centre of mass, contact force at the tip."""
    weight = R_WS.T @ np.array((0, 0, -mass * GRAVITY))
    contact = R_WS.T @ force_W
    torque = np.cross(com, weight) + np.cross((0, 0, 0.1), contact)
    return np.concatenate((weight + contact, torque)) + bias


@given(st.integers(0, 10**6))
@settings(deadline=None)
def test_contact_force_is_found_at_any_orientation(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mass, com = rng.uniform(0.1, 1.5), rng.uniform(-0.05, 0.1, 3)
    tool = ToolWeight(mass)
    bias = rng.normal(0, 1, 6)
    tool.start_tare()
    for R in Rotation.random(3, random_state=rng).as_matrix():
        tool.tare(R, reading(R, np.zeros(3), bias, mass, com))
    assert tool.bias == pytest.approx(bias[:3], abs=1e-9)
    force = rng.normal(0, 5, 3)
    R = Rotation.random(random_state=rng).as_matrix()
    assert tool.contact(R, reading(R, force, bias, mass, com), np.zeros(3)) == pytest.approx(force, abs=1e-9)


def test_acceleration_of_the_tool_is_no_contact() -> None:
    tool = ToolWeight(0.4)
    R = Rotation.from_rotvec((0.3, -0.2, 0.1)).as_matrix()
    a = np.array((0.1, -0.2, 0.5))
    seen = reading(R, -0.4 * a, np.zeros(6), 0.4, np.array((0.0, 0.0, 0.06)))
    assert tool.contact(R, seen, a) == pytest.approx(np.zeros(3), abs=1e-12)
    assert np.linalg.norm(tool.contact(R, seen, np.zeros(3))) > 0.2


def test_taring_averages_noise_out() -> None:
    rng = np.random.default_rng(1)
    tool, com = ToolWeight(0.35), np.array((0.0, 0.0, 0.07))
    tool.start_tare()
    R = np.diag((-1.0, 1.0, -1.0))
    for _ in range(300):
        tool.tare(R, reading(R, np.zeros(3), np.full(6, 0.5), 0.35, com) + rng.normal(0, 0.05, 6))
    assert tool.bias == pytest.approx(np.full(3, 0.5), abs=0.012)


def test_the_mass_comes_from_the_robots_tables() -> None:
    assert ToolWeight.of(Robot(tool_mass_kg=0.5)).mass == pytest.approx(0.5)


def test_taring_anew_forgets_the_old_bias() -> None:
    tool = ToolWeight(0.35)
    for value in (1.0, 2.0):
        tool.start_tare()
        tool.tare(np.eye(3), reading(np.eye(3), np.zeros(3), np.full(6, value), 0.35, np.zeros(3)))
    assert tool.bias == pytest.approx(np.full(3, 2.0))
