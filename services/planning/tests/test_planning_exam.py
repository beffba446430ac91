"""Tests of the whole examination in closed loop with a spring tissue and an ideal robot."""

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from planning_fakes import FRAME, PERIOD_S, RATES, World, hertz, known

from palpate_bus.messages.codes import Phase, Reason
from palpate_bus.setpoint import ControlMode
from palpate_models.scenario.schema import Mode, Robot
from palpate_planning.contact import ContactMeasurement, SensorReading
from palpate_planning.examination import ExaminationSequence
from palpate_planning.motion.kinematics import KINEMATIC_LIMITS
from palpate_planning.palpation import HIDDEN
from palpate_planning.reasons import NO_CAUSE, Cause, Loss
from palpate_planning.strokes.segments import STRETCHED


@pytest.fixture(scope="module")
def snake() -> World:
    world = World(known(pattern="snake"))
    world.run()
    return world


def phases(world: World) -> list[Phase]:
    order = [row[0] for row in world.rows]
    return [order[0]] + [b for a, b in pairwise(order) if a is not b]


def test_snake_goes_through_all_phases_in_order(snake: World) -> None:
    assert phases(snake) == [
        Phase.HOME,
        Phase.LOOK,
        Phase.PLAN,
        Phase.APPROACH,
        Phase.INDENT,  # a touch before the scan
        Phase.RETRACT,
        Phase.INDENT,
        Phase.SCAN,
        Phase.RETRACT,
        Phase.RETURN,
        Phase.ASSESS,
        Phase.DONE,
    ]
    assert snake.exam.status.end_tick == snake.t - 10_000_000 + 1_000_000_000
    assert snake.exam.status.targets_skipped == 0
    assert snake.exam.status.target_count == 12
    assert snake.exam.status.target_index == 11


def test_after_the_last_stroke_no_target_is_left(snake: World) -> None:
    palpation = snake.exam._course.palpation
    assert palpation is not None
    assert not palpation.remaining


def test_depth_is_true_while_samples_count(snake: World) -> None:
    steady = np.array([(row[3], row[4]) for row in snake.rows if row[1]])
    assert len(steady) > 300
    assert np.sqrt(np.mean((steady[:, 1] - 0.010) ** 2)) < 3e-4
    assert np.abs(steady[:, 1] - steady[:, 0]).max() < 1e-3


def test_setpoints_agree_with_their_feed_forward(snake: World) -> None:
    for a, b in pairwise(snake.setpoints):
        if a.mode is not b.mode:
            continue
        if a.mode is ControlMode.JOINT:
            assert np.abs(a.q + a.qd * PERIOD_S - b.q).max() < 2e-3
        else:
            step = b.p_WD - a.p_WD - a.V_WD[:3] * PERIOD_S
            assert np.linalg.norm(step) < 2e-4


@pytest.mark.parametrize(("pattern", "mode", "strokes"), [("raster", Mode.CONTINUOUS, 3), ("snake", Mode.POINT, 6)])
def test_raster_and_points_lift_between_strokes(pattern: str, mode: Mode, strokes: int) -> None:
    region = (0.025, 0.0125) if mode is Mode.POINT else (0.025, 0.025)
    world = World(known(pattern=pattern, mode=mode, region_m=region))
    world.run()
    assert world.exam.status.phase is Phase.DONE
    order = phases(world)
    assert order.count(Phase.INDENT) == strokes + 1, "and a touch before the scan"
    assert order.count(Phase.SCAN) == strokes


@pytest.mark.parametrize("offset", [-0.012, 0.0003, 0.015])
def test_touch_corrects_a_camera_that_is_off(offset: float) -> None:
    world = World(known(region_m=(0.025, 0.0125)), offset=offset)
    touched = []
    while world.exam.status.end_tick < 0:
        step = world.step()
        touched += [] if step.touched is None else [step.touched]
    assert world.exam.status.phase is Phase.DONE
    assert [touch.stroke for touch in touched] == [1, 2, 3], "before the scan and at each line"
    for touch in touched:
        assert abs(touch.height - offset) < 3 * touch.sigma
    assert touched[-1].expected == pytest.approx(offset, abs=3 * touched[-1].expected_sigma)
    steady = np.array([row[4] for row in world.rows if row[1]])
    assert np.sqrt(np.mean((steady - 0.010) ** 2)) < 6e-4


