"""Tests of contact force and depth regulation."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from planning_fakes import hertz
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


def test_taring_averages_noise_out_and_a_second_one_replaces_the_first() -> None:
    rng = np.random.default_rng(1)
    tool, com = ForceCompensation(0.35), np.array((0.0, 0.0, 0.07))
    R = np.diag((-1.0, 1.0, -1.0))
    for bias in (2.0, 0.5):
        tool.update(R, np.zeros(6), taring=False)
        for _ in range(300):
            tool.update(R, reading(R, np.zeros(3), np.full(6, bias), 0.35, com) + rng.normal(0, 0.05, 6), taring=True)
        assert tool.bias == pytest.approx(np.full(3, bias), abs=0.012)


LIMIT_N = 15.0
DASHPOT_S = 0.05


def regulator(start_m: float, stiffness: float = NORMAL_STIFFNESS) -> DepthRegulator:
    begun = DepthRegulator(0.01, stiffness, LIMIT_N, 0.02)
    begun.reset(start_m)
    return begun


def update(
    one: DepthRegulator, depth_m: float, force_n: float, target_m: float = 0.01, load_n: float | None = None
) -> Regulation:
    load, touching = abs(force_n) if load_n is None else load_n, force_n > 0.15
    return one.update(target_m=target_m, depth_m=depth_m, normal_force_n=force_n, load_n=load, in_contact=touching)


def indent(force: Callable[[float, float], float], follow_s: float | None = None) -> np.ndarray:
    """Rows of time, reference, depth, force, limited of an indentation at 20 mm/s from 10 mm above to 10 mm depth, for 4 s.

    The arm: 4 kg, K_z, damping ratio 0.8, 1 N of friction; or one that takes positions, follows them with the time constant
    `follow_s` and yields by admittance. `force` by depth and time; sensor noise; the command comes into force 10 ms late and is
    extrapolated by its rate.
    """
    rng, yielded, one = np.random.default_rng(0), 0.0, regulator(-0.01)
    mass, damping, dt = 4.0, 2 * 0.8 * np.sqrt(NORMAL_STIFFNESS * 4.0), 1e-3
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
            depth, pressed = float(np.mean(depths[-10:])), float(np.mean(forces[-10:]))
            room = 1.0 if latest is None else np.clip((1 - latest[0].expected_force / one.force_max) / 0.3, 0.01, 1)
            target = min(target + 0.0002 * room, 0.010)
            pending = update(one, depth, pressed + rng.normal(0, 0.016), target), t
            rows.append((t, pending[0].reference_m, depth, pressed, pending[0].limited))
        goal, rate, feed = -0.01, 0.0, 0.0
        if latest is not None:
            rate, feed = latest[0].rate, latest[0].feed_forward_n
            goal = latest[0].command_m + rate * min(t - latest[1], 0.03)
        if follow_s is None:
            pull = NORMAL_STIFFNESS * (goal - x) + damping * (rate - v) + feed - F - np.tanh(v / 0.002)
            v += pull / mass * dt
        else:
            yielded += dt / 0.15 * ((F - feed) / NORMAL_STIFFNESS - yielded)
            v = (goal - yielded - x) / follow_s
        x += v * dt
    return np.array(rows, dtype=float)


@pytest.mark.parametrize("newton", [0.3, 2.4, 9.6])
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
@pytest.mark.parametrize("exponent", [1.45, 3.0])
def test_a_force_near_its_limit_does_not_swing(exponent: float, follow_s: float | None) -> None:
    rows = indent(lambda depth, t: 16.0 * (max(depth, 0.0) / 0.01) ** exponent, follow_s)
    assert rows[:, 3].max() < 13.5
    assert np.ptp(rows[-200:, 3]) < 0.5


def test_a_hard_surface_is_not_pressed_with_more_than_the_limit_for_long() -> None:
    rows = indent(lambda depth, t: 1e5 * max(depth, 0.0))
    assert rows[:, 3].max() < 25.0
    assert rows[-1, 3] < LIMIT_N


def test_lateral_force_reduces_depth_like_normal_force() -> None:
    one = regulator(0.01)
    for _ in range(100):
        regulation = update(one, 0.01, 11.0, load_n=16.0)
    assert regulation.limited
    assert regulation.reference_m < 0.0095
    assert regulation.feed_forward_n == pytest.approx(DEPTH.feed_forward * 11.0)


def test_where_little_depth_gives_much_force_depth_does_not_return_to_its_target() -> None:
    one = regulator(0.0032)
    for _ in range(100):
        update(one, 0.0032, 11.0)
    assert max(update(one, 0.0028, 11.0).reference_m for _ in range(50)) < 0.004


def test_depth_is_never_commanded_beyond_its_limit() -> None:
    one = regulator(0.0, 5000.0)
    assert 0.0195 < max(update(one, 0.016, 1.0, 0.019).command_m for _ in range(200)) <= 0.02


def test_in_free_air_nothing_winds_up() -> None:
    one = regulator(-0.02, 5000.0)
    for _ in range(500):
        regulation = update(one, -0.018, 0.01, -0.02)
    assert regulation.command_m == pytest.approx(-0.02)
    assert regulation.feed_forward_n < 0.02
