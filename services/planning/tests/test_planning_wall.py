"""The wall as planning knows it: surface, touches and their correction, forecasts of the breath and deviations from them."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from planning_fakes import SMALL, World, grid_mesh, known
from scipy.interpolate import CubicSpline

from palpate_bus.messages import SurfaceMotion
from palpate_bus.messages.codes import Phase, Reason
from palpate_bus.setpoint import ControlMode
from palpate_models.numerics.frames import apply, matrix
from palpate_models.scenario.schema import Following
from palpate_models.section import Pose
from palpate_planning.interruptions import RECOVERY, WALL, WallWatch
from palpate_planning.periods import MS, SECOND
from palpate_planning.reasons import Cause, Tally
from palpate_planning.stroke import StrokeStage
from palpate_planning.strokes.plan import PerceivedAbdomen, nearest_targets
from palpate_planning.wall.surface import BicubicField, CubicPieces, PerceivedSurface, bicubic_at, cubic_at
from palpate_planning.wall.touch import FELT_N, TUNING, Onset, find_touch
from palpate_planning.wall.wall import (
    FORECAST_STEP,
    PRIOR,
    TUNING as JOINING,
    Breath,
    BreathObservation,
    HeightMeasurement,
    TouchCorrection,
)

X_WA = matrix(Pose(xyz_m=(0.56, 0.05, 0.93), rpy_rad=(0.05, -0.08, 0.3)))
VERTICES, TRIANGLES = grid_mesh((0.14, 0.14))
SURFACE = PerceivedSurface.from_mesh(apply(X_WA, VERTICES), None, X_WA)
inner = st.floats(-0.1, 0.1)


def dome(x: float, y: float) -> tuple[np.ndarray, np.ndarray]:
    """Exact point and outward normal in world."""
    n = np.array((x / 0.25, y / 0.6, 1.0))
    p = np.array((x, y, -x * x / 0.5 - y * y / 1.2))
    return apply(X_WA, p[None])[0], X_WA[:3, :3] @ n / np.linalg.norm(n)


@given(inner, inner)
@settings(deadline=None)
def test_points_and_normals_are_those_of_the_dome(x: float, y: float) -> None:
    p, n = SURFACE.at(np.array([[x, y]]))
    exact_p, exact_n = dome(x, y)
    assert p[0] == pytest.approx(exact_p, abs=1e-4)
    assert n[0] == pytest.approx(exact_n, abs=5e-3)


@given(inner, inner, st.floats(-0.01, 0.03))
@settings(deadline=None)
def test_nearest_finds_the_foot_of_the_perpendicular(x: float, y: float, height: float) -> None:
    p, n = (a[0] for a in SURFACE.at(np.array([[x, y]])))
    foot, normal, distance, _ = SURFACE.nearest(p + height * n)
    assert foot == pytest.approx(p, abs=2e-5)
    assert normal == pytest.approx(n, abs=2e-4)
    assert distance == pytest.approx(height, abs=1e-6)


def test_given_normals_are_used() -> None:
    exact = np.array([dome(x, y)[1] for x, y in VERTICES[:, :2]])
    surface = PerceivedSurface.from_mesh(apply(X_WA, VERTICES), exact, X_WA)
    _, n = surface.at(np.array([[0.071, -0.043]]))
    assert n[0] == pytest.approx(dome(0.071, -0.043)[1], abs=1e-5)


def test_before_perception_depth_is_counted_from_the_plane_of_a() -> None:
    _, normal, distance, _ = PerceivedSurface.plane(X_WA).nearest(apply(X_WA, np.array([[0.02, 0.03, 0.04]]))[0])
    assert distance == pytest.approx(0.04)
    assert normal == pytest.approx(X_WA[:3, 2])


@pytest.mark.parametrize(
    ("vertices", "named"), [(np.zeros((3, 3)), "3 vertices"), (np.zeros((30, 3)), "spans")], ids=["few", "flat"]
)
def test_a_mesh_without_extent_is_refused(vertices: np.ndarray, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        PerceivedSurface.from_mesh(vertices, None, X_WA)


def test_curve_and_field_at_one_point_are_those_of_scipy_at_many() -> None:
    rng = np.random.default_rng(5)
    knots = np.cumsum(rng.uniform(0.1, 1.0, 12))
    curve = CubicSpline(knots, rng.normal(size=(12, 16)), bc_type="natural")
    for s in (*knots[[0, 5, -1]].tolist(), *rng.uniform(knots[0], knots[-1], 5).tolist()):
        value, derivative = cubic_at(CubicPieces(curve.x, curve.c), s)
        assert value == pytest.approx(curve(s), abs=1e-12)
        assert derivative == pytest.approx(curve(s, 1), abs=1e-11)
    field = BicubicField(np.linspace(-1.0, 2.0, 13), np.linspace(0.0, 1.0, 9), rng.normal(size=(13, 9, 3)))
    corners, outside = [(-1.0, 0.0), (2.0, 1.0), (0.25, 0.5)], [(-3.0, 0.4), (5.0, 7.0)]
    for x, y in (*corners, *outside, *rng.uniform((-1, 0), (2, 1), (5, 2)).tolist()):
        assert bicubic_at(field.spline, x, y) == pytest.approx(field(np.array((x, y))), abs=1e-12)


PLACES = np.array([(x, y) for x in (-0.07, 0.0, 0.07) for y in (-0.07, 0.0, 0.07)])
BETWEEN = np.array([(x, y) for x in (-0.05, 0.03) for y in (-0.04, 0.06)])


def tilted(xy: np.ndarray) -> np.ndarray:
    """[m] outward."""
    return np.asarray(0.015 + xy @ np.array((0.012, -0.008)))


def test_errors_agree_with_the_reported_sd() -> None:
    rng = np.random.default_rng(3)
    everywhere = np.vstack((PLACES, BETWEEN))
    apart = np.sum((everywhere[:, None] - everywhere) ** 2, axis=-1)
    covariance = PRIOR.offset_m**2 + PRIOR.tilt_rad**2 * everywhere @ everywhere.T
    covariance += PRIOR.field_m**2 * np.exp(-apart / (2 * PRIOR.field_length_m**2))
    scores = []
    for _ in range(50):
        truth = rng.multivariate_normal(np.zeros(len(everywhere)), covariance)
        correction = TouchCorrection()
        for place, height in zip(PLACES, truth, strict=False):
            correction.touch(HeightMeasurement(place, float(height + 4e-4 * rng.standard_normal()), 4e-4))
        scores += [(correction.height(p) - h) / correction.at(p)[1] for p, h in zip(BETWEEN, truth[len(PLACES) :], strict=True)]
    assert np.std(scores) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize(("rough_m", "most_m", "roughness"), [(0.0, 0.3e-3, (0.0, 0.3)), (1.2e-3, 1.5e-3, (0.5, 2.0))])
def test_touches_determine_the_roughness_of_the_error(rough_m: float, most_m: float, roughness: tuple[float, float]) -> None:
    """After 25 touches a smooth error is known to within the error of a touch, a rough one is not."""
    rng = np.random.default_rng(5)
    places = np.array([(x, y) for x in np.linspace(-0.09, 0.09, 5) for y in np.linspace(-0.09, 0.09, 5)])
    correction = TouchCorrection()
    for place in places:
        height = tilted(place) + rough_m * rng.standard_normal() + 2e-4 * rng.standard_normal()
        correction.touch(HeightMeasurement(place, float(height), 2.5e-4))
    assert roughness[0] <= correction._fit.roughness <= roughness[1]
    assert correction.at(np.array((0.02, 0.02)))[1] < most_m


def test_the_latest_touch_can_be_revised() -> None:
    revised, right = TouchCorrection(), TouchCorrection()
    for correction in (revised, right):
        correction.touch(HeightMeasurement(PLACES[0], 0.004, 4e-4))
    revised.touch(HeightMeasurement(PLACES[1], 0.006, 9e-4))
    revised.revise(HeightMeasurement(PLACES[1], 0.005, 4e-4))
    right.touch(HeightMeasurement(PLACES[1], 0.005, 4e-4))
    assert revised.at(PLACES[2]) == pytest.approx(right.at(PLACES[2]))


def test_a_new_scan_keeps_offset_and_tilt_learned_from_touches() -> None:
    correction = TouchCorrection()
    for place in PLACES:
        correction.touch(HeightMeasurement(place, float(tilted(place)), 3e-4))
    before = correction.at(PLACES[0])[1]
    correction.blur()
    assert correction.at(PLACES[0])[1] > before
    for place in BETWEEN:
        assert correction.height(place) == pytest.approx(float(tilted(place)), abs=5e-4)


def test_a_better_surface_needs_a_smaller_correction() -> None:
    rng = np.random.default_rng(5)
    apart = np.sum((PLACES[:, None] - PLACES) ** 2, axis=-1)
    bent = rng.multivariate_normal(
        np.zeros(len(PLACES)), (2 * PRIOR.field_m) ** 2 * np.exp(-apart / (2 * PRIOR.field_length_m**2))
    )
    correction = TouchCorrection()
    for place, field in zip(PLACES, bent, strict=True):
        correction.touch(HeightMeasurement(place, float(tilted(place) + field), 2e-4))
    better = correction.for_surface(lambda xy: bent[[int(np.argmin(np.sum((PLACES - p) ** 2, axis=1))) for p in xy]])
    assert better._fit.roughness < correction._fit.roughness
    heights, sigmas = better.over(BETWEEN)
    assert heights == pytest.approx(tilted(BETWEEN), abs=2e-4)
    assert (sigmas < [correction.at(place)[1] for place in BETWEEN]).all()


def test_successive_touches_share_the_error_of_the_breath() -> None:
    """Nine touches within three seconds leave the error of the breath in the offset; within three minutes they average it."""
    sigmas = []
    for spacing_s in (1 / 3, 20.0):
        correction = TouchCorrection()
        for number, place in enumerate(PLACES):
            correction.touch(HeightMeasurement(place, 0.004, 1e-4, 5e-4, number * spacing_s))
        sigmas.append(correction.at(PLACES[4])[1])
    assert sigmas[0] == pytest.approx(5e-4, rel=0.2)
    assert sigmas[1] < 0.7 * sigmas[0]


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
    assert abs(touch.depth) < min(0.0015, 4 * touch.sigma)


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


DT = 0.01


def motion(stamp: int, *forecast: float, calm: bool = True, moved: bool = False) -> BreathObservation:
    return BreathObservation(stamp, np.array(forecast), 3e-4, calm, moved)


def received(*motions: BreathObservation, late: int = 100 * MS) -> Breath:
    """Return a breath that received each message `late` [ns] after its exposure."""
    breath = Breath()
    for one in motions:
        breath.receive(one, one.stamp + late)
    return breath


def breathing(t_s: float) -> float:
    """8 mm peak to peak, 14 a minute [m]."""
    return 0.004 * (1 - float(np.cos(2 * np.pi * 14 / 60 * t_s)))


def test_in_between_the_forecast_is_interpolated() -> None:
    breath = received(motion(SECOND, 0.0, 0.001, 0.003))
    assert breath.displacement(SECOND + 75 * MS) == pytest.approx(0.002)
    assert breath.displacement(3 * SECOND) == pytest.approx(0.003)


def test_a_new_forecast_is_joined_without_a_step() -> None:
    breath = received(motion(0, 0.002, 0.002), motion(100 * MS, 0.004, 0.004))
    assert breath.displacement(200 * MS) == pytest.approx(0.002)
    assert breath.displacement(200 * MS + round(JOINING.join_s * SECOND)) == pytest.approx(0.004 - 0.002 / np.e)


@pytest.mark.parametrize(("wall_m", "left_m"), [(-0.030, 0.026), (0.030, 0.030 * float(np.exp(-4 / 3)))])
def test_a_wall_that_leaps_inward_is_followed_slowly_and_outward_at_once(wall_m: float, left_m: float) -> None:
    breath = received(motion(0, 0.0, 0.0), motion(100 * MS, wall_m, wall_m), late=0)
    assert abs(breath.displacement(140 * MS) - wall_m) == pytest.approx(left_m)


def test_a_forecast_that_is_too_old_is_not_relied_on() -> None:
    breath = received(motion(0, 0.0, 0.0), late=0)
    assert [breath.calm(t * MS) for t in (400, 600)] == [True, False]


def test_a_spoiled_wall_is_left_alone_until_it_has_been_calm() -> None:
    watch = WallWatch(breath := Breath(), Following.FOLLOW, DT, Tally())
    breath.receive(motion(0, 0.0, calm=False), 0)
    watch.step(0, contact_lost=False)
    assert watch.spoiled and not watch.calm
    steps = 0
    while not watch.calm:
        breath.receive(motion(0, 0.0), 0)
        watch.step(0, contact_lost=False)
        steps += 1
    assert steps * DT == pytest.approx(WALL.calm_s, abs=0.02)


def test_a_contact_that_is_lost_again_and_again_ends_the_strokes() -> None:
    watch = WallWatch(Breath(), Following.FOLLOW, DT, Tally())
    losses = steps = 0
    while not watch.ended:
        watch.step(0, contact_lost=True)
        losses += watch.spoiled
        steps += 1
    assert losses == WALL.contact_losses_max
    assert steps * DT == pytest.approx(WALL.contact_losses_max * WALL.contact_lost_s, rel=0.05)


def test_a_wall_is_hidden_after_a_while_but_not_by_an_arm_that_is_leaving() -> None:
    watch = WallWatch(breath := Breath(), Following.FOLLOW, DT, Tally())
    breath.receive(motion(0, 0.0, calm=False)._replace(seen=False), 0)
    for leaving, hidden in ((True, False), (False, True), (True, False)):
        for _ in range(round(1.1 * WALL.hidden_timeout_s / DT)):
            watch.step(0, contact_lost=False, on_free_motion=leaving)
        assert watch.hidden is hidden


def test_gated_samples_are_those_of_the_end_of_expiration() -> None:
    watch = WallWatch(breath := Breath(), Following.GATE, DT, Tally())
    for displacement, open_ in ((0.0, True), (0.006, False)):
        breath.receive(motion(0, displacement), 0)
        watch.step(SECOND, contact_lost=False)
        assert watch.open is open_


@pytest.mark.parametrize("following", ["follow", "gate"])
def test_a_breathing_wall_is_palpated_at_the_requested_depth(following: str) -> None:
    world = World(known(breathing=following, **SMALL), offset=0.006, excursion=breathing)
    world.complete()
    assert sum(row[1] for row in world.rows) > 100
    assert world.depth_error() < 6e-4


def test_a_part_disturbed_by_coughs_is_repeated_until_it_is_felt() -> None:
    world, strokes = World(known(region_m=(0.05, 0.0125)), excursion=breathing), []
    for _ in range(2 * RECOVERY.repeats_max):
        world.run_to(Phase.SCAN)
        strokes.append(world.status.stroke)
        world.calm = False
        world.steps(100)
        assert world.pressed == 0.0
        assert not world.status.steady
        world.calm = True
    assert np.diff(strokes).tolist() == [1] * (len(strokes) - 1)
    world.complete()


def test_the_rest_of_an_abandoned_stroke_is_passed_above_the_skin() -> None:
    """The next motion starts at the end of the stroke, and the set-point must not jump there."""
    world = World(known(region_m=(0.05, 0.0125)), excursion=breathing)
    for _ in range(RECOVERY.repeats_max + 1):
        world.run_to(Phase.SCAN)
        world.steps(10)
        felt, world.force = world.force, lambda depth: 0.0  # contact is lost
        world.run(lambda: world.status.phase is not Phase.SCAN)
        world.force = felt
    world.run()
    assert world.status.phase is Phase.ABORTED, "more than a tenth of the targets is lost"
    assert {cause.reason for cause in world.exam.skipped.values()} == {Reason.WALL_NOT_TRACKED}
    there = [pair for pair in pairwise(world.setpoints) if all(s.mode is ControlMode.CARTESIAN for s in pair)]
    assert max(float(np.linalg.norm(b.p_WD - a.p_WD)) for a, b in there) < 0.005


def moved_in_the_second_stroke(*answers: PerceivedAbdomen | Cause) -> World:
    """Return an examination within a second of detected patient motion; later scans have these answers."""
    world = World(known(region_m=(0.025, 0.025)), excursion=breathing)
    world.answers += answers
    world.reach(StrokeStage.SLIDE, 3)
    world.moved = True
    world.steps(100)
    assert world.depth < -0.008
    assert world.status.patient_moved
    return world


def test_after_patient_motion_a_new_scan_continues_the_examination() -> None:
    world = moved_in_the_second_stroke()
    strokes, first = world.status.stroke, world.exam._course.palpation
    assert world.status.phase is Phase.LOOK
    world.shift_A = (0.008, -0.003)
    world.run_to(Phase.SCAN)
    assert world.status.stroke > strokes
    assert not world.status.patient_moved
    second = world.exam._course.palpation
    assert first is not None and second is not None
    assert second.recovery.tally is first.recovery.tally, "a new plan does not renew the limits"
    contact = world.exam._course.contact
    place = world.exam._sense.wall.perceived.xy(contact.wall_point[0])
    assert place == pytest.approx(contact.foot.xy_A - (0.008, -0.003), abs=5e-4)
    world.complete()


@pytest.mark.parametrize("mode", ["continuous", "point"])
def test_what_was_felt_in_the_last_second_before_motion_is_noticed_is_repeated(mode: str) -> None:
    world = World(known(region_m=(0.025, 0.025), mode=mode), excursion=breathing)
    world.reach(StrokeStage.TRANSFER, 3)
    first = world.exam._course.palpation
    assert first is not None
    felt = int(first._segments[first._number - 1].path.targets[-1])
    assert felt not in first.remaining
    world.moved = True
    world.run_to(Phase.LOOK)
    assert felt in first.ahead
    world.complete()


def test_targets_of_a_new_scan_are_known_by_their_places() -> None:
    before = np.array([(0.01 * k, 0.0, 0.0) for k in range(5)])
    assert nearest_targets(before, before[::-1] + 0.02).tolist() == [4, 3, 2, 1, 0]
    assert nearest_targets(before, np.array([(0.005 * k, 0.001 * k, 0.0) for k in range(9)])).tolist()[::2] == [0, 1, 2, 3, 4]


def test_a_patient_who_moved_out_of_view_is_assessed_from_the_samples_before() -> None:
    world = moved_in_the_second_stroke(Cause(Reason.VIEW_FAILED, "a curtain"))
    world.run()
    assert world.status.phase is Phase.DONE
    assert 0 < world.status.targets_skipped < world.status.target_count
    assert world.exam.skipped.popitem()[1].reason is Reason.PATIENT_MOVED


def test_measured_displacements_cover_the_past_only() -> None:
    breath = received(motion(SECOND, 0.001, 0.0), motion(SECOND + 100 * MS, 0.003, 0.0))
    assert breath.measured_at(np.array([SECOND, SECOND + 50 * MS])) == pytest.approx([0.001, 0.002])
    assert breath.measured_at(np.array([SECOND, SECOND + 150 * MS])) is None


def test_uncertainty_grows_with_age_and_previous_errors_of_forecasts() -> None:
    good, bad = (received(*(motion(k * 100 * MS, *[(-1) ** k * step] * 11) for k in range(10))) for step in (0.0, 5e-4))
    t = SECOND + 50 * MS
    assert good.uncertainty(t) == pytest.approx(3e-4)
    assert bad.uncertainty(t) > 5e-4
    assert bad.uncertainty(t + 50 * MS) > bad.uncertainty(t)


def test_the_forecast_is_read_at_the_times_that_the_message_says() -> None:
    assert FORECAST_STEP == SurfaceMotion.FORECAST_STEP_MS * MS


def test_lifting_ends_with_a_changing_uncertainty_of_the_wall(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Breath, "uncertainty", lambda breath, t: 0.003 + 0.001 * np.sin(t / 37_000_000))
    World(known(**SMALL), excursion=breathing).complete()
