"""Stop, hold and resume: what happens to an examination that is stopped, and how it goes on or ends."""

from __future__ import annotations

from palpate_bus.setpoint import Setpoint
from palpate_models.numerics.frames import Array
from palpate_planning.course import ExamCourse
from palpate_planning.motion.planner import NoPathError
from palpate_planning.palpation import Palpation
from palpate_planning.periods import SECOND
from palpate_planning.status import OVER, PALPATING, Observation, Phase


class Stops:
    """Holds the examination while it is stopped, and takes it back to what was interrupted when the stop is released.

    After a soft stop in contact the arm retreats along the normal and waits. After any other stop the driver holds the arm, and
    planning asks for the posture in which it is: nothing is to pull when the driver lets go.
    """

    def __init__(self, course: ExamCourse, patience_s: float) -> None:
        """A stop that is not released within `patience_s` ends the examination."""
        self._course = course
        self._patience_s = patience_s
        self._soft = False
        """Whether the arm was left to planning all the time."""
        self._resuming = False
        """Whether the stop was released and the arm is on its way back."""

    def watch(self, now: Observation) -> None:
        """Holds the exam when it is stopped, ends it when a service that it needs is gone or an operator wants it to end."""
        if self._course.phase in OVER:
            return
        if now.stop and self._course.phase is not Phase.HELD:
            self._course.interrupted = self._course.phase
            self._hold(now)
        if now.lost:
            self._end_for_loss(now, f"lost {', '.join(now.lost)}")
        elif now.end:
            self._end_at_home(now, now.end)

    def step(self, now: Observation) -> Setpoint | None:
        """One step of a held examination; None where the arm's own free motion or rest gives the set-point."""
        if not now.stop:
            self._resume(now)
            return None
        if self._resuming:
            self._hold(now)
        self._soft = self._soft and now.soft
        if now.t - self._course.since > self._patience_s * SECOND:
            self._course.abort(now, f"nobody released it within {self._patience_s:g} s: {now.stop}")
        elif not self._soft:
            assert now.reading is not None
            self._course.arm.hold(now.reading.q)
        elif (palpation := self._interrupted_palpation) is not None and palpation.free_goal is None:
            return palpation.step(now.t, self._course.contact, self._course.rate).setpoint
        return None

    @property
    def _interrupted_palpation(self) -> Palpation | None:
        """The palpation, if it is what was interrupted."""
        return self._course.palpation if self._course.interrupted in PALPATING else None

    def _hold(self, now: Observation) -> None:
        """Lets the examination retreat, or leaves the arm to the driver."""
        assert now.reading is not None
        self._soft, self._resuming = now.soft, False
        self._course.arm.hold(now.reading.q)
        if (palpation := self._interrupted_palpation) is not None:
            palpation.pause()
        self._course.enter(Phase.HELD, now.t, f"held in phase {self._course.interrupted.name}: {now.stop}")

    def _resume(self, now: Observation) -> None:
        """Goes back to what was interrupted, by a new motion where that was a free motion."""
        course, palpation = self._course, self._interrupted_palpation
        self._resuming = True
        goal = self._free_goal
        if goal is not None:
            try:
                if not course.arm.move_to(now.t, goal, course.perceived):
                    return
            except NoPathError as error:
                course.abort(now, f"no way back to where it was held: {error}")
                return
        course.enter(course.interrupted, now.t, "released, going on")
        if palpation is None:
            return
        if goal is None:
            palpation.resume(now.t, course.contact)
        else:
            palpation.skip_free_motion()

    @property
    def _free_goal(self) -> Array | None:
        """Where the interrupted free motion of the plan was to end [rad], shape (7,); None if it was none."""
        palpation, plan = self._interrupted_palpation, self._course.plan
        if palpation is not None:
            return palpation.free_goal
        if self._course.interrupted is Phase.APPROACH and plan is not None:
            goal: Array = plan.approach.q[-1]
            return goal
        return None

    def _end_for_loss(self, now: Observation, why: str) -> None:
        """Ends the exam: in contact by lifting off and going home, if planning has the arm, else where the arm is."""
        course, held = self._course, self._course.phase is Phase.HELD
        palpation = self._palpation_under_way
        if palpation is None:
            course.abort(now, why)
            return
        palpation.abandon(why)
        if held and self._soft:
            course.enter(course.interrupted, now.t, why)
        elif held:
            course.abort(now, why)

    def _end_at_home(self, now: Observation, why: str) -> None:
        """Ends the exam at home; a held one as soon as it is released, but one in contact that was left to planning at once."""
        course, held = self._course, self._course.phase is Phase.HELD
        palpation = self._palpation_under_way
        if palpation is not None:
            palpation.abandon(why)
            if held and self._soft:
                course.enter(course.interrupted, now.t, why)
        elif held:
            course.failure, course.interrupted = why, Phase.RETURN
        else:
            course.go_home(now, why)

    @property
    def _palpation_under_way(self) -> Palpation | None:
        """The palpation, if it is under way or was interrupted."""
        phase = self._course.interrupted if self._course.phase is Phase.HELD else self._course.phase
        return self._course.palpation if phase in PALPATING else None
