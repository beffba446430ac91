"""Tests of the whole examination in closed loop with a spring tissue and an ideal robot."""

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from planning_fakes import FRAME, PERIOD_S, RATES, SMALL, World, hertz, known

from palpate_bus.messages.codes import Phase, Reason
from palpate_bus.setpoint import ControlMode
from palpate_models.scenario.schema import Robot
from palpate_planning.contact import ContactMeasurement, SensorReading
from palpate_planning.examination import ExaminationSequence
from palpate_planning.motion.kinematics import KINEMATIC_LIMITS
from palpate_planning.palpation import HIDDEN
from palpate_planning.reasons import Cause, Loss
from palpate_planning.strokes.plan import STRETCHED


@pytest.fixture(scope="module")
def snake() -> World:
    world = World(known(pattern="snake"))
    world.run()
    return world


def phases(world: World) -> list[Phase]:
    order = [row[0] for row in world.rows]
    return [order[0]] + [b for a, b in pairwise(order) if a is not b]


def test_snake_goes_through_all_phases_in_order(snake: World) -> None:
    touch, scan = [Phase.INDENT, Phase.RETRACT], [Phase.INDENT, Phase.SCAN, Phase.RETRACT]
    before, after = [Phase.HOME, Phase.LOOK, Phase.PLAN, Phase.APPROACH], [Phase.RETURN, Phase.ASSESS, Phase.DONE]
    assert phases(snake) == before + touch + scan + after
    status = snake.status
    assert status.end_tick == snake.t - 10_000_000 + 1_000_000_000
    assert (status.targets_skipped, status.target_count, status.target_index) == (0, 12, 11)
    assert snake.exam._course.palpation is not None
    assert not snake.exam._course.palpation.remaining


def test_depth_is_true_while_samples_count(snake: World) -> None:
    steady = np.array([(row[3], row[4]) for row in snake.rows if row[1]])
    assert len(steady) > 300
    assert snake.depth_error() < 3e-4
    assert np.abs(steady[:, 1] - steady[:, 0]).max() < 1e-3


def test_setpoints_agree_with_their_feed_forward(snake: World) -> None:
    for a, b in pairwise(snake.setpoints):
        if a.mode is b.mode is ControlMode.JOINT:
            assert np.abs(a.q + a.qd * PERIOD_S - b.q).max() < 2e-3
        elif a.mode is b.mode:
            assert np.linalg.norm(b.p_WD - a.p_WD - a.V_WD[:3] * PERIOD_S) < 2e-4


@pytest.mark.parametrize(
    ("pattern", "mode", "high", "count"), [("raster", "continuous", 0.025, 3), ("snake", "point", 0.0125, 6)]
)
def test_raster_and_points_lift_between_strokes(pattern: str, mode: str, high: float, count: int) -> None:
    world = World(known(pattern=pattern, mode=mode, region_m=(0.025, high)))
    world.complete()
    order = phases(world)
    assert order.count(Phase.INDENT) == count + 1, "and a touch before the scan"
    assert order.count(Phase.SCAN) == count


@pytest.mark.parametrize("offset", [-0.012, 0.015])
def test_touch_corrects_a_camera_that_is_off(offset: float) -> None:
    world, touched = World(known(**SMALL), offset=offset), []
    while world.status.end_tick < 0:
        step = world.step()
        touched += [] if step.touched is None else [step.touched]
    assert world.status.phase is Phase.DONE
    assert [touch.stroke for touch in touched] == [1, 2, 3], "before the scan and at each line"
    assert all(abs(touch.height - offset) < 3 * touch.sigma for touch in touched)
    assert touched[-1].expected == pytest.approx(offset, abs=3 * touched[-1].expected_sigma)
    assert world.depth_error() < 6e-4


def test_no_tissue_where_it_should_be_looks_again_then_gives_up() -> None:
    world = World(known(region_m=(0.025, 0.025)), offset=-0.05)
    looks = depth = 0.0
    while world.status.end_tick < 0:
        step = world.step()
        looks += step.trigger
        depth = max(depth, -0.05 if step.contact is None else step.contact.depth - step.contact.wall.correction)
    assert (*world.end, looks) == (Phase.ABORTED, Reason.NO_TISSUE, 2)
    assert 0.018 < depth < 0.021, "it ends about 20 mm below where the skin is believed"
    assert sum(cause.loss is Loss.NO_CONTACT for cause in world.exam.unfelt.values()) == world.status.target_count


def test_a_force_sensor_that_freezes_is_neither_pressed_deep_nor_called_complete() -> None:
    """It freezes in the first scan. Next to a touched place the next descent ends 3 SD below the depth of the examination."""
    world, frozen = World(known(pattern="raster", region_m=(0.025, 0.025))), []
    world.run_to(Phase.SCAN)
    sense = world.exam._sense.sense

    def freeze(reading: SensorReading, t: int, *others: float) -> ContactMeasurement:
        frozen.append(reading.wrench_S)
        return sense(reading._replace(wrench_S=frozen[0]), t, *others)

    world.exam._sense.sense = freeze  # type: ignore[method-assign]
    world.run(seconds=200.0)
    assert world.status.phase is Phase.ABORTED
    assert max(row[4] for row in world.rows) < 0.0135
    assert Counter(cause.loss for cause in world.exam.unfelt.values())[Loss.NO_CONTACT] >= 6


def test_a_touch_ends_on_very_soft_skin_with_wrong_forecasts() -> None:
    """The depth limit of the descent changes with every forecast."""
    world = World(known(**SMALL), hertz(0.4), excursion=lambda t: 4e-3 * float(np.sin(2 * np.pi * t / 4)))
    world.misled = 4e-4
    world.complete(seconds=60.0)


