"""Tests of breathing forecasts and of the reaction to deviations from them."""

from itertools import pairwise

import numpy as np
import pytest
from planning_fakes import SMALL, World, known

from palpate_bus.messages import SurfaceMotion
from palpate_bus.messages.codes import Phase, Reason
from palpate_bus.setpoint import ControlMode
from palpate_models.scenario.schema import Following
from palpate_planning.interruptions import RECOVERY, WALL, WallWatch
from palpate_planning.periods import MS, SECOND
from palpate_planning.reasons import Cause
from palpate_planning.stroke import StrokeStage
from palpate_planning.strokes.plan import PerceivedAbdomen, nearest_targets
from palpate_planning.waits import Tally
from palpate_planning.wall.breath import FORECAST_STEP, TUNING, Breath, BreathObservation

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
    assert breath.displacement(200 * MS + round(TUNING.join_s * SECOND)) == pytest.approx(0.004 - 0.002 / np.e)


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
