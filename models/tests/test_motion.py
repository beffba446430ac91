"""The patient's motion: where the body is before, in and after it, and that the seed decides it."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from palpate_models.numerics.frames import apply
from palpate_models.patient.motion import BodyMotion, Motion

SHIFT = Motion(kind="shift", shift_m=0.010, at_s=20.0, over_s=0.5)
TURN = Motion(kind="turn", at_s=20.0, over_s=0.5)


@pytest.mark.parametrize("motion", [SHIFT, TURN])
def test_the_body_lies_still_before_and_after(motion):
    body = BodyMotion(motion, 1)
    np.testing.assert_array_equal(body.pose(20.0), np.eye(4))
    np.testing.assert_array_equal(body.pose(0.0), np.eye(4))
    np.testing.assert_array_equal(body.pose(20.5), body.pose(300.0))
    assert np.abs(body.pose(21.0) - np.eye(4)).max() > 0.002
    for t in (19.0, 25.0):
        assert not np.concatenate(body.twist(t)).any()


def test_a_shift_is_along_the_table_and_as_far_as_it_is_set():
    X = BodyMotion(SHIFT, 1).pose(30)
    np.testing.assert_array_equal(X[:3, :3], np.eye(3))
    assert np.linalg.norm(X[:2, 3]) == pytest.approx(0.010)
    assert X[2, 3] == 0


def test_a_turn_is_about_the_spine():
    X = BodyMotion(TURN, 1).pose(30)
    turn = Rotation.from_matrix(X[:3, :3]).as_rotvec()
    assert abs(turn[1]) == pytest.approx(np.radians(3))
    spine = np.array(((0.0, 0.2, -0.1), (0.0, -0.1, -0.1)))
    np.testing.assert_allclose(apply(X, spine), spine, atol=1e-15)
    assert np.linalg.norm(X[:3, 3]) == pytest.approx(0.1 * np.radians(3), rel=1e-3)  # the umbilicus


@pytest.mark.parametrize("motion", [SHIFT, TURN])
def test_the_twist_is_the_rate_of_the_pose(motion):
    body, h = BodyMotion(motion, 4), 1e-5
    r = np.array((0.03, -0.05, 0.02))  # of a point of the body, in A'
    for t in (20.0, 20.1, 20.25, 20.45):
        rate = (apply(body.pose(t + h), r[None]) - apply(body.pose(t - h), r[None]))[0] / (2 * h)
        v, w = body.twist(t)
        np.testing.assert_allclose(v + np.cross(w, apply(body.pose(t), r[None])[0]), rate, atol=2e-6)


def test_the_seed_decides_moment_and_direction():
    drawn = Motion(kind="shift")
    first, again, other = (BodyMotion(drawn, seed) for seed in (1, 1, 2))
    assert first.at_s == again.at_s != other.at_s
    np.testing.assert_array_equal(first.pose(200), again.pose(200))
    assert np.abs(first.pose(200) - other.pose(200)).max() > 1e-4
    moments = [BodyMotion(drawn, seed).at_s for seed in range(50)]
    assert 40 <= min(moments) < 50
    assert 80 < max(moments) <= 90
    sides = {np.sign(BodyMotion(Motion(kind="turn"), seed).pose(200)[0, 2]) for seed in range(20)}
    assert sides == {-1, 1}


def test_patients_lie_still_by_default():
    body = BodyMotion(Motion(), 3)
    assert not body.moves
    np.testing.assert_array_equal(body.pose(1e3), np.eye(4))


@pytest.mark.parametrize("fields", [{"kind": "jump"}, {"shift_m": 10}, {"turn_rad": 3}, {"over_s": 0}, {"at_s": -1}])
def test_bad_settings_are_refused_by_name(fields):
    with pytest.raises(ValidationError, match=next(iter(fields))):
        Motion.model_validate(fields)


@pytest.mark.parametrize("motion", [SHIFT, TURN])
def test_points_on_the_body_are_where_its_pose_says(motion: Motion) -> None:
    body, times = BodyMotion(motion, 1), np.array((0.0, 20.2, 20.4, 300.0))
    p = np.random.Generator(np.random.PCG64(0)).normal(size=(4, 3))
    carried = np.array([apply(body.pose(t), q[None])[0] for t, q in zip(times, p, strict=True)])
    np.testing.assert_allclose(body.on_body(times, carried), p, atol=1e-14)
