"""A stopped examination: it waits, goes on where it was, or ends."""

from __future__ import annotations

import numpy as np
import pytest
from planning_fakes import World, known

from palpate_bus.setpoint import ControlMode
from palpate_models.robot import lbr
from palpate_planning.reasons import NO_CAUSE, Cause, Reason
from palpate_planning.status import Phase
from palpate_planning.stroke import StrokeStage

STOPPED = Cause(Reason.EMERGENCY_STOP, "force 26 N")
PHASES = [Phase.HOME, Phase.LOOK, Phase.PLAN, Phase.APPROACH, Phase.INDENT, Phase.SCAN, Phase.RETRACT, Phase.RETURN]


def stopped_in(phase: Phase, *, soft: bool, seconds: float = 1.0) -> World:
    world = World(known(region_m=(0.025, 0.0125)))
    world.q = world.q + np.array([0.2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    world.run(lambda: world.exam.status.phase is phase)
    for _ in range(20):
        world.step()
    if world.exam.status.phase is not phase:  # shorter than that
        world = World(known(region_m=(0.025, 0.0125)))
        world.run(lambda: world.exam.status.phase is phase)
    world.stop, world.soft = STOPPED, soft
    for _ in range(round(seconds / 0.01)):
        world.step()
    return world


@pytest.mark.parametrize("soft", [True, False], ids=["soft", "emergency"])
@pytest.mark.parametrize("phase", PHASES, ids=lambda phase: phase.name)
def test_released_it_goes_on_and_misses_nothing(phase: Phase, soft: bool) -> None:
    world = stopped_in(phase, soft=soft)
    status = world.exam.status
    assert status.phase is Phase.HELD
    assert status.reason is Reason.EMERGENCY_STOP
    assert status.end_tick < 0
    world.stop = NO_CAUSE
    world.run()
    assert world.exam.status.phase is Phase.DONE, world.exam.status.message
    assert world.exam.status.targets_skipped == 0
    centres = np.array([s.p_WD for s, row in zip(world.setpoints, world.rows, strict=True) if row[1]])
    for target in world.dome.positions:
        assert np.linalg.norm(centres - target, axis=1).min() < 0.009
    assert max(row[5] for row in world.rows) < 5.0, "going on presses no harder than before"


def test_a_soft_stop_in_contact_retreats_along_the_normal_and_waits() -> None:
    world = stopped_in(Phase.SCAN, soft=True, seconds=0.8)
    assert world.pressed == 0.0
    assert world.depth < -0.005
    where = world.kinematics.pose(world.q)[:3, 3]
    for _ in range(100):
        world.step()
    assert np.linalg.norm(world.kinematics.pose(world.q)[:3, 3] - where) < 1e-3


def test_in_an_emergency_stop_nothing_pulls_at_the_arm() -> None:
    world = stopped_in(Phase.SCAN, soft=False)
    world.q = world.q + 0.01
    outcome = world.step()
    assert outcome.setpoint.mode is ControlMode.JOINT
    assert np.array_equal(outcome.setpoint.q, world.q)
    assert not outcome.setpoint.qd.any()


def test_a_soft_stop_that_becomes_an_emergency_stop_is_left_to_the_driver() -> None:
    world = stopped_in(Phase.SCAN, soft=True, seconds=0.05)
    world.soft = False
    assert world.step().setpoint.mode is ControlMode.JOINT
    world.stop = NO_CAUSE
    world.run()
    assert world.exam.status.phase is Phase.DONE


@pytest.mark.parametrize("phase", [Phase.HOME, Phase.PLAN, Phase.SCAN], ids=lambda phase: phase.name)
@pytest.mark.parametrize("stopped", [True, False], ids=["stopped", "running"])
def test_an_operator_who_has_had_enough_gets_the_arm_home(phase: Phase, stopped: bool) -> None:
    world = stopped_in(phase, soft=False, seconds=1.0 if stopped else 0.0)
    world.stop = world.stop if stopped else NO_CAUSE
    world.end = Cause(Reason.OPERATOR_END, "enough")
    world.step()
    world.stop = NO_CAUSE
    world.run()
    assert world.exam.status.phase is Phase.ABORTED
    assert world.exam.status.reason is Reason.OPERATOR_END
    assert np.abs(world.q - lbr.HOME).max() < 0.02
    assert world.pressed == 0.0


def test_nobody_releases_it() -> None:
    world = stopped_in(Phase.SCAN, soft=False)
    world.run()
    status = world.exam.status
    assert status.phase is Phase.ABORTED
    assert status.reason is Reason.NOT_RELEASED
    assert world.t == pytest.approx(status.end_tick - 1_000_000_000 + 10_000_000)


def drawn_sideways(world: World) -> float:
    """Runs to the end; how far [m] a set-point is from an arm that is in the tissue, across the normal, at most."""
    begun, worst = len(world.rows), 0.0
    while world.exam.status.end_tick < 0 and len(world.rows) < begun + 500:
        p_W = world.kinematics.pose(world.q)[:3, 3]
        _, n, distance, _ = world.truth.nearest(p_W)
        setpoint = world.step().setpoint
        if world.settings.robot.indenter_radius_m > distance and setpoint.mode is ControlMode.CARTESIAN:
            gap = setpoint.p_WD - p_W
            worst = max(worst, float(np.linalg.norm(gap - (gap @ n) * n)))
    world.run()
    return worst


def push(world: World, aside: float, down: float) -> None:
    """Moves the arm along y and down [m]."""
    X = world.kinematics.pose(world.q)
    X[:3, 3] += (0.0, aside, -down)
    solution = world.kinematics.solve(X, world.q, world.q)
    assert solution.ok
    world.q = solution.q


def test_an_arm_that_was_pushed_aside_does_not_go_on_pressing() -> None:
    world = stopped_in(Phase.SCAN, soft=False)
    world.q = world.q + np.array([0.08, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    world.stop = NO_CAUSE
    assert drawn_sideways(world) < 0.002
    assert world.exam.status.phase is Phase.ABORTED
    assert world.exam.status.reason is Reason.ARM_DISPLACED


@pytest.mark.parametrize("phase", [Phase.SCAN, Phase.RETRACT], ids=lambda phase: phase.name)
@pytest.mark.parametrize("deeper", [False, True], ids=["as deep", "deeper"])
def test_an_arm_that_was_pushed_a_little_aside_lifts_before_it_goes_back(phase: Phase, deeper: bool) -> None:
    world = stopped_in(phase, soft=False)
    push(world, 0.015, 0.004 if deeper else 0.0)
    world.stop = NO_CAUSE
    assert drawn_sideways(world) < 0.002
    assert world.exam.status.phase is Phase.DONE, world.exam.status.message
    assert world.exam.status.targets_skipped == 0


def test_an_arm_that_was_pushed_into_the_tissue_between_two_strokes_lifts_before_it_goes_on() -> None:
    world = World(known(region_m=(0.025, 0.025), pattern="raster"))
    world.run(lambda: getattr(world.exam._course.palpation, "stage", None) is StrokeStage.TRANSFER)
    assert world.exam._course.palpation is not None
    assert world.exam._course.palpation.free_goal is None
    world.step()
    world.stop = STOPPED
    for _ in range(50):
        world.step()
    push(world, 0.01, 0.007 - world.depth)
    world.stop = NO_CAUSE
    world.step()
    assert world.depth > 0.005, "it is in the tissue"
    assert drawn_sideways(world) < 0.002
    assert world.exam.status.phase is Phase.DONE, world.exam.status.message
    assert world.exam.status.targets_skipped == 0


def test_lost_perception_while_held_ends_it() -> None:
    world = stopped_in(Phase.LOOK, soft=True)
    world.lost = ("perception",)
    world.run()
    assert world.exam.status.reason is Reason.SERVICE_LOST
