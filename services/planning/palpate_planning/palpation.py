"""The strokes of a plan, one after the other, and their interruptions.

| what happens | arm | targets ahead |
|---|---|---|
| the last segment ends, and no `more` may follow | stays above the wall | none |
| no request in time (`early_end`) | stays above the wall | none |
| `leave`: patient moved, wall hidden, elbow too straight, first place without tissue, long wait | lifts and ends* | `ahead` |
| `abandon`, last allowed soft stop or place without tissue (`failed`) | lifts and ends* | `remaining` |
| `pause` | lifts and waits for `resume` | examined from there |
| force at the soft-stop limit | lifts | near ones skipped, then examined |
| wall against its forecast | lifts | examined from shortly before; skipped after several repeats |

*A free motion ends at once: it has no wall to lift off from, and the arm may be off its path.
"""

from collections import deque
from typing import NamedTuple

import numpy as np

from palpate_bus.messages.codes import Reason
from palpate_bus.setpoint import Setpoint
from palpate_models.numerics.frames import Array
from palpate_models.scenario.schema import MOTION_NOTICED_S, ExamInput
from palpate_planning import stroke
from palpate_planning.contact import ContactMeasurement
from palpate_planning.interruptions import RECOVERY, ForceWatch, Recovery, WallWatch
from palpate_planning.reasons import FOR_ARM, FOR_BREATH, FOR_JOINTS, FOR_REQUEST, FOR_WALL, Cause, StrokeWaits, Tally, Wait
from palpate_planning.stroke import StrokeStage
from palpate_planning.stroke_motion import StrokeMotion
from palpate_planning.strokes.plan import SEGMENTS, STRETCHED, Segment
from palpate_planning.wall.wall import PublishedTouch, Wall


class PalpationTuning(NamedTuple):
    """Tuning of repeated and requested strokes."""

    repeat_m: float = 0.010
    """Path length repeated after an interruption [m]; detection takes about 0.2 s."""


TUNING = PalpationTuning()

HIDDEN = Cause(Reason.WALL_HIDDEN, "the arm hides the wall from the camera", "camera/follow/depth")
NOT_TRACKED = Cause(Reason.WALL_NOT_TRACKED, "the wall could not be tracked", "camera/follow/depth")
SURGED = Cause(Reason.FORCE, "the force rose suddenly")
REPLANNED = frozenset({Reason.ARM_STRETCHED, Reason.WALL_HIDDEN})
"""Reasons after which the rest of the targets is planned again."""


class PalpationStep(NamedTuple):
    """Result of one planning period."""

    setpoint: Setpoint
    stage: StrokeStage
    depth_setpoint: float
    """[m]"""
    steady: bool
    """True if a measurement of this step is a valid sample."""
    limited: bool
    """True if force keeps the indenter from the depth asked for."""
    target: int
    """Index of the latest target reached."""
    taring: bool = False
    """True if the arm rests in free air: what the sensor reads now is bias."""
    touched: PublishedTouch | None = None
    """The touch of this step, if there was one."""


