"""Tests of contact force and depth regulation."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from palpate_models.numerics.frames import GRAVITY
from palpate_planning.contact import ForceCompensation
from palpate_planning.depth import DEPTH, DepthRegulator, Regulation
from palpate_planning.setpoints import NORMAL_STIFFNESS


def reading(R_WS: np.ndarray, force_W: np.ndarray, bias: np.ndarray, mass: float, com: np.ndarray) -> np.ndarray:
    """Return a sensor reading, computed independently: weight at the centre of mass, contact force at the tip."""
    weight = R_WS.T @ np.array((0, 0, -mass * GRAVITY))
    contact = R_WS.T @ force_W
    torque = np.cross(com, weight) + np.cross((0, 0, 0.1), contact)
    return np.concatenate((weight + contact, torque)) + bias


@given(st.integers(0, 10**6))
@settings(deadline=None)
def test_contact_force_is_found_at_any_orientation(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mass, com = rng.uniform(0.1, 1.5), rng.uniform(-0.05, 0.1, 3)
    tool = ForceCompensation(mass)
    bias = rng.normal(0, 1, 6)
    for R in Rotation.random(3, random_state=rng).as_matrix():
        tool.update(R, reading(R, np.zeros(3), bias, mass, com), taring=True)
    assert tool.bias == pytest.approx(bias[:3], abs=1e-9)
    force = rng.normal(0, 5, 3)
    R = Rotation.random(random_state=rng).as_matrix()
    assert tool.contact_force_W(R, reading(R, force, bias, mass, com), np.zeros(3)) == pytest.approx(force, abs=1e-9)


def test_acceleration_of_the_tool_is_no_contact() -> None:
    tool = ForceCompensation(0.4)
    R = Rotation.from_rotvec((0.3, -0.2, 0.1)).as_matrix()
    a = np.array((0.1, -0.2, 0.5))
    seen = reading(R, -0.4 * a, np.zeros(6), 0.4, np.array((0.0, 0.0, 0.06)))
    assert tool.contact_force_W(R, seen, a) == pytest.approx(np.zeros(3), abs=1e-12)
    assert np.linalg.norm(tool.contact_force_W(R, seen, np.zeros(3))) > 0.2


def test_taring_averages_noise_out() -> None:
    rng = np.random.default_rng(1)
    tool, com = ForceCompensation(0.35), np.array((0.0, 0.0, 0.07))
    R = np.diag((-1.0, 1.0, -1.0))
    for _ in range(300):
        tool.update(R, reading(R, np.zeros(3), np.full(6, 0.5), 0.35, com) + rng.normal(0, 0.05, 6), taring=True)
    assert tool.bias == pytest.approx(np.full(3, 0.5), abs=0.012)


def test_a_second_taring_replaces_the_bias() -> None:
    tool = ForceCompensation(0.35)
    for value in (1.0, 2.0):
        tool.update(np.eye(3), np.zeros(6), taring=False)
        tool.update(np.eye(3), reading(np.eye(3), np.zeros(3), np.full(6, value), 0.35, np.zeros(3)), taring=True)
    assert tool.bias == pytest.approx(np.full(3, 2.0))


LIMIT_N = 15.0
DASHPOT_S = 0.05


def hertz(newton: float) -> Callable[[float], float]:
    return lambda depth: newton * (max(depth, 0.0) / 0.01) ** 1.45


def indent(force: Callable[[float, float], float], follow_s: float | None = None) -> np.ndarray:
    """Rows of time, reference, depth, force, limited of an indentation at 20 mm/s from 10 mm above to 10 mm depth, for 4 s.

    The arm: 4 kg, K_z, damping ratio 0.8, 1 N of friction; or one that takes positions, follows them with the time constant
    `follow_s` and yields by admittance. `force` by depth and time; sensor noise; the command comes into force 10 ms late and is
    extrapolated by its rate.
    """
    rng, yielded = np.random.default_rng(0), 0.0
    mass, damping, dt = 4.0, 2 * 0.8 * np.sqrt(NORMAL_STIFFNESS * 4.0), 1e-3
    regulator = DepthRegulator(0.01, NORMAL_STIFFNESS, LIMIT_N, 0.02)
    regulator.reset(-0.01)
    x, v, target = -0.01, 0.0, -0.01
    latest: tuple[Regulation, float] | None = None
    pending: tuple[Regulation, float] | None = None
    depths, forces, rows = [], [], []
    for k in range(4000):
        t = k * dt
        F = force(x + DASHPOT_S * v if x > 0 else x, t)
        depths.append(x)
        forces.append(F)
        if k % 10 == 0 and k:
            latest = pending
            depth, measured = float(np.mean(depths[-10:])), float(np.mean(forces[-10:])) + rng.normal(0, 0.016)
            room = 1.0 if latest is None else np.clip((1 - latest[0].expected_force / regulator.force_max) / 0.3, 0.01, 1)
            target = min(target + 0.0002 * room, 0.010)
            pending = (
                regulator.update(
                    target_m=target, depth_m=depth, normal_force_n=measured, load_n=abs(measured), in_contact=measured > 0.15
                ),
                t,
            )
            rows.append((t, pending[0].reference_m, depth, float(np.mean(forces[-10:])), pending[0].limited))
        goal, rate, feed = -0.01, 0.0, 0.0
        if latest is not None:
            regulation, since = latest
            goal, rate, feed = (
                regulation.command_m + regulation.rate * min(t - since, 0.03),
                regulation.rate,
                regulation.feed_forward_n,
            )
        if follow_s is None:
            pull = NORMAL_STIFFNESS * (goal - x) + damping * (rate - v) + feed - F - np.tanh(v / 0.002)
            v += pull / mass * dt
        else:
            yielded += dt / 0.15 * ((F - feed) / NORMAL_STIFFNESS - yielded)
            v = (goal - yielded - x) / follow_s
        x += v * dt
    return np.array(rows, dtype=float)


@pytest.mark.parametrize("newton", [0.3, 1.0, 2.4, 5.0, 9.6])
def test_depth_converges_on_soft_and_stiff_tissue(newton: float) -> None:
    rows = indent(lambda depth, t: hertz(newton)(depth))
    settled = rows[rows[:, 0] > 2.0]
    assert settled[:, 2] == pytest.approx(0.010, abs=1e-4)
    assert not settled[:, 4].any()


@pytest.mark.parametrize("contrast", [4.0, 10.0])
def test_sliding_into_a_lesion_keeps_depth_or_yields_below_the_limit(contrast: float) -> None:
    def force(depth: float, t: float) -> float:
        return hertz(2.4)(depth) * (1 + (contrast - 1) * float(np.clip((t - 2) / 0.6, 0, 1)))

    rows = indent(force)
    error = (rows[:, 1] - rows[:, 2])[rows[:, 0] > 1.8]
    assert np.sqrt(np.mean(error**2)) < 2e-4
    assert rows[:, 3].max() < LIMIT_N
    end = rows[-1]
    if contrast == 10.0:
        assert end[4]
        assert end[3] == pytest.approx(DEPTH.force_fraction * LIMIT_N, abs=0.3)
        assert end[2] < 0.008
    else:
        assert end[2] == pytest.approx(0.010, abs=1e-4)


@pytest.mark.parametrize("exponent", [1.0, 2.0])
def test_a_wrong_exponent_still_ends_at_the_limit(exponent: float) -> None:
    rows = indent(lambda depth, t: 24.0 * (max(depth, 0.0) / 0.01) ** exponent)
    assert rows[-1, 3] <= LIMIT_N
    assert rows[-1, 3] > 0.6 * DEPTH.force_fraction * LIMIT_N


@pytest.mark.parametrize("follow_s", [None, 0.04])
@pytest.mark.parametrize("exponent", [1.45, 2.4, 3.0])
def test_a_force_near_its_limit_does_not_swing(exponent: float, follow_s: float | None) -> None:
    rows = indent(lambda depth, t: 16.0 * (max(depth, 0.0) / 0.01) ** exponent, follow_s)
    assert rows[:, 3].max() < 13.5
    assert np.ptp(rows[-200:, 3]) < 0.5


def test_a_hard_surface_is_not_pressed_with_more_than_the_limit_for_long() -> None:
    rows = indent(lambda depth, t: 1e5 * max(depth, 0.0))
    assert rows[:, 3].max() < 25.0
    assert rows[-1, 3] < LIMIT_N


def test_lateral_force_reduces_depth_like_normal_force() -> None:
    regulator = DepthRegulator(0.01, NORMAL_STIFFNESS, LIMIT_N, 0.02)
    regulator.reset(0.01)
    for _ in range(100):
        regulation = regulator.update(target_m=0.01, depth_m=0.01, normal_force_n=11.0, load_n=16.0, in_contact=True)
    assert regulation.limited
    assert regulation.reference_m < 0.0095
    assert regulation.feed_forward_n == pytest.approx(DEPTH.feed_forward * 11.0)


def test_where_little_depth_gives_much_force_depth_does_not_return_to_its_target() -> None:
    regulator = DepthRegulator(0.01, NORMAL_STIFFNESS, LIMIT_N, 0.02)
    regulator.reset(0.0032)
    for _ in range(100):
        regulator.update(target_m=0.01, depth_m=0.0032, normal_force_n=11.0, load_n=11.0, in_contact=True)
    references = [
        regulator.update(target_m=0.01, depth_m=0.0028, normal_force_n=11.0, load_n=11.0, in_contact=True).reference_m
        for _ in range(50)
    ]
    assert max(references) < 0.004


def test_depth_is_never_commanded_beyond_its_limit() -> None:
    regulator = DepthRegulator(0.01, 5000.0, LIMIT_N, 0.02)
    regulator.reset(0.0)
    commands = [
        regulator.update(target_m=0.019, depth_m=0.016, normal_force_n=1.0, load_n=1.0, in_contact=True).command_m
        for _ in range(200)
    ]
    assert 0.0195 < max(commands) <= 0.02


def test_in_free_air_nothing_winds_up() -> None:
    regulator = DepthRegulator(0.01, 5000.0, LIMIT_N, 0.02)
    regulator.reset(-0.02)
    for _ in range(500):
        regulation = regulator.update(target_m=-0.02, depth_m=-0.018, normal_force_n=0.01, load_n=0.01, in_contact=False)
    assert regulation.command_m == pytest.approx(-0.02)
    assert regulation.feed_forward_n < 0.02
