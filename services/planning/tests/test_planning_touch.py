"""Tests of the skin's depth from depth and force of a slow descent."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate_planning.wall.touch import FELT_N, TUNING, Onset, find_touch


def descent(onset: float, stiffness: float, exponent: float, bias: float, noise: float, seed: int = 0) -> np.ndarray:
    """Rows of depth [m] and force [N] every 0.14 mm, until contact is detected; `stiffness` [N] at 4 mm."""
    depth = np.arange(onset - 0.008, onset + 0.016, 0.00014)
    force = stiffness * (np.maximum(depth - onset, 0.0) / 0.004) ** exponent
    force = force + bias + noise * np.random.default_rng(seed).standard_normal(len(depth))
    return np.column_stack((depth, force))[: int(np.argmax(force >= FELT_N)) + 1]


@given(st.floats(-0.02, 0.02), st.floats(0.6, 4.0), st.floats(1.2, 1.45), st.floats(-0.1, 0.1), st.integers(0, 1000))
@settings(deadline=None)
def test_the_skin_is_found_within_its_uncertainty(
    onset: float, stiffness: float, exponent: float, bias: float, seed: int
) -> None:
    touch = find_touch(descent(onset, stiffness, exponent, bias, 0.03, seed))
    assert abs(touch.depth - onset) < 4 * touch.sigma
    assert touch.sigma < 0.0012


@given(st.floats(0.2, 0.6), st.floats(1.2, 1.45), st.integers(0, 1000))
@settings(deadline=None)
def test_on_a_soft_wall_the_air_above_the_skin_is_kept(stiffness: float, exponent: float, seed: int) -> None:
    touch = find_touch(descent(0.0, stiffness, exponent, 0.05, 0.03, seed))
    assert abs(touch.depth) < 0.0015
    assert abs(touch.depth) < 4 * touch.sigma


def test_the_law_itself_is_found_exactly() -> None:
    touch = find_touch(descent(0.003, 1.5, 1.3, 0.05, 0.0))
    assert touch.depth == pytest.approx(0.003, abs=1e-5)


def test_on_bone_the_skin_is_where_force_begins() -> None:
    rows = np.array([(-0.0003, 0.0), (-0.0002, 0.01), (-0.0001, 0.0), (0.0, 0.0), (0.0001, 1.2)])
    touch = find_touch(rows)
    assert touch.depth == pytest.approx(0.0, abs=1e-9)
    assert touch.sigma == TUNING.unfitted_sd_m


def test_a_wrong_forecast_shifts_the_touch() -> None:
    onset = Onset()
    for k, (depth, force) in enumerate(descent(0.003, 1.5, 1.3, 0.0, 0.0)):
        onset.add(float(depth), float(force), k, 0.001)
    assert onset.touch().depth == pytest.approx(0.003, abs=1e-5)
    assert onset.touch_again(np.full(len(onset.times), 0.0005)).depth == pytest.approx(0.0025, abs=1e-5)
