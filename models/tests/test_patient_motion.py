"""Breathing, body motion and guarding of a patient, and the stiffening wall with the measured curves that it reproduces."""

from hashlib import sha256

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from palpate_models.numerics.frames import apply
from palpate_models.patient import remus2024, wall
from palpate_models.patient.healthy import pressed_force, tension_of_ratio
from palpate_models.patient.mesh import MeshError
from palpate_models.patient.motion import MOST_M, TABLE_S, BodyMotion, Breathing, BreathingCurve, Motion
from palpate_models.patient.phantom import build_phantom
from palpate_models.patient.remus2024 import curve, curves, exponent, fitted, relaxed_people
from palpate_models.patient.schema import Phantom, Stiffness
from palpate_models.patient.wall import Activation, Guarding

QUIET = Breathing(kind="quiet")


def table(seed: int = 0, **fields: object) -> np.ndarray:
    return BreathingCurve(Breathing.model_validate({"kind": "quiet", **fields}), seed).table


def many(**fields: object) -> np.ndarray:
    """Return the breaths of twenty patients, one after the other."""
    return np.concatenate([table(seed, **fields) for seed in range(20)])


def durations(breaths: np.ndarray) -> np.ndarray:
    return breaths[:, 1:4].sum(axis=1)


def cv(values: np.ndarray) -> float:
    return float(values.std() / values.mean())


def test_rate_and_depth_are_on_average_those_of_the_setting():
    breaths = many(rate_per_min=14, peak_to_peak_m=0.008)
    assert 60 / durations(breaths).mean() == pytest.approx(14, rel=0.03)
    assert breaths[:, 4].mean() == pytest.approx(0.008, rel=0.04)


def test_breaths_vary_as_much_as_is_set_and_remember_the_one_before():
    breaths = many(duration_cv=0.2, depth_cv=0.3, memory=0.28)
    assert cv(durations(breaths)) == pytest.approx(0.2, abs=0.02)
    assert cv(breaths[:, 4]) == pytest.approx(0.3, abs=0.03)
    for values in (durations(breaths), breaths[:, 4]):
        assert np.corrcoef(np.log(values[:-1]), np.log(values[1:]))[0, 1] == pytest.approx(0.28, abs=0.06)
    assert cv(breaths[:, 1] / durations(breaths)) == pytest.approx(0.179, abs=0.02)
    assert breaths[:, 2].mean() / breaths[:, 1].mean() == pytest.approx(1.2, abs=0.03)
    regular = table(duration_cv=0, depth_cv=0, timing_cv=0)
    assert np.ptp(regular[:, 1:], axis=0).max() < 1e-9


@pytest.mark.parametrize("fields", [{}, {"kind": "deep"}, {"kind": "held"}, {"coughs_per_min": 2}])
def test_the_curve_is_the_table_and_smooth_and_repeats(fields):
    curve = BreathingCurve(Breathing.model_validate({"kind": "quiet", **fields}), 3)
    start, inspiration, expiration, pause, amplitude = curve.table.T
    np.testing.assert_allclose(start[1:], (start + inspiration + expiration + pause)[:-1])
    assert start[0] <= 0
    assert start[0] + curve.repeats_s >= TABLE_S
    at = np.vectorize(curve.excursion)
    np.testing.assert_allclose(at(start), 0, atol=1e-15)
    np.testing.assert_allclose(at(start + inspiration), amplitude, rtol=1e-12)
    np.testing.assert_allclose(at(start + inspiration + expiration + 0.5 * pause), 0, atol=1e-15)
    t = np.arange(0, 90, 1e-3)
    values = at(t)
    assert values.min() == 0
    assert values.max() <= curve.largest_m
    steepest = (np.pi / 2 * amplitude / np.minimum(inspiration, expiration)).max()
    bend = (np.pi**2 / 2 * amplitude / np.minimum(inspiration, expiration) ** 2).max()
    assert np.abs(np.diff(values)).max() <= 1.001e-3 * steepest  # no jump
    assert np.abs(np.diff(values, 2)).max() <= 1.001e-6 * bend  # nor one of the speed
    np.testing.assert_allclose(at(t[:5000] + 7 * curve.repeats_s), values[:5000], atol=1e-12)
    np.testing.assert_allclose(at(t[:5000] - curve.repeats_s), values[:5000], atol=1e-12)