class Palpation:
    """Executes the segments of a plan; one `step` each planning period until `stage` is DONE.

    An interruption lifts the tool; then the segment is resumed.
    """

    def __init__(
        self, segments: tuple[Segment, ...], known: ExamInput, period_s: float, wall: Wall, tally: Tally, strokes: int = 0
    ) -> None:
        """Start with the first segment.

        Args:
            segments: strokes and the paths between them, at least one.
            known: examination, limits, arm and tool.
            period_s: planning period [s].
            wall: what is pressed; every touch corrects it.
            tally: counts of the plans before, which these strokes continue.
            strokes: descents made before.
        """
        exam, limits = known.exam, known.limits
        self._segments, self._limits = segments, limits
        self.more = False
        """True if further segments may follow (`extend`)."""
        self._number = -1
        self.stage = StrokeStage.WAIT
        self._motion = StrokeMotion(exam, limits, known.robot, period_s, wall)
        self.descent = stroke.Descent(self._motion, exam.depth_m, strokes)
        self.looked_again = False
        """True if the surface was scanned again because no tissue was felt."""
        self._blind_places = 0
        self._pressed = False
        """True once the present stroke has been pressed to its end."""
        self._watch = WallWatch(wall.breath, exam.breathing, period_s, tally)
        self._forces = ForceWatch(period_s)
        self.recovery = Recovery(exam, limits, period_s, tally)
        self.waits, self._strokes_before = StrokeWaits(period_s, tally), strokes
        self._felt: deque[int | None] = deque(maxlen=round(MOTION_NOTICED_S / period_s))
        """The target that each of the latest steps measured, None for none."""
        self.ahead: frozenset[int] = frozenset()
        """The targets that are left when the strokes end early."""
        self.bend_needed = 0.0
        """Bend of the elbow [rad] that a new plan needs; 0 where the strokes did not end because the arm would stretch."""
        self._continue_with(self._remaining())

    # --- state --------------------------------------------------------------------------------------------------------

    @property
    def moved(self) -> bool:
        """True if the strokes ended because the patient has moved: the targets `ahead` can be examined after a new view."""
        return self._watch.moved and not self.recovery.failed

    @property
    def free_goal(self) -> Array | None:
        """Goal of the present free motion [rad], shape (n,); None on a path."""
        free = self._motion.segment.free
        return None if free is None or self.recovery.failed or self.stage is StrokeStage.DONE else np.asarray(free.q[-1])

    @property
    def waiting(self) -> bool:
        """True if it waits for further segments."""
        return self.stage is StrokeStage.WAIT and len(self._segments) == self._number + 1

    @property
    def remaining(self) -> frozenset[int]:
        """Targets of the present stroke that were not measured, of the later ones, and those felt while the patient moved."""
        segment, later = self._motion.segment, self._later
        if self._watch.moved:
            later = later.union(i for i in self._felt if i is not None)
        if not measures_targets(segment):
            return later
        measured = self._pressed or self.stage is StrokeStage.SLIDE
        reached = self.recovery.measured_length(self._motion.along.position, measured=measured)
        return later.union(segment.path.targets[segment.path.visits > reached].tolist())

    @property
    def _later(self) -> frozenset[int]:
        strokes = [segment for segment in self._segments[self._number + 1 :] if measures_targets(segment)]
        return frozenset(int(i) for stroke in strokes for i in stroke.path.targets)

    # --- commands -----------------------------------------------------------------------------------------------------

    def extend(self, segments: tuple[Segment, ...]) -> None:
        """Append segments, which begin where the last one ends."""
        self._segments += segments

    def abandon(self, cause: Cause) -> None:
        """Lift off and end."""
        self.recovery.give_up(cause)
        if self.stage not in (StrokeStage.LIFT, StrokeStage.DONE):
            self._interrupt()

    def leave(self, cause: Cause) -> None:
        """Lift off and end without failure: the rest of the plan counts as skipped."""
        if self.recovery.early_end or self.stage is StrokeStage.DONE:
            return
        self._skip_rest(cause)
        if self.stage is not StrokeStage.LIFT:
            self._interrupt()

    def pause(self) -> None:
        """Lift off along the normal and wait there for `resume`."""
        self.recovery.paused = True
        if self.stage in stroke.PRESSING:
            self.recovery.resume_at = self._motion.along.position
            self._interrupt()
        else:
            self._rise()

    def resume(self, t: int, contact: ContactMeasurement) -> None:
        """Continue at `t` [ns] after a pause, from where the arm is: the tissue has pushed it while the driver held it.

        It lifts first and returns laterally above the wall, since the arm must not be drawn through tissue.
        """
        self.recovery.paused = False
        if self._motion.segment.free is not None:
            return
        if displaced := self.recovery.begin_return(contact, self._motion.point, self._motion.centre_height(t)):
            self.abandon(displaced)
        self._motion.restart(contact)

    def skip_free_motion(self) -> None:
        """Continue with the next segment: another motion took the arm to the goal of the present free motion."""
        self.recovery.paused, self._motion.posture = False, None
        self._continue_with(self._remaining())

    def step(self, t: int, contact: ContactMeasurement, rate: float = 1.0) -> PalpationStep:
        """Advance one planning period, at `t` [ns], given the measured contact; `rate` as in `RestartRamp`.

        Each part needs those before it: an interruption replaces the stages, and each check sees what those before it have
        begun; the stages set the target of the motion, the depth is regulated towards it, and the report shows the result.
        """
        self.recovery.return_to_path(contact)
        if self.stage not in (StrokeStage.SLIDE, StrokeStage.HOLD):  # no samples are taken
            self.descent.revise()
        self._check_force(contact)
        self._check_elbow(contact)
        self._check_wall(t, contact)
        self._check_waits()
        self._resume_stages(t, contact, rate)
        in_contact = contact.touching and self.stage is not StrokeStage.LIFT
        pushing = self.stage in stroke.PUSHING and not (self.recovery.paused or self.recovery.ending)
        self._motion.regulate(contact, in_contact=in_contact, pushing=pushing)
        return self._report(t, contact, rate)

    def _resume_stages(self, t: int, contact: ContactMeasurement, rate: float) -> None:
        """Resume the stages for one period, in which they may tare the sensor or find the touch."""
        descent, recovery = self.descent, self.recovery
        descent.taring, descent.touched = False, None
        self.stage = self._stages.send(
            stroke.StrokeInput(
                t,
                contact,
                gate_open=self._watch.open,
                calm=self._watch.calm,
                aligned=recovery.displacement is None,
                paused=recovery.paused,
                ending=recovery.ending,
                rate=rate,
            )
        )
        only_touched = self._motion.segment.touch
        measuring = self.stage in (StrokeStage.SLIDE, StrokeStage.HOLD)
        self._felt.append(self._motion.target if measuring else None)
        if measuring or (descent.touched and only_touched):
            self.waits.reach(self._number, self._motion.along.position, at_depth=not only_touched)

    # --- the sequence -------------------------------------------------------------------------------------------------

    def _remaining(self) -> stroke.Stages[None]:
        """Return the segments from the next one on."""
        while self._number + 1 < len(self._segments) or (self.more and (yield from self._wait())):
            self._number += 1
            segment = self._segments[self._number]
            self._motion.start(segment)
            self._pressed = False
            if segment.free is not None:
                yield from stroke.follow(self._motion)
            elif segment.contact:
                yield from self._press()
                yield from self._lift()
            else:
                yield from stroke.travel(self._motion, segment.path.length)
        yield from _report_done()

    def _after_interruption(self) -> stroke.Stages[None]:
        """Return the lift after an interruption, the rest of the segment and the remaining ones."""
        yield from self._lift()
        yield from self._remaining()

    def _wait(self) -> stroke.Stages[bool]:
        """Wait above the wall; return True if a further segment follows."""
        while True:
            now = yield StrokeStage.WAIT
            self._motion.move_depth(-SEGMENTS.hover_m, stroke.STROKE.lift_mps)
            if self.recovery.ending:
                return False
            if not now.paused and (len(self._segments) > self._number + 1 or not self.more):
                return len(self._segments) > self._number + 1

    def _press(self) -> stroke.Stages[None]:
        """Press along the present segment, from where the arm is."""
        cause = yield from stroke.press(self._motion, self.descent)
        self._pressed = not cause
        self._blind_places = self._blind_places + 1 if cause.reason is Reason.NO_TISSUE else 0
        if cause.reason is Reason.NO_TISSUE:
            self._miss(cause)
        elif cause:
            self.recovery.repeat(self._motion.segment, self._motion.along.position, 0.0, cause)

    def _miss(self, cause: Cause) -> None:
        """Scan the surface again where no tissue was felt; then give up the place; after several in a row, all of them."""
        if not self.looked_again:
            self._skip_rest(cause)
        elif self._blind_places < RECOVERY.blind_places_max:
            self.recovery.give_up_place(self._motion.segment, self._motion.along.position, cause)
        else:
            text = f"{cause.text}, at {self._blind_places} places: the surface or the force sensor is wrong"
            self.recovery.give_up(cause._replace(text=text))

    def _lift(self) -> stroke.Stages[None]:
        """Lift off; take the stroke up again where it was interrupted, else move above the wall to the end of its path."""
        motion, recovery = self._motion, self.recovery
        while True:
            yield from stroke.lift(motion, self._height)
            if recovery.ending:
                yield from _report_done()
            if recovery.resume_at is None:
                if not motion.ended:
                    yield from stroke.travel(motion, motion.segment.path.length)
                return
            yield from stroke.travel(motion, recovery.resume_at)
            recovery.resume_at = None
            yield from self._press()

    def _height(self, t: int) -> float:
        """Return the height of the lift [m] at `t` [ns]."""
        wall, following = self._motion.wall, self._segments[self._number + 1 : self._number + 2]
        certain = self._watch.calm and not self.recovery.paused
        if self.recovery.ending or not certain or not following:
            return self._motion.free_height(t)
        if self.recovery.resume_at is not None:
            return stroke.STROKE.hop_height_m
        if following[0].free is not None:
            return self._motion.free_height(t)
        return stroke.clearance(wall.at(wall.perceived.xy(following[0].path.p[-1]), t).sigma)

    def _report(self, t: int, contact: ContactMeasurement, rate: float) -> PalpationStep:
        motion, descent = self._motion, self.descent
        setpoint = motion.setpoint(t, contact, rate)
        if motion.segment.free is not None:
            return PalpationStep(setpoint, self.stage, -SEGMENTS.hover_m, False, False, int(motion.segment.path.targets[-1]))
        if self.recovery.displacement is not None:
            setpoint = self.recovery.displacement.move(setpoint)
        limited = stroke.is_limited(self.stage, motion)
        steady = contact.touching and self._watch.open and stroke.is_steady(self.stage, motion, limited=limited)
        depth = motion.regulation.reference_m
        return PalpationStep(setpoint, self.stage, depth, steady, limited, motion.target, descent.taring, descent.touched)

    # --- interruptions ------------------------------------------------------------------------------------------------

    def _continue_with(self, stages: stroke.Stages[None]) -> None:
        self._stages = stages
        self.stage = next(stages)

    def _interrupt(self) -> None:
        """Lift off from whatever the arm does; end a free motion."""
        self._continue_with(self._after_interruption() if self._motion.segment.free is None else _report_done())

    def _check_force(self, contact: ContactMeasurement) -> None:
        """Lift off at the soft-stop force and skip the targets there; before a sudden force, and press there again."""
        foreseen = self._forces.step(contact.load)
        if contact.load > self._limits.force_soft_stop_n and self.stage in stroke.PRESSING:
            self.recovery.soft_stop(contact.load, self._motion.segment, self._motion.along.position)
            self._interrupt()
        elif foreseen > self._limits.force_working_n and self.stage in stroke.PRESSING:
            self.recovery.repeat(self._motion.segment, self._motion.along.position, 0.0, SURGED)
            self._interrupt()

    def _check_elbow(self, contact: ContactMeasurement) -> None:
        """End the strokes before the arm would have to stretch, in a stroke or on the path to the next."""
        followed = self.stage in stroke.PRESSING or (self.stage is StrokeStage.TRANSFER and self._motion.segment.free is None)
        if followed and self._motion.bend_ahead < (needed := self._motion.bend_needed(contact.q)):
            self.bend_needed = needed
            self.leave(STRETCHED)

    def _check_wall(self, t: int, contact: ContactMeasurement) -> None:
        """Lift off where the wall moves against its forecast; that part of the stroke is repeated."""
        sliding = self.stage is StrokeStage.SLIDE
        on_free_motion = self._motion.segment.free is not None
        self._watch.step(t, contact_lost=sliding and not contact.touching, on_free_motion=on_free_motion)
        if self._watch.hidden:
            self.leave(HIDDEN)
        elif self._watch.ended:
            self.leave(self._watch.ended)
        elif self._watch.spoiled and self.stage in stroke.PRESSING:
            back = TUNING.repeat_m if sliding else 0.0
            if self._watch.leaps:  # a cough or deep breath: only the time of waiting bounds the repeats
                self.recovery.take_up(self._motion.along.position, back)
            else:
                self.recovery.repeat(self._motion.segment, self._motion.along.position, back, NOT_TRACKED)
            self._interrupt()
        elif self._watch.leaps:
            self._rise()

    def _check_waits(self) -> None:
        """End strokes that wait for too long: without failure if tissue has been measured."""
        end = self.waits.step(self._present_wait())
        if not end:
            return
        if end.reason is Reason.NO_REQUEST:
            self.recovery.early_end = end
        elif end.reason is Reason.ARM_DISPLACED or not (self.waits.pressed or self._strokes_before):
            self.abandon(end)
        else:
            self.leave(end)

    def _present_wait(self) -> Wait | None:
        """Return what the arm waits for. A pause is not counted here: its stop has a bound."""
        stage, open_gate = self.stage, self._watch.open
        if self.recovery.paused or self.recovery.ending:
            return None
        if stage is StrokeStage.WAIT:
            return FOR_REQUEST
        if stage in (StrokeStage.REST, StrokeStage.LIFT) and not self._watch.calm:
            return FOR_WALL if open_gate else FOR_BREATH
        returns = stage in (StrokeStage.REST, StrokeStage.LIFT, StrokeStage.TRANSFER)
        if self._motion.behind:
            return FOR_JOINTS
        if returns and self.recovery.displacement is not None:
            return FOR_ARM
        return FOR_BREATH if stage in (StrokeStage.SLIDE, StrokeStage.HOLD) and not open_gate else None

    def _rise(self) -> None:
        """Lift from low above the wall to where its sudden motion does not reach."""
        if self.stage is StrokeStage.REST and self._motion.joined:
            self.recovery.resume_at = self._motion.along.position
            self._interrupt()
        elif self.stage is StrokeStage.TRANSFER and self._motion.segment.free is None:
            self._interrupt()

    def _skip_rest(self, cause: Cause) -> None:
        """Skip the targets ahead.

        A stroke in which the arm hides the wall is not `ahead`: the wall would be hidden there again.
        """
        remaining = self.remaining
        self.recovery.leave(cause, remaining)
        self.ahead = self._later if cause.reason is Reason.WALL_HIDDEN else remaining


def measures_targets(segment: Segment) -> bool:
    """Return True for a stroke that measures its targets."""
    return segment.contact and not segment.touch


def _report_done() -> stroke.Stages[None]:
    while True:
        yield StrokeStage.DONE
