"""The course of an examination: inputs and outputs of a step, its phases, and how one that is stopped continues or ends."""

from dataclasses import dataclass
from typing import Final, NamedTuple

from palpate_bus.messages.codes import Phase, Reason
from palpate_bus.setpoint import Setpoint
from palpate_models.numerics.frames import Array
from palpate_planning.contact import ContactMeasurement, SensorReading
from palpate_planning.free_motion import FreeMotion
from palpate_planning.motion.planner import NoPathError
from palpate_planning.palpation import Palpation
from palpate_planning.periods import SECOND
from palpate_planning.reasons import NO_CAUSE, Cause
from palpate_planning.setpoints import AT_REST
from palpate_planning.stroke import StrokeStage
from palpate_planning.strokes.plan import ExamPlan, PerceivedAbdomen, PressRequest
from palpate_planning.wall.wall import BreathObservation, PublishedTouch

PHASE_OF: Final = {
    **dict.fromkeys((StrokeStage.REST, StrokeStage.DESCEND, StrokeStage.SETTLE), Phase.INDENT),
    **dict.fromkeys((StrokeStage.SLIDE, StrokeStage.HOLD), Phase.SCAN),
    **dict.fromkeys((StrokeStage.LIFT, StrokeStage.TRANSFER, StrokeStage.WAIT, StrokeStage.DONE), Phase.RETRACT),
}
"""The phase to which each stage of a stroke belongs."""
PALPATING: Final = frozenset(PHASE_OF.values())
"""Phases in which the strokes of the plan are carried out."""
OVER: Final = frozenset({Phase.DONE, Phase.ABORTED})
"""Phases that end the examination."""


class ArmStop(NamedTuple):
    """A stop of the arm. False if there is none."""

    cause: Cause = NO_CAUSE
    planning_retreats: bool = False
    """True if planning moves the arm, back along the normal; else the driver holds it."""
    final: bool = False
    """True if no release ends it."""

    def __bool__(self) -> bool:
        return bool(self.cause)


NO_STOP: Final = ArmStop()


class Observation(NamedTuple):
    """Inputs of one step. A message appears only in the step in which it arrived."""

    t: int
    """Time [ns]."""
    reading: SensorReading | None
    """None before the first `robot/status`."""
    perceived: PerceivedAbdomen | Cause | None = None
    """Perception's answer, if it arrived."""
    motion: BreathObservation | None = None
    """The newest motion of the wall, if it arrived."""
    findings_final: bool = False
    """True if the final findings of the assessment arrived."""
    stop: ArmStop = NO_STOP
    end: Cause = NO_CAUSE
    """Cause for which the examination is to go home and end, if that was just requested."""
    lost: Cause = NO_CAUSE
    """Cause if needed roles are disconnected."""
    request: PressRequest | None = None
    """The request of the search, if it arrived."""
    averaged: Array | None = None
    """Height of the wall above the surface's vertices in the mean of later images [m], if it arrived."""
    joint_force: float = 0.0
    """Force at the tool by the joints alone [N]."""


@dataclass
class ExamStatus:
    """Fields of exam/state other than the measured contact, by their names there."""

    phase: Phase = Phase.HOME
    message: str = "waiting for the robot"
    cause: Cause = NO_CAUSE
    target_index: int = 0
    target_count: int = 0
    targets_skipped: int = 0
    steady: bool = False
    force_limited: bool = False
    view_blocked: bool = False
    depth_setpoint: float = 0.0
    """Target depth [m], negative above the wall."""
    end_tick: int = -1
    """When the run is to end [ns]; -1 while undecided."""
    stroke: int = 0
    """Number of the latest descent, 0 before the first."""
    patient_moved: bool = False
    """True if the patient has moved since the surface was perceived."""


@dataclass(slots=True)
class ExamStep:
    """Outputs of one step."""

    contact: ContactMeasurement | None
    """None before the first reading of the robot."""
    setpoint: Setpoint = AT_REST
    trigger: bool = False
    """Ask the camera for a burst now."""
    path: Array | None = None
    """Planned poses of the indenter at depth, shape (n, 4, 4), once."""
    touched: PublishedTouch | None = None
    """The touch of this step, if there was one."""
    correction: tuple[Array, Array] | None = None
    """Correction of the perceived surface's vertices, from `Wall.heights_above`, once: when the strokes are over."""


END_AFTER = SECOND
"""The run continues for this time after the examination has ended [ns]."""


class ExamCourse:
    """State that the phases of an examination and its stops share."""

    def __init__(self, arm: FreeMotion, strokes: int) -> None:
        """`strokes`: descents made before."""
        self.arm = arm
        self.status = ExamStatus(stroke=strokes)
        self.since = 0
        """When the phase was entered, or the arm came to rest in it [ns]."""
        self.interrupted = Phase.HOME
        """The phase in which the examination was held last."""
        self.contact: ContactMeasurement
        """Measured at this step."""
        self.rate = 1.0
        """Samples of a trajectory to advance by at this step; see `RestartRamp`."""
        self.perceived: PerceivedAbdomen | None = None
        self.plan: ExamPlan | None = None
        self.palpation: Palpation | None = None
        self.failure = NO_CAUSE
        """Cause for which the examination is aborted once the arm is home."""

    @property
    def phase(self) -> Phase:
        """The present phase."""
        return self.status.phase

    def enter(self, phase: Phase, t: int, message: str, cause: Cause = NO_CAUSE) -> None:
        """Enter a phase at `t` [ns]. `message` is for people; of `cause` only the reason and the culprit are used."""
        status = self.status
        status.phase, status.message, status.cause, self.since = phase, message, cause, t
        if phase in OVER:
            status.end_tick = t + END_AFTER

    def abort(self, now: Observation, cause: Cause) -> None:
        """End the examination where the arm is; it holds still."""
        self.arm.hold(self.contact.q)
        phase = self.interrupted if self.phase is Phase.HELD else self.phase
        self.enter(Phase.ABORTED, now.t, f"aborted in phase {phase.name}: {cause.text}", cause)

    def go_home(self, now: Observation, cause: Cause = NO_CAUSE) -> None:
        """Return home from where the arm is; the examination is then aborted if there is a cause."""
        self.failure = cause
        self.arm.hold(self.contact.q)
        self.enter(Phase.RETURN, now.t, f"returning home: {cause.text}" if cause else "returning home", cause)


