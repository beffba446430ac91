"""The sequence of the examination: home, look, plan, approach, indent, scan, retract, return, assess, done."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from palpate_bus.messages.codes import Phase, Reason
from palpate_bus.setpoint import Setpoint
from palpate_models.numerics.frames import Array, apply, inverse
from palpate_models.scenario.load import Checkpoint
from palpate_models.scenario.schema import ExamInput
from palpate_planning.contact import ContactSensing
from palpate_planning.course import OVER, PALPATING, PHASE_OF, ExamCourse, ExamStep, Observation, Stops
from palpate_planning.free_motion import WORKER, BackgroundTask, FreeMotion, at_posture
from palpate_planning.motion.kinematics import KINEMATIC_LIMITS, ArmKinematics
from palpate_planning.motion.planner import NoPathError, RestartRamp
from palpate_planning.palpation import REPLANNED, Palpation, PalpationStep
from palpate_planning.periods import MS, SECOND
from palpate_planning.presses import RequestedPresses
from palpate_planning.reasons import (
    FAULTS,
    FOR_FINDINGS,
    FOR_JOINTS,
    FOR_PERCEPTION,
    FOR_PLAN,
    FOR_ROBOT,
    MOVED,
    NO_CAUSE,
    WAIT,
    Cause,
    StrokeWaits,
    Tally,
    count_causes,
)
from palpate_planning.setpoints import ReturnToArm, joint_setpoint
from palpate_planning.stroke import StrokeStage
from palpate_planning.strokes.path import compile_ahead
from palpate_planning.strokes.plan import ExamPlan, ExamPlanner, PerceivedAbdomen, look_postures, nearest_targets
from palpate_planning.wall.wall import Wall, plane


class ExamTuning(NamedTuple):
    """Limits of repetition and time of the phases."""

    looks_max: int = 3
    """Maximum number of postures to look from."""
    rescans_max: int = 2
    """Maximum number of repeated views of the surface, after the patient moved or no tissue was felt."""
    replans_max: int = 3
    """Maximum number of plans for the remainder after the arm would have stretched, or hid the wall."""
    resume_distance_m: float = 0.015
    """Resume is refused if the wall moved by more than this."""
    rest_ns: int = 200 * MS
    """Time at rest before an image: the arm's oscillations fade."""
    perception_timeout_ns: int = 12 * SECOND
    """Time that perception may take beyond the burst: it watches about two breaths."""
    planning_ns: int = 2 * SECOND
    """Simulated time that planning the examination takes."""
    findings_timeout_ns: int = 120 * SECOND
    lost_fraction_max: float = 0.1
    """Maximum share of targets lost to faults; with more the examination counts as failed."""


EXAM = ExamTuning()


class Views:
    """The views of the abdomen: postures, tried in turn, and the bursts of the camera."""

    def __init__(self, postures: list[Array]) -> None:
        """`postures` [rad], shape (n,) each."""
        self.postures = postures
        self.failed = 0
        """Number of views that failed."""
        self.asked: int | None = None
        """When the camera was asked for the burst that perception is to answer [ns]."""

    @property
    def posture(self) -> Array:
        """The posture to look from [rad], shape (n,)."""
        return self.postures[self.failed % len(self.postures)]

    def fail(self) -> bool:
        """Turn to the next posture, or to the first one again; return True if there are to be no more views."""
        self.asked = None
        self.failed += 1
        return self.failed >= EXAM.looks_max

    def restart(self) -> None:
        """Begin with the first posture again."""
        self.asked, self.failed = None, 0


@dataclass
class Remainder:
    """The part of the examination that is planned, and planned again after an interruption."""

    wanted: frozenset[int] | None = None
    """Targets to examine; None: all."""
    bend: float | None = None
    """Minimum bend of the elbow [rad] in a plan that replaces one in which it became too straight."""
    rescans: int = 0
    """Number of new views because the patient moved, or no tissue was felt."""
    looked_again: bool = False
    """True if no tissue was felt before one of them."""
    replans: int = 0
    unplanned: str = ""
    """Text of the failure to plan the rest; empty if there was none."""

    @property
    def begun(self) -> bool:
        """True if strokes were carried out before."""
        return self.rescans + self.replans > 0


