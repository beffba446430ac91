"""The examination as a state machine: home, look, plan, approach, indent, scan, retract, return, assess, done."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from palpate_models import lbr
from palpate_models.scenario import ExamInput
from palpate_planning import path
from palpate_planning.follow import Follower
from palpate_planning.kinematics import Kinematics
from palpate_planning.look import look_postures
from palpate_planning.measure import ContactSense, Reading
from palpate_planning.motion import NoPathError
from palpate_planning.palpation import Doing, Palpation, Progress
from palpate_planning.prepare import ExamPlan, Planner, Seen
from palpate_planning.setpoint import ControlMode, Setpoint
from palpate_planning.status import PHASE_OF, ExamStatus, Observation, Outcome, Phase, Unseen
from palpate_planning.surface import Surface
from palpate_planning.thinking import WORKER, Thought
from palpate_planning.timing import JointTrajectory, Pace
from palpate_planning.weight import ToolWeight

Array = NDArray[np.float64]

MS = 1_000_000
SECOND = 1_000 * MS
LOOKS_MAX = 3
REST = 200 * MS
"""Time at rest before looking or taring [ns]: the arm's oscillations fade."""
TARE = 300 * MS
"""Time of taring [ns]: 30 means over 10 ms of 0.05 N noise leave 3 mN."""
LOOK_PATIENCE = 3 * SECOND
"""How long perception may take beyond the burst."""
FRAME = 100 * MS
MOTION_BUDGET = 200 * MS
"""Simulated time that planning one free motion takes."""
PLAN_BUDGET = 2 * SECOND
"""Simulated time that planning the examination takes."""
ASSESS_PATIENCE = 30 * SECOND
END_AFTER = SECOND
"""The run goes on so long after the exam has ended."""
AT_HOME_RAD = 0.01
PALPATING = frozenset({Phase.INDENT, Phase.SCAN, Phase.RETRACT})
"""Phases in which the strokes of the plan are carried out."""
OVER = frozenset({Phase.DONE, Phase.ABORTED})
"""Phases after which nothing comes."""


