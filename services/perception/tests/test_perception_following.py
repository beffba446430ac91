"""Tests of wall following: breath filter, arm mask, and reports of breaths, coughs, shifts and a hidden wall."""

from functools import cache

import numpy as np
import pytest

from palpate.truth.pressed import TrueBody, TrueSurface
from palpate_bus.messages import SurfaceMotion
from palpate_models.numerics.frames import apply, inverse
from palpate_models.robot.arm import tool_pose
from palpate_models.scenario.errors import draw_errors
from palpate_models.scenario.load import exam_input, load_scenario
from palpate_models.scenario.schema import Robot
from palpate_perception.breath_filter import BreathFilter
from palpate_perception.follower import ArmMask
from palpate_perception.wall import fill_gaps, find_steady
from research.following import READY, Patient, Run, run


@cache
def breathing(level: str) -> tuple[Run, Patient]:
    """Return 30 s of strokes over a wall that breathes by 8 mm, with errors of a level."""
    settings = ("exam.region_m=[0.1, 0.1]", f"errors={level}", "phantom.breathing.peak_to_peak_m=0.008")
    return run(load_scenario("healthy", settings, 3), 30.0)


def test_after_a_long_gap_the_wall_breathes_as_before() -> None:
    """After a gap longer than the filter's memory one image determines neither rate nor amplitude."""
    t = 0.1 * np.arange(400)
    t[100:] += 40.0
    d = 0.004 * (1 - np.cos(2 * np.pi * t / 4))
    breath = BreathFilter(t[:100], d[:100])
    reported = []
    for k in range(100, 160):
        expected, sigma = breath.forward(t[k])
        reported.append((expected - d[k], sigma))
        breath.update(d[k], 0.0003)
        breath.remember(d[k])
        assert breath.depth == pytest.approx(0.008, rel=0.1)
    errors, sigmas = np.array(reported[10:]).T
    assert np.sqrt(np.mean((errors / sigmas) ** 2)) < 1.5


def test_a_sine_is_forecast() -> None:
    t = 0.1 * np.arange(400)
    d = 0.004 * (1 - np.cos(2 * np.pi * t / 4))
    breath = BreathFilter(t[:100], d[:100])
    error = []
    for at, value in zip(t[100:], d[100:], strict=True):
        breath.forward(float(at))
        breath.update(float(value), 1e-4)
        breath.remember(float(value))
        error.append(breath.forecast(np.array((0.2,)))[0] - 0.004 * (1 - np.cos(2 * np.pi * (at + 0.2) / 4)))
    assert np.sqrt(np.mean(np.square(error))) < 0.25e-3


def test_the_arm_hides_what_lies_below_it() -> None:
    robot = Robot()
    tip = tool_pose(READY, robot)[:3, 3]
    above = tip + np.array((0.0, 0.0, 1.0))
    rays = np.array([(0.0, 0.0, -1.0), (0.6, 0.6, -1.0)])
    assert ArmMask(robot).hides(READY, above, rays, np.array((1.2, 1.2))).tolist() == [True, False]


@pytest.mark.parametrize("level", ["typical", "poor"])
def test_quiet_breathing_is_followed_and_the_error_shared_by_neighbouring_pixels_is_reported(level: str) -> None:
    """The arm palpates. The error of the displacement agrees with the reported SD, with a camera of either kind."""
    result, patient = breathing(level)
    reported = np.array(result.motion)
    assert np.mean(np.array(result.state) == SurfaceMotion.QUIET) > 0.9
    error = reported[:, 2] - [patient.curve.excursion(t + 0.1) for t in result.t_s]
    assert np.sqrt(np.mean(error**2)) < (0.7e-3 if level == "typical" else 1.2e-3)
    assert np.abs(error).max() < 5e-3
    assert np.ptp(reported[:, 0]) > 4e-3, "it does breathe"
    lifted = np.array([patient.curve.excursion(t) for t in result.t_s])
    ratio = np.sqrt(np.mean(np.square(result.uncertainty))) / np.std(reported[:, 0] - lifted)
    assert 0.6 < ratio < 1.6


def test_a_camera_that_warms_up_moves_no_wall() -> None:
    warming = ("exam.region_m=[0.1, 0.1]", "errors.camera.warm_up_m=0.01", "errors.camera.warm_up_s=30")
    case = load_scenario("healthy", warming, 3)
    result, patient = run(case, 24.0)
    t, warmer = np.array(result.t_s), draw_errors(case.errors, case.seed).camera.warm_up_m
    assert abs(warmer) * (np.exp(-t[0] / 30) - np.exp(-t[-1] / 30)) > 1.5e-3, "it drifts"
    error = np.array(result.motion)[:, 0] - [patient.curve.excursion(at) for at in t]
    assert abs(error[t > t[-1] - 12].mean() - error[t < t[0] + 12].mean()) < 0.5e-3


