"""What nobody expects: a push in mid-air, a soft stop above the skin, a wall that is never calm, strokes left at their start."""

from __future__ import annotations

import numpy as np
from planning_fakes import World, known

from palpate_models.scenario import Following
from palpate_planning.breath import Breath, BreathObservation
from palpate_planning.requests import PressRequest
from palpate_planning.stages import StrokeStage
from palpate_planning.status import Phase
from palpate_planning.wall_watch import CALM_PATIENCE_S, WallWatch

SMALL = {"region_m": (0.025, 0.0125)}


def reached(world: World, stage: StrokeStage, stroke: int = 1) -> None:
    status = world.exam.status
    world.run(lambda: status.stroke >= stroke and status.message == stage.value)


def test_a_push_where_no_skin_can_be_is_no_touch() -> None:
    world = World(known(**SMALL))
    tissue, pushed = world.force, []

    def force(depth: float) -> float:
        pushes = world.exam.status.stroke == 2 and depth < -0.007 and len(pushed) < 5
        if pushes and world.exam.status.message == StrokeStage.DESCEND.value:
            pushed.append(depth)
            return 8.0
        return tissue(depth)

    world.force = force
    world.run()
    assert pushed
    assert world.exam.status.phase is Phase.DONE, world.exam.status.message
    assert world.exam.status.targets_skipped == 0
    assert max(row[4] for row in world.rows) < 0.0115, "no touch was taken from it"


def test_a_soft_stop_above_the_skin_lifts_the_arm() -> None:
    world = World(known(**SMALL))
    reached(world, StrokeStage.REST, stroke=1)
    world.stop, world.soft = "force 26 N", True
    for _ in range(100):
        world.step()
    assert world.depth < -0.02
    world.stop = ""
    world.run()
    assert world.exam.status.phase is Phase.DONE
    assert world.exam.status.targets_skipped == 0


def test_above_the_skin_nothing_is_pushed_back() -> None:
    world = World(known(**SMALL))
    reached(world, StrokeStage.REST, stroke=1)
    world.force = lambda depth: 6.0
    for _ in range(5):
        assert np.abs(world.step().setpoint.F_W).max() < 1e-9


def test_a_wall_that_is_calm_for_less_than_is_asked_for_ends_the_strokes_too() -> None:
    breath, watch = Breath(), None
    watch = WallWatch(breath, Following.FOLLOW, 0.1)
    for k in range(round(1.2 * CALM_PATIENCE_S / 0.1)):
        calm = k % 14 < 7  # 0.7 s each
        breath.hear(BreathObservation(k * 100_000_000, np.zeros(11), 1e-4, calm), k * 100_000_000)
        watch.step(k * 100_000_000, adrift=False)
    assert watch.ended


def test_a_stroke_that_is_left_before_it_slides_is_still_ahead() -> None:
    world = World(known(**SMALL))
    reached(world, StrokeStage.DESCEND, stroke=2)  # the first only touches
    palpation = world.exam._course.palpation
    assert palpation is not None
    palpation.leave("for another reason")
    assert sorted(palpation.ahead) == list(range(world.exam.status.target_count))


def test_a_place_asked_for_moves_with_the_body() -> None:
    moved = PressRequest(3, np.array((0.01, 0.02))).moved(np.array((0.008, -0.003)))
    assert moved.xy is not None
    assert np.allclose(moved.xy, (0.018, 0.017))
    assert PressRequest(4, None).moved(np.ones(2)).xy is None
