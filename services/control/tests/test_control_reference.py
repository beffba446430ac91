"""Extrapolation of set-points: exact for what their twist says, smooth where they do not meet."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate_bus.setpoint import ControlMode, Setpoint
from palpate_control import reference as module
from palpate_control.reference import Extrapolator

MS = 1_000_000


def at(stamp: int, p: float = 0.0, v: float = 0.0, mode: ControlMode = ControlMode.CARTESIAN, **changes: object) -> Setpoint:
    fields: dict[str, object] = {
        "mode": mode,
        "stamp": stamp,
        "R_WD": np.eye(3),
        "p_WD": np.array([p, 0.0, 0.0]),
        "V_WD": np.array([v, 0.0, 0.0, 0.0, 0.0, 0.0]),
        "F_W": np.zeros(6),
        "stiffness": np.ones(6),
        "damping_ratio": np.ones(6),
        "q": np.full(7, p),
        "qd": np.full(7, v),
        "joint_stiffness": np.ones(7),
    }
    return Setpoint(**(fields | changes))  # type: ignore[arg-type]


def test_asks_for_a_setpoint_first() -> None:
    with pytest.raises(ValueError, match="no set-point"):
        Extrapolator(10 * MS).at(0)


@given(st.integers(0, 29), st.floats(-2, 2), st.floats(-3, 3))
@settings(deadline=None)  # the first example loads what is compiled
def test_pose_moves_with_its_twist(age_ms: int, v: float, w: float) -> None:
    guide = Extrapolator(10 * MS)
    twist = np.array([v, 0.5 * v, -v, 0.2 * w, w, -w])
    guide.accept(at(5 * MS, V_WD=twist), 5 * MS)
    now = guide.at((5 + age_ms) * MS)
    np.testing.assert_allclose(now.motion.p_WD, twist[:3] * age_ms * 1e-3, atol=1e-12)
    np.testing.assert_allclose(now.motion.R_WD, pin.exp3(twist[3:] * age_ms * 1e-3), atol=1e-12)
    np.testing.assert_allclose(now.motion.V_WD, twist)


def test_steady_motion_has_no_lag_and_no_steps() -> None:
    guide = Extrapolator(10 * MS)
    for t in range(0, 500 * MS, MS):
        if t % (10 * MS) == 0:
            guide.accept(at(t - 10 * MS, 0.1 * (t - 10 * MS) * 1e-9, 0.1), t)
        assert guide.at(t).motion.p_WD[0] == pytest.approx(0.1 * t * 1e-9, abs=1e-12)


@pytest.mark.parametrize("mode", ControlMode)
def test_accelerated_motion_stays_smooth(mode: ControlMode) -> None:
    """1 m/s^2 (or rad/s^2): no tick's step differs from the one before by more than 40 um; the error stays below 0.3 mm."""
    guide, path = Extrapolator(10 * MS), []
    for t in range(0, 500 * MS, MS):
        if t % (10 * MS) == 0:
            s = max(t - 10 * MS, 0) * 1e-9
            guide.accept(at(round(s * 1e9), 0.5 * s * s, s, mode), t)
        now = guide.at(t)
        path.append(now.motion.p_WD[0] if mode is ControlMode.CARTESIAN else now.motion.q[3])
    true = 0.5 * (np.arange(500) * 1e-3) ** 2
    assert np.abs(np.array(path) - true).max() < 3e-4
    assert np.abs(np.diff(path, 2)).max() < 4e-5


def test_steps_of_pose_and_wrench_fade_in() -> None:
    guide = Extrapolator(10 * MS)
    guide.accept(at(0), 10 * MS)
    guide.at(10 * MS)
    turned = pin.exp3(np.array([0.0, 0.0, 0.1]))
    guide.accept(at(10 * MS, 0.001, R_WD=turned, F_W=np.array([0.0, 0, 4, 0, 0, 0])), 20 * MS)
    values = [guide.at(t * MS) for t in range(20, 61)]
    p, f = np.array([v.motion.p_WD[0] for v in values]), np.array([v.motion.F_W[2] for v in values])
    angle = np.array([pin.log3(v.motion.R_WD)[2] for v in values])
    for series, end in ((p, 0.001), (f, 4.0), (angle, 0.1)):
        assert series[0] < 0.9 * end
        assert (np.diff(series) > 0).all()
        assert series[-1] == pytest.approx(end, rel=2e-3)


def test_a_clock_that_is_set_back_makes_no_gap_wider() -> None:
    """It would wind the springs up: 100 ms back made 60 N m of a gap of 2 um."""
    guide = Extrapolator(10 * MS)
    guide.accept(at(490 * MS), 500 * MS)
    guide.at(500 * MS)
    guide.accept(at(500 * MS, 2e-6), 501 * MS)
    assert 0.0 <= guide.at(501 * MS).motion.p_WD[0] <= 2e-6
    for back in (40, 100, 200):
        assert 0.0 <= guide.at((502 - back) * MS).motion.p_WD[0] <= 2e-6


def test_silent_sender_is_braked_smoothly() -> None:
    """Set-points stop: the motion goes on for the bridging time, brakes within 25 ms and stands."""
    guide = Extrapolator(10 * MS)
    guide.accept(at(0, 0.0, 0.1), 0)
    values = [guide.at(t * MS) for t in range(200)]
    v = np.array([value.motion.V_WD[0] for value in values])
    p = np.array([value.motion.p_WD[0] for value in values])
    bridge = module.TUNING.bridged_periods * 10
    assert v[bridge] == pytest.approx(0.1)
    assert v[bridge + 1] > 0.07
    assert abs(v[bridge + 30]) < 1e-3
    assert p[-1] == pytest.approx(0.1 * bridge * 1e-3)


def test_change_of_mode_starts_afresh() -> None:
    guide = Extrapolator(10 * MS)
    guide.accept(at(0, 0.3, 0.1), 0)
    guide.at(0)
    guide.accept(at(10 * MS, 1.0, 0.0, ControlMode.JOINT), 20 * MS)
    now = guide.at(20 * MS)
    assert now.setpoint.mode is ControlMode.JOINT
    np.testing.assert_allclose(now.motion.q, 1.0)
    np.testing.assert_allclose(now.motion.qdd, 0.0)


def test_joint_setpoints_tell_their_acceleration_within_bounds() -> None:
    guide = Extrapolator(10 * MS)
    guide.accept(at(0, 0.0, 0.0, ControlMode.JOINT), 0)
    guide.accept(at(10 * MS, 0.0, 0.05, ControlMode.JOINT), 10 * MS)
    assert guide.at(10 * MS).motion.qdd == pytest.approx(np.full(7, 5.0))
    guide.accept(at(20 * MS, 0.0, 1.5, ControlMode.JOINT), 20 * MS)
    assert guide.at(20 * MS).motion.qdd == pytest.approx(np.full(7, module.TUNING.max_acceleration_radps2))
