"""The sequence of the examination: home, look, plan, approach, indent, scan, retract, return, assess, done."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from palpate_bus.setpoint import Setpoint
from palpate_models.numerics.frames import Array, apply, inverse
from palpate_models.robot import lbr
from palpate_models.scenario.checkpoint import Checkpoint
from palpate_models.scenario.schema import ExamInput
from palpate_planning.contact import ContactSensing, ToolWeight
from palpate_planning.course import ExamCourse
from palpate_planning.free_motion import WORKER, BackgroundTask, FreeMotion, TrajectoryFollower
from palpate_planning.look import look_postures
from palpate_planning.motion.kinematics import STRAIGHT_RAD, ArmKinematics
from palpate_planning.motion.planner import NoPathError
from palpate_planning.motion.timing import RestartRamp
from palpate_planning.palpation import HIDES, Palpation
from palpate_planning.periods import MS, SECOND, Periods
from palpate_planning.setpoints import NO_STIFFNESS, joint_setpoint
from palpate_planning.stages import PalpationStep, StrokeStage
from palpate_planning.status import PALPATING, PHASE_OF, ExamStatus, ExamStep, Observation, PerceptionFailure, Phase
from palpate_planning.stops import Stops
from palpate_planning.strokes.path import compile_ahead
from palpate_planning.strokes.plan import ExamPlan, ExamPlanner, PerceivedAbdomen
from palpate_planning.strokes.requests import PLANNING_TIME, PressRequest
from palpate_planning.strokes.segments import STRETCHED, Segment
from palpate_planning.wall.wall import TouchedSkin, Wall, plane

LOOKS_MAX = 3
MOVES_MAX = 2
"""A patient who moves more often is not looked at again."""
REPLANS_MAX = 3
"""An examination is not planned anew more often because the arm would stretch, or hides the wall."""
ELSEWHERE_M = 0.015
"""A wall that lies further from where an examination before saw it is another patient's, or he has moved since."""
REST = 200 * MS
"""Time at rest before looking [ns]: the arm's oscillations fade."""
LOOK_PATIENCE = 12 * SECOND
"""Time that perception may take beyond the burst [ns]: it watches about two breaths."""
EXAM_PLANNING_TIME = 2 * SECOND
"""Simulated time that planning the examination takes [ns]."""
ASSESS_PATIENCE = 120 * SECOND
"""Time that the assessment may take for its final findings [ns]."""