def test_the_seed_decides_the_breaths():
    first, again, other = (BreathingCurve(QUIET, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.table, again.table)
    assert abs(first.excursion(1.0) - other.excursion(1.0)) > 1e-5
    phases = [table(seed)[0, 0] for seed in range(60)]
    assert np.ptp(phases) > 0.8 * 60 / 14  # phases do not start with the examination


def test_the_held_breath_is_a_stretch_at_rest():
    breaths = table(kind="held", breathes_s=30, held_s=15)
    held = breaths[:, 3] > 15
    between = np.diff(breaths[held, 0])
    assert held.sum() > 8
    assert 40 < between.min() < between.max() < 56  # 30 s and what is left of a breath, then 15 s
    curve = BreathingCurve(Breathing(kind="held", breathes_s=30, held_s=15), 0)
    start, inspiration, expiration, _, _ = breaths[held][0]
    quiet = start + inspiration + expiration
    assert not any(curve.excursion(t) for t in np.linspace(quiet + 1e-9, quiet + 15, 50))


def test_coughs_come_in_bursts_and_leave_the_breaths_as_they_are():
    breaths = table(coughs_per_min=1)
    cough = breaths[:, 1] == 0.15
    bursts = np.diff(np.flatnonzero(np.diff(np.concatenate(([0], cough, [0])))))[::2]
    assert bursts.min() >= 2
    assert (bursts <= 3).mean() > 0.6  # two bursts may meet
    assert 4 < len(bursts) < 18
    assert 0.010 <= breaths[cough, 4].min() < breaths[cough, 4].max() <= 0.020
    calm = table()
    count = int((~cough).sum())
    np.testing.assert_array_equal(breaths[~cough][:, 1:], calm[:count, 1:])


def test_no_breath_is_deeper_than_the_tissue_can_follow():
    assert many(kind="deep", peak_to_peak_m=0.025, depth_cv=0.5)[:, 4].max() == MOST_M


SHIFT = Motion(kind="shift", shift_m=0.010, at_s=20.0, over_s=0.5)
TURN = Motion(kind="turn", at_s=20.0, over_s=0.5)


@pytest.mark.parametrize("motion", [SHIFT, TURN])
def test_the_body_lies_still_before_and_after(motion):
    body = BodyMotion(motion, 1)
    for one, other in ((body.pose(20.0), np.eye(4)), (body.pose(0.0), np.eye(4)), (body.pose(20.5), body.pose(300.0))):
        np.testing.assert_array_equal(one, other)
    assert np.abs(body.pose(21.0) - np.eye(4)).max() > 0.002
    for t in (19.0, 25.0):
        assert not np.concatenate(body.twist(t)).any()


def test_a_turn_is_about_the_spine():
    X = BodyMotion(TURN, 1).pose(30)
    turn = Rotation.from_matrix(X[:3, :3]).as_rotvec()
    assert abs(turn[1]) == pytest.approx(np.radians(3))
    spine = np.array(((0.0, 0.2, -0.1), (0.0, -0.1, -0.1)))
    np.testing.assert_allclose(apply(X, spine), spine, atol=1e-15)
    assert np.linalg.norm(X[:3, 3]) == pytest.approx(0.1 * np.radians(3), rel=1e-3)  # the umbilicus


@pytest.mark.parametrize("motion", [SHIFT, TURN])
def test_the_twist_is_the_rate_of_the_pose_and_points_are_found_on_the_body(motion):
    body, h = BodyMotion(motion, 4), 1e-5
    r = np.array((0.03, -0.05, 0.02))  # of a point of the body, in A'
    for t in (20.0, 20.1, 20.25, 20.45):
        rate = (apply(body.pose(t + h), r[None]) - apply(body.pose(t - h), r[None]))[0] / (2 * h)
        v, w = body.twist(t)
        carried = apply(body.pose(t), r[None])
        np.testing.assert_allclose(v + np.cross(w, carried[0]), rate, atol=2e-6)
        np.testing.assert_allclose(body.on_body(np.array((t,)), carried), r[None], atol=1e-14)


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


LOWER_RIGHT = Guarding(centre_m=(-0.06, -0.06))


BAD = {
    Breathing: [("kind", "loud"), ("peak_to_peak_m", 8), ("rate_per_min", 0), ("cough_m", (0.02, 0.01)), ("amplitude_m", 0.004)],
    Motion: [("kind", "jump"), ("shift_m", 10), ("turn_rad", 3), ("over_s", 0), ("at_s", -1)],
    Guarding: [("ratio", 1.0), ("ratio", 6.6), ("edge_m", 0.005), ("radii_m", (60, 60)), ("kind", "both"), ("depth_m", 0.0)],
}


@pytest.mark.parametrize(("section", "field", "value"), [(section, *bad) for section, all_bad in BAD.items() for bad in all_bad])
def test_a_bad_setting_is_refused_by_name(section, field, value):
    needed = {"centre_m": (0.0, 0.0)} if section is Guarding else {}
    with pytest.raises(ValidationError, match=field):
        section.model_validate({**needed, field: value})


def test_a_patient_has_one_kind_of_guarding():
    voluntary = LOWER_RIGHT.model_copy(update={"kind": "voluntary"})
    with pytest.raises(ValidationError, match="of one kind"):
        Phantom(guarding=(LOWER_RIGHT, voluntary))
    assert build_phantom(Phantom(guarding=(voluntary,)), 0).voluntary
    assert not build_phantom(Phantom(guarding=(LOWER_RIGHT,)), 0).voluntary


def test_guarding_beside_the_abdomen_is_refused():
    with pytest.raises(MeshError, match=r"phantom.guarding\[0\]"):
        build_phantom(Phantom(guarding=(Guarding(centre_m=(0.6, 0.0)),)), 0)


def test_tension_is_wide_and_smooth_and_leaves_stiffness_alone():
    plain, guarded = (build_phantom(Phantom(guarding=areas), 0) for areas in ((), (LOWER_RIGHT,)))
    np.testing.assert_array_equal(plain.tension, 0)
    np.testing.assert_array_equal(plain.stiffness, guarded.stiffness)
    assert (guarded.lesion == -1).all()
    tension, most = guarded.tension, tension_of_ratio(2.6, Stiffness())
    front = guarded.normals[:, 2] > 0
    distance = np.hypot(*(guarded.vertices[:, :2] - LOWER_RIGHT.centre_m).T)
    np.testing.assert_allclose(tension[front & (distance < 0.03)], most)
    np.testing.assert_array_equal(tension[~front | (distance > 0.09)], 0)
    outline = front & (np.abs(distance - 0.06) < 0.002)
    np.testing.assert_allclose(tension[outline], most / 2, rtol=0.12)
    a, b = guarded.triangles[front[guarded.triangles].all(axis=1)][:, :2].T
    slope = np.abs(tension[a] - tension[b]) / np.linalg.norm(guarded.vertices[a] - guarded.vertices[b], axis=1)
    assert slope.max() < 1.6 * most / LOWER_RIGHT.edge_m


@pytest.mark.parametrize(
    "stiffness", [Stiffness(), Stiffness(stiffening_per_m=100, length_m=0.03), Stiffness(prony_g=(), prony_tau_s=())]
)
def test_tension_makes_the_ratio_of_forces(stiffness):
    relaxed = pressed_force(stiffness, 0.0)
    for ratio in (1.2, 2.6, 6.5):
        tension = tension_of_ratio(ratio, stiffness)
        assert pressed_force(stiffness, tension) / relaxed == pytest.approx(ratio, rel=1e-4)
        assert tension > ratio - 1  # the neighbours are not contracted


@pytest.mark.parametrize(
    ("level", "seconds", "depth_m", "speed_mps", "expected"),
    [(1.0, 3.0, 0.010, 0.005, 0.368), (1.0, 15.0, 0.010, 0.0, 0.0), (0.0, 0.2, 0.030, 0.0, 0.865), (0.0, 0.2, 0.005, 0.1, 0.865)],
)
def test_voluntary_guarding_fades_under_a_gentle_press_and_returns_with_depth_and_speed(
    level, seconds, depth_m, speed_mps, expected
):
    activation = Activation(voluntary=True, dt=1e-3)
    for _ in range(round(seconds / 1e-3)):
        level = activation.after(level, depth_m, speed_mps)
    assert level == pytest.approx(expected, abs=0.01)


BETAS = (20.0, 77.0, 200.0)


@pytest.mark.parametrize("beta", BETAS)
def test_the_modulus_is_the_derivative_of_the_pressure_and_the_pressure_of_the_energy(beta: float) -> None:
    corner = float(wall.straight_from(np.array(beta)))
    u = np.linspace(-0.5, 3.0, 701) * corner
    du = 1e-6 * corner
    slope = (wall.stress(u + du, beta) - wall.stress(u - du, beta)) / (2 * du)
    np.testing.assert_allclose(slope, wall.slope(u, beta), rtol=1e-5, atol=1e-5)
    stress = (wall.stored_energy(u + du, beta) - wall.stored_energy(u - du, beta)) / (2 * du)
    np.testing.assert_allclose(stress, wall.stress(u, beta), rtol=1e-5, atol=1e-5 * corner)


def test_the_modulus_rises_with_the_square_of_the_depth_up_to_the_cap() -> None:
    u = np.array((-0.01, 0.0, 0.01, 0.02, 1.0))
    np.testing.assert_allclose(wall.slope(u, np.array(100.0)), (0.0, 0.0, 1.0, 4.0, wall.MOST_STIFFENING))
    np.testing.assert_allclose(wall.stress(u, np.array(100.0))[:4], (0.0, 0.0, 0.01 / 3, 0.08 / 3))


def test_the_file_is_as_published() -> None:
    published = "ce9e4039ea5f7d3141c3158c0653dcfb98646cf5b00842fa02357cfa79907e17"
    assert sha256((remus2024.FOLDER / "DataSheet1.csv").read_bytes()).hexdigest() == published
    assert len(curves()) == 154


def test_forces_are_in_newton_at_depths_in_metres() -> None:
    assert float(curve("R3", "rangeMean").force(0.010)) == pytest.approx(2.12, abs=0.005)
    assert float(curve("R1", "rangeMean").force(0.020)) == pytest.approx(8.40, abs=0.005)


@pytest.mark.parametrize("depth", [-1e-6, 0.0357, np.nan])
def test_depths_that_were_not_measured_are_refused(depth: float) -> None:
    with pytest.raises(ValueError, match=r"R1 P01.*0 to 0\.0356 m"):
        curve("R1", "P01").force(np.array((0.01, depth)))


def test_the_relaxed_people_have_the_known_medians() -> None:
    people = relaxed_people()
    assert len(people) == 48
    shallow = [exponent(curve(*place).force((0.005, 0.010))) for place in people]
    deep = [exponent(curve(*place).force((0.010, 0.020))) for place in people]
    assert np.median(shallow) == pytest.approx(1.19, abs=0.005)
    assert np.median(deep) == pytest.approx(1.37, abs=0.005)
    ratios = [fitted()[place].activated_ratio for place in people]
    assert min(ratios) > 1
    assert np.median(ratios) == pytest.approx(2.56, abs=0.05)


def test_every_relaxed_place_is_fitted() -> None:
    assert list(fitted()) == relaxed_people()
    for fit in fitted().values():
        assert 0 <= fit.zero_offset_m <= 0.002
        assert 0.004 < fit.wall.length_m < 0.03
        assert fit.tension > 0