def bent(outward: np.ndarray, xy: np.ndarray) -> float:
    """Return the RMS error of a surface over its vertices after removing an offset, a tilt and a bowl."""
    x, y = (xy - xy.mean(axis=0)).T
    smooth = np.column_stack((np.ones(len(x)), x, y, x**2, x * y, y**2))
    return float(np.std(outward - smooth @ np.linalg.lstsq(smooth, outward, rcond=None)[0]))


def test_what_the_camera_sees_bent_for_seconds_averages_out() -> None:
    result, patient = breathing("typical")
    p_A = apply(inverse(patient.X_WA), np.asarray(result.surface.vertices, np.float64).reshape(-1, 3))
    n_A = np.asarray(result.surface.normals, np.float64).reshape(-1, 3) @ patient.X_WA[:3, :3]
    skin = TrueSurface(TrueBody(patient.model.vertices, patient.model.triangles, patient.X_WA))
    outward = (skin.height(p_A[:, :2]) - p_A[:, 2]) * n_A[:, 2]
    burst, averaged = bent(outward, p_A[:, :2]), bent(outward - np.asarray(result.correction.outward), p_A[:, :2])
    assert burst > 0.3e-3
    assert averaged < 0.8 * burst


def test_a_cough_spoils_and_passes() -> None:
    case = load_scenario("healthy", ("exam.region_m=[0.1, 0.1]", "phantom.breathing.coughs_per_min=10"), 5)
    result, patient = run(case, 20.0)
    state, t = np.array(result.state), np.array(result.t_s)
    table = patient.curve.table
    hard = table[(table[:, 1] == 0.15) & (table[:, 4] > 0.012) & (table[:, 0] > t[0]) & (table[:, 0] < t[-1] - 1)]
    coughs = hard[:, 0] + 0.15
    assert len(coughs)
    for moment in coughs:
        assert np.any(state[(t >= moment - 0.1) & (t < moment + 0.35)] == SurfaceMotion.SPOILED), moment
    assert np.mean(state == SurfaceMotion.QUIET) > 0.5


def moved_at(result: Run) -> float:
    """Return the time of the first report that the patient has moved [s]."""
    return float(np.array(result.t_s)[np.array(result.state) == SurfaceMotion.MOVED][0])


def test_a_shift_along_a_body_that_is_much_the_same_along_its_length_is_noticed() -> None:
    settings = ("exam.region_m=[0.12, 0.12]", "phantom.motion.kind=shift", "phantom.motion.at_s=25")
    result, patient = run(load_scenario("person", settings, 2063235108), 16.0)
    assert abs(patient.motion.pose(35.0)[1, 3]) > 9.9e-3
    assert 25.0 < moved_at(result) <= 26.5


def test_a_patient_who_turns_is_noticed_within_a_second_and_found_by_a_second_scan() -> None:
    case = load_scenario("restless", ("exam.region_m=[0.1, 0.1]", "phantom.motion.kind=turn", "phantom.motion.at_s=16"), 3)
    result, patient = run(case, seconds=19.0, again_s=18.0)
    assert 16.0 < moved_at(result) <= 17.0
    assert result.state[-1] == SurfaceMotion.QUIET
    X = patient.motion.pose(22.0)
    middle = np.append(case.exam.centre_m, 0.0)
    moved = (X[:3, :3] @ middle + X[:3, 3] - middle)[:2]
    assert np.abs(result.shift[-1] - moved)[0] < 1.5e-3
    assert np.abs(result.shift[-1] - moved)[1] < 4e-3, "along the body the wall is flat"
    p_A = apply(inverse(np.array(exam_input(case).X_WA)), np.asarray(result.surface.vertices, np.float64).reshape(-1, 3))
    centre = (p_A[:, :2].min(axis=0) + p_A[:, :2].max(axis=0)) / 2
    assert np.abs(centre - case.exam.centre_m - result.shift[-1]).max() < 3e-3, "the mesh moves with the body"


def test_pixels_whose_holes_flicker_show_the_whole_breath_and_no_less_noise() -> None:
    """A gap of one frame is interpolated, since the wall moves in it."""
    rng = np.random.default_rng(1)
    breath = 0.004 * np.sin(np.arange(80) * 2 * np.pi / 40)
    frames = 1.0 + breath[:, None] + rng.normal(0.0, 0.002, (80, 200))
    frames[rng.random(frames.shape) < 0.2] = np.nan
    filled = fill_gaps(frames)
    assert np.isfinite(filled).all()
    assert np.ptp(filled.mean(axis=1)) > 0.95 * np.ptp(breath)
    _, _, sigma = find_steady(frames.reshape(80, 10, 20))
    assert abs(np.median(sigma) - 0.002) < 0.0002