def test_no_tissue_where_it_should_be_looks_again_then_gives_up() -> None:
    world = World(known(region_m=(0.025, 0.025)), offset=-0.05)
    looks = depth = 0.0
    while world.exam.status.end_tick < 0:
        step = world.step()
        looks += step.trigger
        depth = max(depth, -0.05 if step.contact is None else step.contact.depth - step.contact.wall.correction)
    status = world.exam.status
    assert (status.phase, status.cause.reason, looks) == (Phase.ABORTED, Reason.NO_TISSUE, 2)
    assert 0.018 < depth < 0.021, "it ends about 20 mm below where the skin is believed"
    assert sum(cause.loss is Loss.NO_CONTACT for cause in world.exam.unfelt.values()) == status.target_count


def test_a_force_sensor_that_freezes_is_neither_pressed_deep_nor_called_complete() -> None:
    """It freezes in the first scan. Next to a touched place the next descent ends 3 SD below the depth of the examination."""
    world, frozen = World(known(pattern="raster", region_m=(0.025, 0.025))), []
    world.run(lambda: world.exam.status.phase is Phase.SCAN)
    sense = world.exam._sense.sense

    def freeze(reading: SensorReading, t: int, *others: float) -> ContactMeasurement:
        frozen.append(reading.wrench_S)
        return sense(reading._replace(wrench_S=frozen[0]), t, *others)

    world.exam._sense.sense = freeze  # type: ignore[method-assign]
    world.run(seconds=200.0)
    assert world.exam.status.phase is Phase.ABORTED
    assert max(row[4] for row in world.rows) < 0.0135
    assert Counter(cause.loss for cause in world.exam.unfelt.values())[Loss.NO_CONTACT] >= 6


def test_a_touch_ends_on_very_soft_skin_with_wrong_forecasts() -> None:
    """The depth limit of the descent changes with every forecast."""
    world = World(known(region_m=(0.025, 0.0125)), hertz(0.4), excursion=lambda t: 4e-3 * float(np.sin(2 * np.pi * t / 4)))
    world.misled = 4e-4
    world.run(seconds=60.0)
    assert world.exam.status.phase is Phase.DONE


def test_force_limit_makes_depth_yield() -> None:
    world = World(known(region_m=(0.025, 0.0125)), hertz(30.0))
    world.run()
    assert world.exam.status.phase is Phase.DONE
    steady = [row for row in world.rows if row[1]]
    assert steady
    assert all(row[2] for row in steady), "every sample is flagged"
    assert max(row[5] for row in world.rows) < 15.0
    assert np.median([row[5] for row in steady]) > 11.0
    assert np.median([row[4] for row in steady]) < 0.007


def test_soft_stop_skips_targets_then_gives_up() -> None:
    world = World(known())
    world.run(lambda: world.exam.status.phase is Phase.SCAN)
    world.force = lambda depth: 40.0 if depth > 0.001 else 0.0
    world.run()
    assert world.exam.status.phase is Phase.ABORTED
    assert world.exam.status.cause.reason is Reason.FORCE
    assert world.exam.status.targets_skipped >= 3


@pytest.mark.parametrize(
    ("cause", "count", "phase", "text"),
    [
        (STRETCHED, 20, Phase.DONE, "incomplete"),
        (Cause(Reason.OPERATOR_END, "enough"), 20, Phase.DONE, "incomplete"),
        (Cause(Reason.CONTACT_LOST, "contact was lost"), 2, Phase.DONE, "incomplete"),
        (
            Cause(Reason.CONTACT_LOST, "contact was lost"),
            3,
            Phase.ABORTED,
            "3 of 20 targets not felt: 3 targets skipped: contact",
        ),
        (NO_CAUSE, 0, Phase.DONE, "examination complete"),
    ],
)
def test_only_what_is_complete_is_called_so(cause: Cause, count: int, phase: Phase, text: str) -> None:
    exam = ExaminationSequence(known(), PERIOD_S, FRAME, RATES)
    exam.status.target_count, exam.skipped = 20, dict.fromkeys(range(count), cause)
    exam._conclude(0)
    assert exam.status.phase is phase
    assert text in exam.status.message


def test_targets_out_of_reach_are_skipped_counted_and_named() -> None:
    world = World(known(Robot(base_xy_m=(-0.25, 0.0)), region_m=(0.15, 0.0125), centre_m=(0.0, 0.0)))
    world.run()
    status = world.exam.status
    assert status.phase is Phase.DONE
    assert 0 < status.targets_skipped < status.target_count
    assert len(world.exam.skipped) == status.targets_skipped
    assert next(iter(world.exam.skipped.values())).reason is Reason.OUT_OF_REACH