class ExamSequence:
    """Runs one examination. `step` each planning period; `status` says where it stands."""

    def __init__(self, known: ExamInput, periods: Periods, before: Checkpoint | None = None, *, lockstep: bool = True) -> None:
        """`before`: where the examination stood that this one goes on with; `lockstep`: heavy planning takes exactly its
        simulated time; else at least that, and as long as it takes.
        """
        self._known, self._periods, self._lockstep = known, periods, lockstep
        self._before = before
        self._kinematics = ArmKinematics(known.robot, known.limits)
        compile_ahead()
        self._sense = ContactSensing(
            self._kinematics,
            ToolWeight.of(known.robot),
            plane(np.array(known.X_WA)),
            known.robot.indenter_radius_m,
            periods.step_s,
        )
        self._planner = ExamPlanner(known, periods.step_s)
        WORKER.submit(self._planner.prepare)
        self._looks = look_postures(known)
        follower = TrajectoryFollower(self._kinematics, np.array(lbr.HOME))
        self._course = ExamCourse(FreeMotion(follower, self._planner, lockstep=lockstep))
        self._course.status.stroke = 0 if before is None else before.strokes
        self._stops = Stops(self._course, known.limits.release_patience_s)
        self._restart = RestartRamp()
        self._phases: dict[Phase, Callable[[Observation], Setpoint | None]] = {
            Phase.HOME: self._home,
            Phase.LOOK: self._look,
            Phase.PLAN: self._plan,
            Phase.APPROACH: self._approach,
            Phase.INDENT: self._palpate,
            Phase.SCAN: self._palpate,
            Phase.RETRACT: self._palpate,
            Phase.RETURN: self._return,
            Phase.ASSESS: self._assess,
            Phase.DONE: self._rest,
            Phase.ABORTED: self._rest,
            Phase.HELD: self._held,
        }
        self._started = False
        self._looked = 0
        """Number of looks that have failed."""
        self._asked: int | None = None
        """When the camera was asked for the burst that perception is to answer [ns]."""
        self._planning: BackgroundTask[ExamPlan] | None = None
        self._pressing: BackgroundTask[tuple[Segment, ...]] | None = None
        """The press that is being laid."""
        self._request: PressRequest | None = None
        """What the search asks for, until the arm can do it: it asks once."""
        self._requested = self._pressed = 0
        """Numbers of the search's requests: the latest, and the latest that is over."""
        self._moves = 0
        """How often the patient was looked at again, having moved."""
        self._bend: float | None = None
        """How far the elbow is bent, at least, in a plan that was made anew because it became too straight [rad]."""
        self._replans = 0
        """How often the rest was planned anew."""
        self._wanted: frozenset[int] | None = None
        """The targets that were left then; None: all are wanted."""
        self._skipped: dict[int, str] = {}
        self._left = ""
        """Why the rest could not be planned after the patient moved or a plan was left; empty when it could."""
        self._trigger = False
        self._path: Array | None = None
        self._touched: TouchedSkin | None = None
        self._averaged: Array | None = None
        """Where the images since the look show the wall in the mean, at the vertices of the perceived surface."""
        self._correction: tuple[Array, Array] | None = None

    @property
    def status(self) -> ExamStatus:
        """Where the examination stands."""
        return self._course.status

    @property
    def skipped(self) -> dict[int, str]:
        """Skipped targets with the reason."""
        return dict(self._skipped)

    def step(self, now: Observation) -> ExamStep:
        """One planning period. Until the robot has been heard of, the arm is asked for nothing."""
        course, status = self._course, self.status
        course.rate = self._restart.step(now.t)
        if now.reading is None:
            q = np.array(lbr.HOME)
            return ExamStep(joint_setpoint(now.t, self._kinematics.pose(q), q, stiffness=NO_STIFFNESS), None)
        if not self._started:
            self._started = True
            course.arm.hold(now.reading.q)
            course.enter(Phase.HOME, now.t, "going home")
        status.steady = status.force_limited = False
        self._trigger, self._path, self._touched, self._correction = False, None, None, None
        if now.averaged is not None:
            self._averaged = now.averaged
        if now.request is not None:
            self._request = now.request
        if now.motion is not None:
            self._sense.wall.breath.hear(now.motion, now.t)
        course.contact = self._sense.sense(now.reading, now.t)
        status.depth_setpoint = course.contact.depth
        self._stops.watch(now)
        setpoint = self._phases[status.phase](now) or course.arm.step(now.t, course.rate)
        return ExamStep(setpoint, course.contact, self._trigger, self._path, self._touched, self._correction)

    # --- before contact -----------------------------------------------------------------------------------------------

    def _home(self, now: Observation) -> Setpoint | None:
        course = self._course
        try:
            if course.arm.move_to(now.t, np.array(lbr.HOME), course.perceived) and now.t - course.since >= REST:
                course.enter(Phase.LOOK, now.t, "moving the arm out of the camera's view")
        except NoPathError as error:
            course.abort(now, f"no way home: {error}")
        return None

    def _look(self, now: Observation) -> Setpoint | None:
        course, frames = self._course, self._known.camera.frames
        if not self._looks:
            course.abort(now, "every look posture collides: check robot.base_xy_m, base_yaw_rad and base_height_m")
        elif self._asked is None:
            try:
                if not course.arm.move_to(now.t, self._looks[self._looked], course.perceived):
                    course.since = now.t
                elif now.t - course.since >= REST:
                    self._trigger, self._asked = True, now.t
                    self.status.message = f"looking: {frames} frames"
            except NoPathError as error:
                self._look_again(now, f"look posture cannot be reached: {error}")
        elif isinstance(now.perceived, PerceivedAbdomen):
            course.perceived, self._averaged = now.perceived, None
            wall, surface = self._sense.wall, now.perceived.surface
            self._sense.wall = wall.seen_again(surface) if self._moves else Wall(surface, wall.breath)
            self.status.target_count, self.status.view_blocked = len(now.perceived.positions), False
            self._go_on(now, now.perceived)
        elif isinstance(now.perceived, PerceptionFailure):
            self._look_again(now, now.perceived.message)
        elif now.t - self._asked > frames * self._periods.frame + LOOK_PATIENCE:
            self._look_again(now, f"no answer from perception {LOOK_PATIENCE / SECOND:.0f} s after the burst")
        return None

    def _go_on(self, now: Observation, perceived: PerceivedAbdomen) -> None:
        """Plans over all targets, or over those that an examination before has left, of a patient who lies where he lay."""
        course, before, words = self._course, self._before, f"planning over {self.status.target_count} targets"
        if before is not None and not self._moves:
            X_WA = np.array(self._known.X_WA)
            if (away := perceived.surface.away_from(apply(X_WA, before.surface))) > ELSEWHERE_M:
                course.abort(now, f"the wall lies {away * 1e3:.0f} mm from where it lay before: examine anew")
                return
            if not self._known.exam.searched:
                targets = apply(inverse(X_WA), perceived.positions)[:, :2]
                self._wanted = before.wanted(targets, self._known.exam.spacing_m)
                words = f"planning over the {len(self._wanted)} of {self.status.target_count} targets that are left"
        course.enter(Phase.PLAN, now.t, words)

    def _look_again(self, now: Observation, why: str) -> None:
        self._asked = None
        self._looked += 1
        self.status.view_blocked = "blocked" in why
        self.status.message = why
        if self._looked >= min(LOOKS_MAX, len(self._looks)):
            self._give_up(now, f"gave up after {self._looked} looks: {why}")

    def _give_up(self, now: Observation, why: str) -> None:
        """Ends an examination that cannot be planned; what was felt before, if anything was, is assessed all the same."""
        if self._moves or self._replans:
            self._left = why
            self._skipped |= {i: f"{self._skipped[i]}: {why}" for i in self._wanted or () if i in self._skipped}
            self._correct()
            self._course.go_home(now, "")
        else:
            self._course.abort(now, why)

    def _plan(self, now: Observation) -> Setpoint | None:
        course = self._course
        if self._planning is None:
            perceived, start = course.perceived, course.arm.q.copy()
            assert perceived is not None
            self._planning = BackgroundTask(
                now.t,
                EXAM_PLANNING_TIME,
                lambda: self._planner.examination(perceived, start, self._wanted, self._bend),
                lockstep=self._lockstep,
            )
        elif self._planning.due(now.t):
            task, self._planning = self._planning, None
            try:
                plan = course.plan = task.result()
            except NoPathError as error:
                self._give_up(now, str(error))
                return None
            self._skipped = {i: why for i, why in self._skipped.items() if i not in (self._wanted or ())} | plan.skipped
            self._sense.wall.shift_A = self._sense.wall.breath.shift_A
            self._path = plan.poses(self._known.robot.indenter_radius_m, self._known.exam.depth_m)
            course.arm.start(plan.approach)
            self.status.targets_skipped = len(self._skipped)
            course.enter(Phase.APPROACH, now.t, plan.skipped_in_words() or "approaching the first target")
        return None

    def _approach(self, now: Observation) -> Setpoint | None:
        course = self._course
        if not course.arm.arrived:
            course.since = now.t
        elif now.t - course.since >= REST:
            assert course.plan is not None
            course.palpation = Palpation(
                course.plan.segments,
                self._known.exam,
                self._known.limits,
                self._known.robot.indenter_radius_m,
                self._periods.step_s,
                self._sense.wall,
                strokes=self.status.stroke,
                more=course.plan.presses is not None,
            )
            return self._palpate(now)
        return None

    # --- in contact ---------------------------------------------------------------------------------------------------

    def _palpate(self, now: Observation) -> Setpoint | None:
        course = self._course
        assert course.palpation is not None and now.reading is not None
        self._search(now, course.palpation)
        step = course.palpation.step(now.t, course.contact, course.rate)
        self._report(step, course.palpation, now.t)
        if step.taring:
            self._sense.weight.tare(course.contact.R_WS, now.reading.wrench_S)
        else:
            self._sense.weight.start_tare()
        if step.stage is StrokeStage.DONE:
            self._end_strokes(now, course.palpation)
            if course.palpation.failed:
                return None  # it rests where it is, which may be off the way that was planned
        return step.setpoint

    def _end_strokes(self, now: Observation, palpation: Palpation) -> None:
        """Goes home; but where a patient has moved, or the arm would stretch or hides him, goes on with what is left."""
        assert now.reading is not None
        self._course.arm.hold(now.reading.q)
        self._pressing = None  # it was laid on the surface of this plan
        more = palpation.open_ended or bool(palpation.ahead)
        ahead = None if palpation.open_ended else palpation.ahead
        if more and palpation.moved and self._moves < MOVES_MAX:
            self._moves, self._wanted = self._moves + 1, ahead
            self._asked, self._looked, self._bend = None, 0, None
            self._course.enter(Phase.LOOK, now.t, "the patient has moved: looking again")
        elif more and palpation.left in (STRETCHED, HIDES) and self._replans < REPLANS_MAX:
            self._replans, self._wanted = self._replans + 1, ahead
            self._bend = max(self._bend or STRAIGHT_RAD, palpation.bend_needed)
            self._course.enter(Phase.PLAN, now.t, f"{palpation.left}: planning anew")
        else:
            self._correct()
            self._course.go_home(now, palpation.failed)

    def _correct(self) -> None:
        """Tells where the skin lay in the strokes, now that all touches and images are in; not where the patient has moved."""
        perceived, wall = self._course.perceived, self._sense.wall
        if perceived is not None and not self._moves and not wall.breath.moved:
            self._correction = wall.corrected(perceived.vertices, self._averaged)

    def _search(self, now: Observation, palpation: Palpation) -> None:
        """Has the press laid that the search asks for, one at a time, and counts those that are over as targets."""
        plan = self._course.plan
        if plan is None or plan.presses is None:
            return
        if self._request is not None:
            request, presses, self._request = self._request.moved(self._sense.wall.shift_A), plan.presses, None
            if request.xy is None:
                palpation.close()
            else:
                self._pressing = BackgroundTask(now.t, PLANNING_TIME, lambda: presses.press(request), lockstep=self._lockstep)
                self._requested = request.number
        elif self._pressing is not None and self._pressing.due(now.t):
            palpation.extend(self._pressing.result())
            self._pressing = None
        elif self._pressing is None and palpation.waiting:
            self._pressed = self._requested

    def _report(self, step: PalpationStep, palpation: Palpation, t: int) -> None:
        status = self.status
        self._skipped |= palpation.skipped
        self._touched, status.stroke = step.touched, palpation.stroke
        status.patient_moved = self._sense.wall.breath.moved
        status.steady, status.force_limited = step.steady, step.limited
        searched = self._known.exam.searched
        status.depth_setpoint, status.target_index = step.depth_setpoint, self._pressed if searched else step.target
        status.targets_skipped = len(self._skipped)
        phase, message = PHASE_OF[step.stage], palpation.failed or palpation.left or step.stage.value
        if phase is not status.phase or message != status.message:
            self._course.enter(phase, t, message)

    def _held(self, now: Observation) -> Setpoint | None:
        setpoint = self._stops.step(now)
        self._asked = None  # a burst that was asked for before the stop is asked for again
        return self._palpate(now) if self.status.phase in PALPATING else setpoint

    # --- after contact ------------------------------------------------------------------------------------------------

    def _return(self, now: Observation) -> Setpoint | None:
        course = self._course
        try:
            if course.arm.move_to(now.t, np.array(lbr.HOME), course.perceived):
                if course.failure:
                    course.abort(now, course.failure)
                else:
                    course.enter(Phase.ASSESS, now.t, "waiting for the findings")
        except NoPathError as error:
            course.abort(now, f"no way home: {error}")
        return None

    def _assess(self, now: Observation) -> Setpoint | None:
        if now.findings_final:
            skipped = f", {len(self._skipped)} of {self.status.target_count} targets skipped" if self._skipped else ""
            left = f"; the rest was left: {self._left}" if self._left else ""
            self._course.enter(Phase.DONE, now.t, f"examination complete{skipped}{left}")
        elif now.t - self._course.since > ASSESS_PATIENCE:
            self._course.abort(now, f"no final findings after {ASSESS_PATIENCE / SECOND:.0f} s")
        return None

    def _rest(self, now: Observation) -> Setpoint | None:
        return None