class Stops:
    """Holds the examination while it is stopped, and returns it to the interrupted phase after the release.

    After a soft stop in contact the arm retreats along the normal and waits. After any other stop the driver holds the arm, and
    planning's set-point follows the measured posture, so that nothing pulls when the driver releases it.
    """

    def __init__(self, course: ExamCourse, patience_s: float) -> None:
        """An examination that is stopped for `patience_s` at one place, once or several times, ends."""
        self._course = course
        self._patience_s = patience_s
        self._soft = False
        """True if planning has moved the arm since the stop began."""
        self._place: tuple[int, Phase | None] = (0, None)
        """Place of the latest stop: number of the stroke, and the phase outside of strokes."""
        self._stopped_ns = self._counted = 0
        """Time for which it was stopped there, and the time up to which that counts."""
        self._resuming = False
        """True if the stop was released and the arm returns to where it was."""

    def watch(self, now: Observation) -> None:
        """Hold the examination when it is stopped; end it when a needed service or sensor is lost or an operator ends it."""
        course = self._course
        if course.phase in OVER:
            return
        if now.stop and course.phase is not Phase.HELD:
            course.interrupted = course.phase
            self._hold(now)
        if now.lost or now.stop.final:
            self._end(now, now.lost or now.stop.cause, lost=True)
        elif now.end:
            self._end(now, now.end, lost=False)

    def step(self, now: Observation) -> Setpoint | None:
        """Advance a held examination; return None where the arm's free motion or rest gives the set-point."""
        course = self._course
        passed, self._counted = now.t - self._counted, now.t
        if not now.stop:
            self._resume(now)
            return None
        if self._resuming:
            self._hold(now)
        self._soft = self._soft and now.stop.planning_retreats
        self._stopped_ns += passed
        if self._stopped_ns > self._patience_s * SECOND:
            text = f"the stop was not released within {self._patience_s:g} s of waiting: {now.stop.cause.text}"
            course.abort(now, Cause(Reason.NOT_RELEASED, text, now.stop.cause.culprit))
        elif not self._soft:
            course.arm.hold(course.contact.q)
        elif (palpation := self._palpation) is not None and palpation.free_goal is None:
            return palpation.step(now.t, course.contact, course.rate).setpoint
        return None

    def _hold(self, now: Observation) -> None:
        """Let the strokes retreat, or leave the arm to the driver."""
        course = self._course
        self._soft, self._resuming = now.stop.planning_retreats, False
        place = (course.status.stroke, None if course.interrupted in PALPATING else course.interrupted)
        self._stopped_ns = self._stopped_ns if place == self._place else 0
        self._place, self._counted = place, now.t
        course.arm.hold(course.contact.q)
        cause = now.stop.cause
        course.enter(Phase.HELD, now.t, f"held in phase {course.interrupted.name}: {cause.text}", cause)
        if (palpation := self._palpation) is not None:
            palpation.pause()

    def _resume(self, now: Observation) -> None:
        """Return to the interrupted phase; a free motion is planned again."""
        course, palpation = self._course, self._palpation
        if not (self._soft or self._resuming):  # it may have been moved by hand since the latest measurement in the stop
            course.arm.hold(course.contact.q)
        self._resuming = True
        goal = self._free_goal(palpation)
        if goal is not None:
            try:
                if not course.arm.move_to(now.t, goal, course.perceived):
                    return
            except NoPathError as error:
                course.abort(now, Cause(Reason.NO_PATH, f"no path back to where it was held: {error}"))
                return
        course.enter(course.interrupted, now.t, "released, continuing")
        if palpation is None:
            return
        if goal is None:
            palpation.resume(now.t, course.contact)
        else:
            palpation.skip_free_motion()

    def _free_goal(self, palpation: Palpation | None) -> Array | None:
        """Return the goal of the interrupted free motion of the plan [rad], shape (n,); None if there was none."""
        if palpation is not None:
            return palpation.free_goal
        plan = self._course.plan
        if self._course.interrupted is Phase.APPROACH and plan is not None:
            goal: Array = plan.approach.q[-1]
            return goal
        return None

    def _end(self, now: Observation, cause: Cause, *, lost: bool) -> None:
        """End the examination.

        Strokes that planning moves are lifted. After a loss it ends where the arm is then; otherwise at home, and a held
        one after the release.
        """
        course, held, palpation = self._course, self._course.phase is Phase.HELD, self._palpation
        if palpation is not None:
            palpation.abandon(cause)
            if held and self._soft:
                course.enter(course.interrupted, now.t, cause.text, cause)
            elif held and lost:
                course.abort(now, cause)
        elif lost:
            course.abort(now, cause)
        elif held:
            course.failure, course.interrupted = cause, Phase.RETURN
        else:
            course.go_home(now, cause)

    @property
    def _palpation(self) -> Palpation | None:
        """The strokes, if they are under way or were interrupted."""
        phase = self._course.interrupted if self._course.phase is Phase.HELD else self._course.phase
        return self._course.palpation if phase in PALPATING else None