def test_the_arm_does_not_stretch_to_skin_deeper_than_perceived() -> None:
    world = World(known(Robot(base_xy_m=(-0.165, 0.0)), region_m=(0.15, 0.025), centre_m=(0.0, 0.0)), offset=-0.015)
    bend = []
    while world.exam.status.end_tick < 0:
        world.step()
        bend.append(-world.q[3])
    assert world.exam.status.phase is Phase.DONE
    assert min(bend[500:]) > 0.75 * KINEMATIC_LIMITS.too_straight_rad, (
        "after it has left home, and to the side to which it was planned"
    )
    assert STRETCHED in world.exam.skipped.values()
    assert any(row[1] for row in world.rows), "it measured where it reaches"


def test_a_stroke_on_which_the_arm_hides_the_wall_is_skipped() -> None:
    world = World(known(pattern="raster", region_m=(0.05, 0.05)), excursion=lambda t: 0.0)
    lines = np.unique(np.round(world.dome.positions[:, 1], 4))
    world.hides = lambda p_WI: bool(abs(p_WI[1] - lines[1]) < 0.005 and p_WI[0] > np.median(world.dome.positions[:, 0]))
    world.run()
    assert world.exam.status.phase is Phase.DONE
    passed_over = list(world.exam.skipped)
    assert set(world.exam.skipped.values()) == {HIDDEN}
    assert 1 <= len(passed_over) <= len(world.dome.positions) / len(lines), "what is left of that line"
    assert np.abs(world.dome.positions[passed_over, 1] - lines[1]).max() < 0.005
    assert world.t < 60 * 1_000_000_000, "it did not wait there"


def test_no_target_in_reach_aborts() -> None:
    world = World(known(Robot(base_xy_m=(-0.9, 0.0))))
    world.run()
    assert world.exam.status.phase is Phase.ABORTED
    assert world.exam.status.cause.reason is Reason.NO_PATH


def test_a_blocked_view_is_reported_and_the_next_posture_tried() -> None:
    world = World(known())
    world.answers = [Cause(Reason.VIEW_BLOCKED, "view blocked by the arm"), world.dome]
    states = []
    while world.exam.status.phase is not Phase.PLAN:
        world.step()
        states.append((world.exam.status.view_blocked, world.exam.status.cause.reason))
        assert world.t < 30e9
    assert (True, Reason.VIEW_BLOCKED) in states
    assert not world.exam.status.view_blocked
    assert not np.allclose(world.q, world.exam._views.postures[0], atol=0.1)


def test_the_scan_is_repeated_without_an_answer_then_given_up() -> None:
    world = World(known())
    world.run(lambda: world.exam.status.phase is Phase.LOOK)
    while world.exam.status.end_tick < 0:
        world._answer_at = None
        world.step()
        assert world.t < 60e9
    assert world.exam.status.cause.reason is Reason.VIEW_TIMEOUT


def test_lost_assessment_in_contact_lifts_off() -> None:
    world = World(known())
    world.run(lambda: world.exam.status.phase is Phase.SCAN)
    world.lost = Cause(Reason.SERVICE_LOST, "lost assessment")
    for _ in range(100):
        world.step()
    assert world.pressed == 0.0
    assert world.exam.status.cause.reason is Reason.SERVICE_LOST


def test_robot_away_from_home_is_brought_there() -> None:
    world = World(known())
    world.q = world.q + np.array([0.4, 0.1, 0.0, 0.2, 0.0, -0.1, 0.5])
    world.run(lambda: world.exam.status.phase is Phase.PLAN)
    assert np.abs(world.q - world.exam._views.postures[0]).max() < 0.02


def test_speed_of_the_tool_in_contact_is_the_one_asked_for(snake: World) -> None:
    speeds = [np.linalg.norm(s.V_WD[:3]) for s, row in zip(snake.setpoints, snake.rows, strict=True) if row[0] is Phase.SCAN]
    assert np.median(speeds) == pytest.approx(0.03, rel=0.05)
    assert max(speeds) < 0.036


def test_three_blocked_views_abort() -> None:
    world = World(known())
    world.answers = [Cause(Reason.VIEW_BLOCKED, "view blocked by the arm")]
    world.run()
    assert world.exam.status.phase is Phase.ABORTED
    assert world.exam.status.cause.reason is Reason.VIEW_BLOCKED
    assert world.exam._views.failed == 3