class Exam:
    """Runs one examination. `step` each planning period; `status` says where it stands."""

    def __init__(self, known: ExamInput, *, lockstep: bool = True) -> None:
        """`lockstep`: heavy planning takes exactly its simulated time; else at least, as long as it takes."""
        self._known = known
        self._lockstep = lockstep
        self._kinematics = Kinematics(known.robot, known.limits)
        plane, weight, radius = Surface.plane(np.array(known.X_WA)), ToolWeight.of(known.robot), known.robot.indenter_radius_m
        path.compile_ahead()
        ContactSense(self._kinematics, weight, plane, radius).sense(Reading(np.zeros(7), np.zeros(6), np.zeros(7)))  # as well
        self._sense = ContactSense(self._kinematics, weight, plane, radius)
        self._planner = Planner(known)
        WORKER.submit(self._planner.prepare)
        self._looks = look_postures(known)
        self._follower = Follower(self._kinematics, np.array(lbr.HOME))
        self._pace, self._rate = Pace(), 1.0
        self.status = ExamStatus()
        self._steps: dict[Phase, Callable[[Observation], Setpoint | None]] = {
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
        self._since = 0
        self._started = False
        self._attempts = 0
        self._trigger = False
        self._path: Array | None = None
        self._asked: int | None = None
        self._seen: Seen | None = None
        self._plan_made: ExamPlan | None = None
        self._motion: Thought[JointTrajectory] | None = None
        self._thought: Thought[ExamPlan] | None = None
        self._palpation: Palpation | None = None
        self._skipped: dict[int, str] = {}
        self._broken = ""
        self._held_in = Phase.HOME
        self._soft = self._released = False

    @property
    def surface_offset(self) -> float:
        """Outward shift of the perceived surface that the onset of force called for [m]."""
        return 0.0 if self._palpation is None else self._palpation.offset

    @property
    def skipped(self) -> dict[int, str]:
        """Skipped targets with the reason."""
        return dict(self._skipped)

    def step(self, now: Observation) -> Outcome:
        """One planning period. Until the robot has been heard of, the arm is asked for nothing."""
        self._rate = self._pace.step(now.t)
        if now.reading is None:
            q = np.array(lbr.HOME)
            return Outcome(Setpoint(ControlMode.JOINT, self._kinematics.pose(q), q, limp=True), None)
        if not self._started:
            self._started = True
            self._follower.hold(now.reading.q)
            self._enter(Phase.HOME, now.t, "going home")
        self.status.steady = self.status.force_limited = False
        self._trigger, self._path = False, None
        self._contact = self._sense.sense(now.reading)
        self.status.depth_setpoint = self._contact.depth
        self._watch(now)
        setpoint = self._steps[self.status.phase](now) or self._follower.step(self._rate)
        return Outcome(setpoint, self._contact, self._trigger, self._path)

    # --- transitions --------------------------------------------------------------------------------------------------

    def _enter(self, phase: Phase, t: int, message: str) -> None:
        self.status.phase, self.status.message = phase, message
        self._since = t
        if phase in OVER:
            self.status.end_tick = t + END_AFTER

    def _abort(self, now: Observation, why: str) -> None:
        """Ends the exam where the arm is; it holds still."""
        assert now.reading is not None
        self._follower.hold(now.reading.q)
        phase = self._held_in if self.status.phase is Phase.HELD else self.status.phase
        self._enter(Phase.ABORTED, now.t, f"aborted in phase {phase.name}: {why}")

    def _watch(self, now: Observation) -> None:
        """Holds the exam when it is stopped, ends it when a service that it needs is gone or an operator has had enough."""
        phase = self.status.phase
        if phase in OVER:
            return
        if now.stop and phase is not Phase.HELD:
            self._hold(now)
        if now.lost:
            self._give_up(now, f"lost {', '.join(now.lost)}")
        elif now.end:
            self._give_up(now, now.end, go_home=True)

    def _give_up(self, now: Observation, why: str, *, go_home: bool = False) -> None:
        """Ends the exam: in contact by lifting off and going home, else where the arm is or at home."""
        held = self.status.phase is Phase.HELD
        phase = self._held_in if held else self.status.phase
        if self._palpation is not None and phase in PALPATING:
            self._palpation.abandon(why)
            if held and self._soft:
                self._enter(phase, now.t, why)
            elif held and not go_home:
                self._abort(now, why)
        elif go_home:
            self._broken = why
            if held:
                self._held_in = Phase.RETURN
            else:
                self._go_home(now, why)
        else:
            self._abort(now, why)

    def _go_home(self, now: Observation, why: str) -> None:
        assert now.reading is not None
        self._motion = None
        self._follower.hold(now.reading.q)
        self._enter(Phase.RETURN, now.t, f"returning home: {why}")

    # --- stopped ------------------------------------------------------------------------------------------------------

    def _hold(self, now: Observation) -> None:
        """The exam is stopped: it retreats, or leaves the arm to the driver, and remembers where it was."""
        assert now.reading is not None
        if self.status.phase is not Phase.HELD:
            self._held_in = self.status.phase
        self._soft, self._released = now.soft, False
        self._motion, self._asked = None, None
        self._follower.hold(now.reading.q)
        if self._palpation is not None and self._held_in in PALPATING:
            self._palpation.pause()
        self._enter(Phase.HELD, now.t, f"held in phase {self._held_in.name}: {now.stop}")

    def _held(self, now: Observation) -> Setpoint | None:
        assert now.reading is not None
        if now.stop and self._released:
            self._hold(now)
        if now.stop:
            self._soft = self._soft and now.soft
            if now.t - self._since > self._known.limits.release_patience_s * SECOND:
                waited = self._known.limits.release_patience_s
                self._abort(now, f"nobody released it within {waited:g} s: {now.stop}")
            elif self._soft and self._palpation is not None and self._held_in in PALPATING:
                if self._palpation.free_goal is None:
                    return self._palpation.step(self._contact, self._rate).setpoint
            elif not self._soft:
                self._follower.hold(now.reading.q)  # the driver holds without stiffness: nothing is to pull when it lets go
            return None
        return self._go_on(now)

    def _go_on(self, now: Observation) -> Setpoint | None:
        """The stop is lifted: back to what was interrupted, by a fresh motion where there was a free one."""
        self._released = True
        palpation = self._palpation if self._held_in in PALPATING else None
        goal = None if palpation is None else palpation.free_goal
        if self._held_in is Phase.APPROACH and self._plan_made is not None:
            goal = self._plan_made.approach.q[-1]
        if goal is not None:
            try:
                if not self._move(now, goal):
                    return None
            except NoPathError as error:
                self._abort(now, f"no way back to where it was held: {error}")
                return None
        phase, self._motion = self._held_in, None
        self._enter(phase, now.t, "released, going on")
        if palpation is not None:
            if goal is not None:
                palpation.arrive()
            else:
                palpation.resume(self._contact)
            return self._palpate(now)
        return None

    def _move(self, now: Observation, goal: Array) -> bool:
        """Moves to a posture: plans, then follows. Returns whether it is there. Raises NoPathError."""
        if not self._follower.arrived:
            return False
        if self._motion is None:
            if float(np.abs(self._follower.q - goal).max()) < AT_HOME_RAD:
                return True
            start, seen = self._follower.q.copy(), self._seen
            self._motion = Thought(now.t, MOTION_BUDGET, lambda: self._planner.motion(start, goal, seen), lockstep=self._lockstep)
        elif self._motion.due(now.t):
            self._follower.start(self._motion.result())
            self._motion = None
        return False

    # --- phases -------------------------------------------------------------------------------------------------------

    def _home(self, now: Observation) -> Setpoint | None:
        try:
            if self._move(now, np.array(lbr.HOME)) and now.t - self._since >= REST:
                self._enter(Phase.LOOK, now.t, "moving the arm out of the camera's view")
        except NoPathError as error:
            self._abort(now, f"no way home: {error}")
        return None

    def _look(self, now: Observation) -> Setpoint | None:
        status, frames = self.status, self._known.camera.frames
        if not self._looks:
            self._abort(now, "every look posture collides: check robot.base_xy_m, base_yaw_rad and base_height_m")
            return None
        if self._asked is None:
            try:
                if not self._move(now, self._looks[self._attempts]):
                    self._since = now.t
                elif now.t - self._since >= REST:
                    self._trigger, self._asked = True, now.t
                    status.message = f"looking: {frames} frames"
            except NoPathError as error:
                self._look_again(now, f"look posture cannot be reached: {error}")
        elif isinstance(now.seen, Seen):
            self._seen = now.seen
            self._sense.surface = now.seen.surface
            status.target_count, status.view_blocked = len(now.seen.positions), False
            self._enter(Phase.PLAN, now.t, f"planning over {status.target_count} targets")
        elif isinstance(now.seen, Unseen):
            self._look_again(now, now.seen.message)
        elif now.t - self._asked > frames * FRAME + LOOK_PATIENCE:
            self._look_again(now, f"no answer from perception {LOOK_PATIENCE / SECOND:.0f} s after the burst")
        return None

    def _look_again(self, now: Observation, why: str) -> None:
        self._asked, self._motion = None, None
        self._attempts += 1
        self.status.view_blocked = "blocked" in why
        self.status.message = why
        if self._attempts >= min(LOOKS_MAX, len(self._looks)):
            self._abort(now, f"gave up after {self._attempts} looks: {why}")

    def _plan(self, now: Observation) -> Setpoint | None:
        if self._thought is None:
            seen, start = self._seen, self._follower.q.copy()
            assert seen is not None
            self._thought = Thought(now.t, PLAN_BUDGET, lambda: self._planner.examination(seen, start), lockstep=self._lockstep)
        elif self._thought.due(now.t):
            try:
                plan = self._thought.result()
            except NoPathError as error:
                self._abort(now, str(error))
                return None
            self._plan_made, self._skipped = plan, dict(plan.skipped)
            self._path = plan.poses(self._known.robot.indenter_radius_m, self._known.exam.depth_m)
            self._follower.start(plan.approach)
            self.status.targets_skipped = len(self._skipped)
            self._enter(Phase.APPROACH, now.t, plan.skipped_in_words() or "approaching the first target")
        return None

    def _approach(self, now: Observation) -> Setpoint | None:
        assert now.reading is not None and self._plan_made is not None and self._seen is not None
        if not self._follower.arrived:
            self._since = now.t
            self._sense.weight.start_tare()
        elif now.t - self._since >= REST + TARE:
            exam, limits = self._known.exam, self._known.limits
            radius, noise = self._known.robot.indenter_radius_m, self._seen.noise
            self._palpation = Palpation(self._plan_made.legs, exam, limits, radius, noise)
            self._enter(Phase.INDENT, now.t, Doing.DESCEND.value)
            return self._palpate(now)
        elif now.t - self._since >= REST:
            self._sense.weight.tare(self._contact.R_WS, now.reading.wrench_S)
        return None

    def _palpate(self, now: Observation) -> Setpoint | None:
        assert now.reading is not None and self._palpation is not None
        progress = self._palpation.step(self._contact, self._rate)
        self._report(progress, now.t)
        self._sense.surface.offset = self._palpation.offset
        if progress.doing is Doing.DONE:
            self._broken = self._palpation.failed
            self._follower.hold(now.reading.q)
            self._enter(Phase.RETURN, now.t, f"returning home: {self._broken}" if self._broken else "returning home")
        return progress.setpoint

    def _report(self, progress: Progress, t: int) -> None:
        status = self.status
        assert self._palpation is not None
        self._skipped |= self._palpation.skipped
        status.steady, status.force_limited = progress.steady, progress.limited
        status.depth_setpoint, status.target_index = progress.depth_setpoint, progress.target
        status.targets_skipped = len(self._skipped)
        phase = PHASE_OF[progress.doing]
        message = self._palpation.failed or progress.doing.value
        if phase is not status.phase or message != status.message:
            self._enter(phase, t, message)

    def _return(self, now: Observation) -> Setpoint | None:
        try:
            if self._move(now, np.array(lbr.HOME)):
                if self._broken:
                    self._abort(now, self._broken)
                else:
                    self._enter(Phase.ASSESS, now.t, "waiting for the findings")
        except NoPathError as error:
            self._abort(now, f"no way home: {error}")
        return None

    def _assess(self, now: Observation) -> Setpoint | None:
        if now.findings_final:
            skipped = f", {len(self._skipped)} of {self.status.target_count} targets skipped" if self._skipped else ""
            self._enter(Phase.DONE, now.t, f"examination complete{skipped}")
        elif now.t - self._since > ASSESS_PATIENCE:
            self._abort(now, f"no final findings after {ASSESS_PATIENCE / SECOND:.0f} s")
        return None

    def _rest(self, now: Observation) -> Setpoint | None:
        return None