class ExaminationSequence:
    """Runs one examination. `step` each planning period; `status` is what exam/state reports."""

    def __init__(
        self,
        known: ExamInput,
        step_s: float,
        frame_ns: int,
        rates: Mapping[str, float],
        before: Checkpoint | None = None,
        *,
        lockstep: bool = True,
    ) -> None:
        """Start at home.

        Args:
            known: the exam input.
            step_s: period of planning [s].
            frame_ns: period of the camera [ns].
            rates: maximum rates of change of a set-point by field.
            before: state of the interrupted examination that this one resumes.
            lockstep: True if heavy planning takes exactly its simulated time; else it takes at least that.
        """
        self._known, self._step_s, self._frame_ns, self._lockstep = known, step_s, frame_ns, lockstep
        self._before = before
        self._kinematics = ArmKinematics(known.robot, known.limits)
        compile_ahead()
        self._sense = ContactSensing(self._kinematics, known.robot, plane(np.array(known.X_WA)))
        self._planner = ExamPlanner(known, step_s)
        WORKER.submit(self._planner.prepare)
        arm = FreeMotion(self._kinematics, self._planner, lockstep=lockstep)
        self._course = ExamCourse(arm, 0 if before is None else before.strokes)
        self.status = self._course.status
        """State of the examination."""
        self._stops = Stops(self._course, known.limits.release_patience_s)
        self._restart, self._return_to_arm = RestartRamp(), ReturnToArm(step_s, rates)
        self._tally = Tally()
        self._approach_waits: StrokeWaits
        """Of the present plan."""
        self._views = Views(look_postures(known))
        self._remainder = Remainder()
        self._requested = RequestedPresses(lockstep=lockstep)
        self._planning: BackgroundTask[ExamPlan] | None = None
        self._planned_from: Array
        """Posture at the start of that plan [rad], shape (n,)."""
        self.skipped: dict[int, Cause] = {}
        """Skipped targets with the cause."""
        self._started = False
        self._began: int | None = None
        """Time of the first step [ns]."""
        self._findings_final = False
        """True once the final findings of the assessment arrived, which are sent once."""
        self._averaged: Array | None = None
        """Height of the wall above the surface's vertices in the mean of the images since the view [m]."""
        self._phases: dict[Phase, Callable[[Observation, ExamStep], Setpoint | None]] = {
            Phase.HOME: self._home,
            Phase.LOOK: self._look,
            Phase.PLAN: self._plan,
            Phase.APPROACH: self._approach,
            **dict.fromkeys(PALPATING, self._palpate),
            Phase.RETURN: self._return,
            Phase.ASSESS: self._assess,
            Phase.HELD: self._hold,
        }

    @property
    def unfelt(self) -> dict[int, Cause]:
        """Targets that were to be felt and were not, with the cause: skipped ones, and those that an early end left."""
        course, wanted = self._course, self._remainder.wanted
        if course.phase is Phase.DONE or self._known.exam.searched:
            return self.skipped
        everything = frozenset(range(self.status.target_count)) if wanted is None else wanted
        remaining = everything if course.palpation is None else course.palpation.remaining
        return dict.fromkeys(remaining, self.status.cause) | self.skipped

    def step(self, now: Observation) -> ExamStep:
        """Advance one planning period. Before the first reading of the robot, the set-point is without stiffness."""
        course, status = self._course, self.status
        course.rate = self._restart.step(now.t)
        self._began = now.t if self._began is None else self._began
        if now.reading is None:
            q = self._kinematics.arm.home_rad
            self._await_robot(now, self._began)
            return ExamStep(None, setpoint=joint_setpoint(now.t, self._kinematics.pose(q), q, np.zeros_like(q), np.zeros_like(q)))
        if not self._started:
            self._started = True
            course.arm.hold(now.reading.q)
            if status.phase not in OVER:
                course.enter(Phase.HOME, now.t, "going home")
        if now.averaged is not None:
            self._averaged = now.averaged
        self._findings_final = self._findings_final or now.findings_final
        self._requested.receive(now.request)
        if now.motion is not None:
            self._sense.wall.breath.receive(now.motion, now.t)
        course.contact = self._sense.sense(now.reading, now.t, now.joint_force)
        status.steady = status.force_limited = False
        status.depth_setpoint = course.contact.depth
        self._stops.watch(now)
        step = ExamStep(course.contact)
        phase = self._phases.get(status.phase, _stay)
        wanted = phase(now, step) or course.arm.step(now.t, course.rate)
        step.setpoint = self._return_to_arm.step(wanted, course.contact.X_WI, now.reading.q)
        self._await_plan(now.t)
        return step

    # --- waits --------------------------------------------------------------------------------------------------------

    def _await_robot(self, now: Observation, began: int) -> None:
        """Report that the robot is awaited since `began` [ns], with its reason if any; abort after a time or on request."""
        status, waited_s, reason = self.status, (now.t - began) / SECOND, now.stop.cause.text
        if status.phase in OVER:
            return
        if now.end or waited_s > WAIT.limit_s:
            text = f"aborted before the robot was ready: {now.end.text or reason or FOR_ROBOT.end.text}"
            self._course.enter(Phase.ABORTED, now.t, text, now.end or FOR_ROBOT.end)
        elif waited_s >= WAIT.reported_s:
            status.cause, status.message = FOR_ROBOT.cause, reason or FOR_ROBOT.cause.text

    def _await_plan(self, t: int) -> None:
        """Report that the motion planner is awaited: in wall-clock mode it may take long."""
        status, task = self.status, self._planning if self.status.phase is Phase.PLAN else None
        since = self._course.arm.planning_since if task is None else task.begun
        if status.phase in OVER:
            return
        if since is not None and t - since >= WAIT.reported_s * SECOND:
            status.cause, status.message = FOR_PLAN.cause, FOR_PLAN.cause.text
        elif status.cause.reason is FOR_PLAN.cause.reason:
            status.cause, status.message = NO_CAUSE, "moving"

    # --- before contact -----------------------------------------------------------------------------------------------

    def _home(self, now: Observation, out: ExamStep) -> None:
        if self._at_home(now) and now.t - self._course.since >= EXAM.rest_ns:
            self._course.enter(Phase.LOOK, now.t, "moving the arm out of the camera's view")

    def _at_home(self, now: Observation) -> bool:
        """Move home; return True once there. Abort without a path."""
        course = self._course
        try:
            return course.arm.move_to(now.t, self._kinematics.arm.home_rad, course.perceived)
        except NoPathError as error:
            course.abort(now, Cause(Reason.NO_PATH, f"no path home: {error}"))
            return False

    def _look(self, now: Observation, out: ExamStep) -> None:
        course, views, frames = self._course, self._views, self._known.camera.frames
        if not views.postures:
            text = "every look posture collides: check robot.base_xy_m, base_yaw_rad, base_height_m, and home_rad of robot.arm"
            course.abort(now, Cause(Reason.VIEW_UNREACHABLE, text))
        elif views.asked is None:
            try:
                if not course.arm.move_to(now.t, views.posture, course.perceived):
                    course.since = now.t
                elif now.t - course.since >= EXAM.rest_ns:
                    out.trigger, views.asked = True, now.t
                    self.status.cause = FOR_PERCEPTION
                    self.status.message = f"looking: {frames} frames, which perception evaluates"
            except NoPathError as error:
                self._look_again(now, out, Cause(Reason.VIEW_UNREACHABLE, f"look posture cannot be reached: {error}"))
        elif isinstance(now.perceived, PerceivedAbdomen):
            self._accept_view(now, now.perceived)
        elif now.perceived is not None:
            self._look_again(now, out, now.perceived)
        elif now.t - views.asked > frames * self._frame_ns + EXAM.perception_timeout_ns:
            text = f"no answer from perception {EXAM.perception_timeout_ns / SECOND:.0f} s after the burst"
            self._look_again(now, out, Cause(Reason.VIEW_TIMEOUT, text, "perception"))

    def _accept_view(self, now: Observation, perceived: PerceivedAbdomen) -> None:
        """Start planning: all targets, or on resume the remaining ones. Abort a resumed examination if the wall is elsewhere."""
        course, remainder, sense, before = self._course, self._remainder, self._sense, self._before
        if course.perceived is not None and remainder.rescans:
            self._renumber(course.perceived, perceived)
            sense.wall.rescan(perceived.surface)
        else:
            sense.wall = Wall(perceived.surface, sense.wall.breath)
        course.perceived, course.palpation, self._averaged = perceived, None, None
        count = self.status.target_count = len(perceived.positions)
        self.status.view_blocked = False
        text = f"planning over {count} targets"
        if before is not None and not remainder.rescans:
            X_WA = np.array(self._known.X_WA)
            if (away := perceived.surface.away_from(apply(X_WA, before.surface))) > EXAM.resume_distance_m:
                limit = f"limit {EXAM.resume_distance_m * 1e3:.0f} mm"
                text = f"cannot resume: abdominal wall moved {away * 1e3:.0f} mm ({limit}); start a new run"
                course.abort(now, Cause(Reason.OTHER_PATIENT, text))
                return
            if not self._known.exam.searched:
                targets = apply(inverse(X_WA), perceived.positions)[:, :2]
                remainder.wanted = before.remaining_targets(targets, self._known.exam.spacing_m)
                text = f"planning over {len(remainder.wanted)} of {count} targets that are left"
        course.enter(Phase.PLAN, now.t, text)

    def _renumber(self, before: PerceivedAbdomen, perceived: PerceivedAbdomen) -> None:
        """Give each target of a new view the state of the nearest one before."""
        nearest = dict(enumerate(nearest_targets(before.positions, perceived.positions).tolist()))
        wanted, skipped = self._remainder.wanted, self.skipped
        if wanted is not None:
            self._remainder.wanted = frozenset(i for i, was in nearest.items() if was in wanted)
        self.skipped = {i: skipped[was] for i, was in nearest.items() if was in skipped}

    def _look_again(self, now: Observation, out: ExamStep, cause: Cause) -> None:
        status, exhausted = self.status, self._views.fail()
        status.cause, status.message = cause, cause.text
        status.view_blocked = cause.reason is Reason.VIEW_BLOCKED
        if exhausted:
            self._give_up(now, out, cause._replace(text=f"gave up after {self._views.failed} looks: {cause.text}"))

    def _give_up(self, now: Observation, out: ExamStep, cause: Cause) -> None:
        """End an examination that cannot be planned; measurements made before are assessed."""
        remainder, skipped = self._remainder, self.skipped
        if not remainder.begun:
            self._course.abort(now, cause)
            return
        remainder.unplanned = cause.text
        for i in (remainder.wanted or frozenset()) & skipped.keys():
            skipped[i] = skipped[i]._replace(text=f"{skipped[i].text}: {cause.text}")
        self._correct(out)
        self._course.go_home(now)

    def _plan(self, now: Observation, out: ExamStep) -> None:
        course, remainder = self._course, self._remainder
        if self._planning is None:
            perceived, start = course.perceived, course.arm.q.copy()
            self._planned_from = start
            assert perceived is not None
            self._planning = BackgroundTask(
                now.t,
                EXAM.planning_ns,
                lambda: self._planner.examination(perceived, start, remainder.wanted, remainder.bend),
                lockstep=self._lockstep,
            )
        elif self._planning.due(now.t):
            task, self._planning = self._planning, None
            try:
                plan = course.plan = task.result()
            except NoPathError as error:
                self._give_up(now, out, Cause(Reason.NO_PATH, str(error)))
                return
            planned_again = remainder.wanted or frozenset()
            self.skipped = {i: cause for i, cause in self.skipped.items() if i not in planned_again} | plan.skipped
            self._sense.wall.shift_A = self._sense.wall.breath.shift_A
            out.path, course.palpation = plan.poses(self._known.robot.indenter_radius_m, self._known.exam.depth_m), None
            course.arm.start(plan.approach)
            self._approach_waits = StrokeWaits(self._step_s, Tally())
            self.status.targets_skipped = len(self.skipped)
            course.enter(Phase.APPROACH, now.t, count_causes(plan.skipped.values()) or "approaching the first target")
        elif self._planning.late(now.t):
            self._planning = None
            self._give_up(now, out, FOR_PLAN.end)

    def _approach(self, now: Observation, out: ExamStep) -> Setpoint | None:
        course, known, waits = self._course, self._known, self._approach_waits
        behind = course.arm.arrived and course.arm.behind(course.contact)
        end = waits.step(FOR_JOINTS if behind else None)
        if end:
            course.abort(now, end)
        elif behind or not course.arm.arrived:
            course.since = now.t
            if waits.reported:
                self.status.cause, self.status.message = waits.reported, waits.reported.text
        elif now.t - course.since >= EXAM.rest_ns:
            assert course.plan is not None
            course.palpation = Palpation(
                course.plan.segments, known, self._step_s, self._sense.wall, self._tally, self.status.stroke
            )
            course.palpation.more, course.palpation.looked_again = course.plan.presses is not None, self._remainder.looked_again
            return self._palpate(now, out)
        return None

    # --- in contact ---------------------------------------------------------------------------------------------------

    def _palpate(self, now: Observation, out: ExamStep) -> Setpoint | None:
        course, sense = self._course, self._sense
        palpation, plan = course.palpation, course.plan
        assert palpation is not None and plan is not None and now.reading is not None
        if plan.presses is not None:
            self._requested.step(now.t, plan.presses, palpation, sense.wall.shift_A)
        step = palpation.step(now.t, course.contact, course.rate)
        self._report(step, palpation, now.t)
        out.touched = step.touched
        sense.compensation.update(course.contact.R_WS, now.reading.wrench_S, taring=step.taring)
        if step.stage is StrokeStage.DONE:
            self._end_strokes(now, out, palpation)
            if palpation.recovery.ending:
                return None  # it rests where it is, which may be off the planned path
        return step.setpoint

    def _report(self, step: PalpationStep, palpation: Palpation, t: int) -> None:
        status = self.status
        self.skipped |= palpation.recovery.skipped
        status.stroke, status.patient_moved = palpation.descent.stroke, self._sense.wall.breath.moved
        status.steady, status.force_limited, status.depth_setpoint = step.steady, step.limited, step.depth_setpoint
        status.target_index = self._requested.done if self._known.exam.searched else step.target
        status.targets_skipped = len(self.skipped)
        cause = palpation.recovery.failed or palpation.recovery.early_end or palpation.waits.reported
        self._course.enter(PHASE_OF[step.stage], t, cause.text or step.stage.value, cause)

    def _end_strokes(self, now: Observation, out: ExamStep, palpation: Palpation) -> None:
        """Go home, or continue with the targets that are left: after a new view if the patient has moved, else by a new plan."""
        course, remainder, cause = self._course, self._remainder, palpation.recovery.early_end
        course.arm.hold(course.contact.q)
        self._requested.drop_plan()
        more = not palpation.recovery.failed and (palpation.more or bool(palpation.ahead))
        wanted = None if palpation.more else palpation.ahead
        if more and (palpation.moved or cause.reason is Reason.NO_TISSUE) and remainder.rescans < EXAM.rescans_max:
            remainder.rescans, remainder.wanted, remainder.bend = remainder.rescans + 1, wanted, None
            remainder.looked_again = remainder.looked_again or not palpation.moved
            cause = MOVED if palpation.moved else cause
            self._views.restart()
            course.enter(Phase.LOOK, now.t, f"{cause.text}: looking again", cause)
        elif more and cause.reason in REPLANNED and remainder.replans < EXAM.replans_max:
            remainder.replans, remainder.wanted = remainder.replans + 1, wanted
            remainder.bend = max(remainder.bend or KINEMATIC_LIMITS.straight_rad, palpation.bend_needed)
            course.enter(Phase.PLAN, now.t, f"{cause.text}: planning again", cause)
        else:
            remainder.unplanned = cause.text if palpation.more else remainder.unplanned  # a search that did not end by itself
            self._correct(out)
            if lost := now.lost or (now.stop.final and now.stop.cause):
                course.abort(now, lost._replace(text=f"{lost.text}; the arm stays above the skin"))
                return
            course.go_home(now, palpation.recovery.failed)
            if cause and not palpation.recovery.failed:
                self.status.cause, self.status.message = cause, f"returning home: {cause.text}"

    def _correct(self, out: ExamStep) -> None:
        """Publish the final surface correction, unless the patient moved."""
        perceived, wall = self._course.perceived, self._sense.wall
        if perceived is not None and not self._remainder.rescans and not wall.breath.moved:
            out.correction = wall.heights_above(perceived.vertices, self._averaged)

    def _hold(self, now: Observation, out: ExamStep) -> Setpoint | None:
        setpoint = self._stops.step(now)
        self._views.asked = None  # the camera is asked again, and an arm that was pushed gets another plan
        if self._planning is not None and not at_posture(self._course.arm.q, self._planned_from):
            self._planning = None
        return self._palpate(now, out) if self.status.phase in PALPATING else setpoint

    # --- after contact ------------------------------------------------------------------------------------------------

    def _return(self, now: Observation, out: ExamStep) -> None:
        if not self._at_home(now):
            return
        if self._course.failure:
            self._course.abort(now, self._course.failure)
        else:
            self._findings_final = False  # earlier findings are not of the whole examination
            self._course.enter(Phase.ASSESS, now.t, FOR_FINDINGS.text, FOR_FINDINGS)

    def _assess(self, now: Observation, out: ExamStep) -> None:
        if self._findings_final:
            self._conclude(now.t)
        elif now.t - self._course.since > EXAM.findings_timeout_ns:
            text = f"no final findings after {EXAM.findings_timeout_ns / SECOND:.0f} s"
            self._course.abort(now, Cause(Reason.NO_FINDINGS, text, "assessment"))

    def _conclude(self, t: int) -> None:
        """End the examination at `t` [ns]: complete, incomplete, or failed because faults have cost too many targets."""
        count, skipped, unplanned = self.status.target_count, self.skipped, self._remainder.unplanned
        lost = Counter(cause for cause in skipped.values() if cause.loss in FAULTS)
        missing = [f"{len(skipped)} of {count} targets not felt: {count_causes(skipped.values())}"] if skipped else []
        missing += [f"the rest was left: {unplanned}"] if unplanned else []
        text = "; ".join(("examination incomplete", *missing)) if missing else "examination complete"
        if lost.total() > EXAM.lost_fraction_max * count:
            self._course.enter(Phase.ABORTED, t, text, lost.most_common(1)[0][0])
        else:
            self._course.enter(Phase.DONE, t, text)


def _stay(now: Observation, out: ExamStep) -> None:
    """The phase of an examination that is over."""