def test_force_limit_makes_depth_yield() -> None:
    world = World(known(**SMALL), hertz(30.0))
    world.complete()
    steady = [row for row in world.rows if row[1]]
    assert steady
    assert all(row[2] for row in steady), "every sample is flagged"
    assert max(row[5] for row in world.rows) < 15.0
    assert np.median([row[5] for row in steady]) > 11.0
    assert np.median([row[4] for row in steady]) < 0.007


def test_soft_stop_skips_targets_then_gives_up() -> None:
    world = World(known())
    world.run_to(Phase.SCAN)
    world.force = lambda depth: 40.0 if depth > 0.001 else 0.0
    world.run()
    assert world.end == (Phase.ABORTED, Reason.FORCE)
    assert world.status.targets_skipped >= 3


@pytest.mark.parametrize(
    ("reason", "count", "phase"),
    [
        (Reason.ARM_STRETCHED, 20, Phase.DONE),
        (Reason.OPERATOR_END, 20, Phase.DONE),
        (Reason.CONTACT_LOST, 2, Phase.DONE),
        (Reason.CONTACT_LOST, 3, Phase.ABORTED),
        (Reason.NONE, 0, Phase.DONE),
    ],
)
def test_only_what_is_complete_is_called_so(reason: Reason, count: int, phase: Phase) -> None:
    exam = ExaminationSequence(known(), PERIOD_S, FRAME, RATES)
    exam.status.target_count, exam.skipped = 20, dict.fromkeys(range(count), Cause(reason, "the cause"))
    exam._conclude(0)
    assert exam.status.phase is phase
    assert ("incomplete" in exam.status.message) is ("the cause" in exam.status.message) is (count > 0)


def test_targets_out_of_reach_are_skipped_counted_and_named() -> None:
    world = World(known(Robot(base_xy_m=(-0.25, 0.0)), region_m=(0.15, 0.0125), centre_m=(0.0, 0.0)))
    world.run()
    assert world.status.phase is Phase.DONE
    assert 0 < world.status.targets_skipped == len(world.exam.skipped) < world.status.target_count
    assert next(iter(world.exam.skipped.values())).reason is Reason.OUT_OF_REACH


def test_the_arm_does_not_stretch_to_skin_deeper_than_perceived() -> None:
    world = World(known(Robot(base_xy_m=(-0.165, 0.0)), region_m=(0.15, 0.025), centre_m=(0.0, 0.0)), offset=-0.015)
    bend = []
    while world.status.end_tick < 0:
        world.step()
        bend.append(-world.q[3])
    assert world.status.phase is Phase.DONE
    away = bend[500:]  # from home, and to the side to which it was planned
    assert min(away) > 0.75 * KINEMATIC_LIMITS.too_straight_rad
    assert STRETCHED in world.exam.skipped.values()
    assert world.status.targets_skipped == len(world.exam.skipped)
    assert any(row[1] for row in world.rows), "it measured where it reaches"


def test_a_stroke_on_which_the_arm_hides_the_wall_is_skipped() -> None:
    world = World(known(pattern="raster", region_m=(0.05, 0.05)), excursion=lambda t: 0.0)
    p_W = world.dome.positions
    lines = np.unique(np.round(p_W[:, 1], 4))
    world.hides = lambda p_WI: bool(abs(p_WI[1] - lines[1]) < 0.005 and p_WI[0] > np.median(p_W[:, 0]))
    world.run(seconds=60.0)
    assert world.status.phase is Phase.DONE
    passed_over = list(world.exam.skipped)
    assert set(world.exam.skipped.values()) == {HIDDEN}
    assert 1 <= len(passed_over) <= len(p_W) / len(lines), "what is left of that line"
    assert np.abs(p_W[passed_over, 1] - lines[1]).max() < 0.005


def test_no_target_in_reach_aborts() -> None:
    world = World(known(Robot(base_xy_m=(-0.9, 0.0))))
    world.run()
    assert world.end == (Phase.ABORTED, Reason.NO_PATH)


def test_a_blocked_view_is_reported_and_the_next_posture_tried() -> None:
    world = World(known())
    world.answers = [Cause(Reason.VIEW_BLOCKED, "view blocked by the arm"), world.dome]
    states = []
    while world.status.phase is not Phase.PLAN:
        world.step()
        states.append((world.status.view_blocked, world.status.cause.reason))
        assert world.t < 30e9
    assert (True, Reason.VIEW_BLOCKED) in states
    assert not world.status.view_blocked
    assert not np.allclose(world.q, world.exam._views.postures[0], atol=0.1)


def test_lost_assessment_in_contact_lifts_off() -> None:
    world = World(known())
    world.run_to(Phase.SCAN)
    world.lost = Cause(Reason.SERVICE_LOST, "lost assessment")
    world.steps(100)
    assert world.pressed == 0.0
    assert world.status.cause.reason is Reason.SERVICE_LOST
    assert world.status.message == "aborted in phase RETRACT: lost assessment; the arm stays above the skin"


def test_speed_of_the_tool_in_contact_is_the_one_asked_for(snake: World) -> None:
    speeds = [np.linalg.norm(s.V_WD[:3]) for s, row in zip(snake.setpoints, snake.rows, strict=True) if row[0] is Phase.SCAN]
    assert np.median(speeds) == pytest.approx(0.03, rel=0.05)
    assert max(speeds) < 0.036


def test_three_blocked_views_abort() -> None:
    world = World(known())
    world.answers = [Cause(Reason.VIEW_BLOCKED, "view blocked by the arm")]
    world.run()
    assert world.end == (Phase.ABORTED, Reason.VIEW_BLOCKED)
    assert world.exam._views.failed == 3
