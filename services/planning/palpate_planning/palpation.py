"""The sequence of the strokes: rest, descend to the touch, indent, slide or hold at depth, lift, move over to the next."""

from __future__ import annotations

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_models.scenario.schema import Exam, Limits
from palpate_planning.contact import ContactMeasurement
from palpate_planning.descent import ALLOWANCE_M, SIGMAS, Descent
from palpate_planning.recovery import MOVED_M, Recovery
from palpate_planning.stages import AT_DEPTH, PRESSING, PUSHING, PalpationStep, StrokeStage
from palpate_planning.stroke_motion import ENDED_M, StrokeMotion
from palpate_planning.strokes.segments import HOVER_M, STRETCHED, Segment
from palpate_planning.wall.wall import Wall
from palpate_planning.wall_watch import WallWatch

HOP_M = 0.010
"""Least height of the ways between strokes; it is `HOVER_M` on free motions, and where the surface is not known well."""
LIFT_MPS = 0.12
SETTLED_M = 0.0005
"""Depth error at which an indentation counts as settled ..."""
SETTLED_S = 0.08
"""... after this long,"""
SETTLE_MAX_S = 0.8
"""or after this long anyhow: the measured depth is reported."""
HOLD_S = 0.3
"""Time at a point in which samples are taken."""
STEADY_FRACTION = 0.5
"""Samples count from this part of the path's speed on."""
WAIT_MAX_S = 60.0
"""The arm waits no longer to be asked for the next stroke."""
STOPPED = 0.1
"""Below this part of its speed the descent counts as stopped by force."""
PUSHED = "a force was felt where no skin can be"
"""Why a descent is repeated."""
HIDES = "the arm hides the wall from the camera"
"""Why strokes end where the arm stays in the camera's way: that stroke is passed over."""
UNNOTICED_M = 0.03
"""So much of the stroke before a patient was seen to have moved does not count: it is noticed after a second."""
REPEAT_M = 0.010
"""So much of the stroke before the interruption is repeated: it is noticed after about 0.2 s."""


class Palpation:
    """Executes the segments of a plan; one `step` each planning period until `stage` is DONE."""

    def __init__(
        self,
        segments: tuple[Segment, ...],
        exam: Exam,
        limits: Limits,
        radius: float,
        period_s: float,
        wall: Wall,
        *,
        strokes: int = 0,
        more: bool = False,
    ) -> None:
        """`radius` of the sphere [m]; `wall`: what is pressed, and learns from every touch; `strokes`: descents made before;
        `more`: whether it waits for further segments after the last (`extend`, `close`).
        """
        self._more = more
        self._segments, self._exam, self._limits, self._period_s = segments, exam, limits, period_s
        self._watch = WallWatch(wall.breath, exam.breathing, period_s)
        self.left = ""
        """Why the strokes end early, in good order; empty if they do not."""
        self.ahead: frozenset[int] = frozenset()
        """The targets that are then left."""
        self.bend_needed = 0.0
        """How far a plan must bend the elbow for the arm not to stretch in contact [rad]; 0 where strokes did not end by that."""
        self._motion = StrokeMotion(exam, limits, radius, period_s, wall)
        self._recovery = Recovery(exam, limits, period_s)
        self._descent = Descent(self._motion, exam.depth_m, period_s, strokes)
        self._number = -1
        self._joined = False
        """Whether the commanded depth is where the arm is; after a free motion it is measured first."""
        self._next_segment()

    @property
    def stroke(self) -> int:
        """Number of the latest descent, 0 before the first."""
        return self._descent.stroke

    @property
    def skipped(self) -> dict[int, str]:
        """Targets that a soft stop passed over, with the reason."""
        return self._recovery.skipped

    @property
    def failed(self) -> str:
        """Why the palpation gave up; empty if it did not."""
        return self._recovery.failed

    @property
    def moved(self) -> bool:
        """Whether the strokes ended because the patient has moved: what is `ahead` can be gone on with after a look."""
        return self._watch.moved and not self.failed

    @property
    def free_goal(self) -> Array | None:
        """Where the free motion under way ends [rad], shape (7,); None on a path."""
        free = self._motion.segment.free
        return None if free is None or self.failed or self.stage is StrokeStage.DONE else np.asarray(free.q[-1])

    @property
    def waiting(self) -> bool:
        """Whether it waits for further segments."""
        return self.stage is StrokeStage.WAIT and len(self._segments) == self._number + 1

    @property
    def open_ended(self) -> bool:
        """Whether further segments may be asked for, whatever is left of those there are."""
        return self._more

    def extend(self, segments: tuple[Segment, ...]) -> None:
        """Further segments, which begin where the last one ends."""
        self._segments += segments

    def close(self) -> None:
        """There are no further segments."""
        self._more = False

    # --- interruptions ------------------------------------------------------------------------------------------------

    def abandon(self, why: str) -> None:
        """Lifts off and ends. A free motion ends at once: there is no skin to lift off from, and the arm may be off its way."""
        self._recovery.give_up(why)
        if self._motion.segment.free is not None:
            self._enter(StrokeStage.DONE)
        elif self.stage not in (StrokeStage.LIFT, StrokeStage.DONE):
            self._enter(StrokeStage.LIFT)

    def leave(self, why: str) -> None:
        """Lifts off and ends, in good order: what is left of the plan counts as skipped.

        What is left of a stroke in which the arm hides the wall is not `ahead`: it would be hidden there again.
        """
        if self.left or self.stage is StrokeStage.DONE:
            return
        self.left = why
        strokes = [s.path for s in self._segments[self._number + 1 :] if s.contact and not s.touch]
        later = [int(i) for path in strokes for i in path.targets]
        ahead = list(later)
        path = self._motion.segment.path
        if self._motion.segment.contact and not self._motion.segment.touch:
            behind = UNNOTICED_M if self._watch.moved else 0.0
            ahead += [int(i) for i in path.targets[path.visits > self._felt_until - behind]]
        self._recovery.skipped |= dict.fromkeys(ahead, why)
        self.ahead = frozenset(later if why == HIDES else ahead)
        if self.stage is not StrokeStage.LIFT:
            self._enter(StrokeStage.LIFT)

    @property
    def _felt_until(self) -> float:
        """Up to where the stroke under way has been felt [m]: not at all, before its first target, while it has not slid."""
        if self._recovery.resume_at is not None:
            return self._recovery.resume_at - ENDED_M
        felt = self.stage in (StrokeStage.SLIDE, StrokeStage.LIFT)
        return self._motion.along.position - (0.0 if felt else ENDED_M)

    def pause(self) -> None:
        """Lifts off along the normal and waits there; `resume` comes back to where it was."""
        self._recovery.paused = True
        if self.stage in PRESSING:
            stop = self._motion.along.position + self._motion.stopping_distance
            self._recovery.resume_at = min(stop, self._motion.segment.path.length)
            self._enter(StrokeStage.LIFT)
        else:
            self._rise()

    def _rise(self) -> None:
        """From low above the skin to where a wall that leaps does not reach; `_lift` goes on from there."""
        if self.stage is StrokeStage.REST and self._joined:
            self._recovery.resume_at = self._motion.along.position
            self._enter(StrokeStage.LIFT)
        elif self.stage is StrokeStage.TRANSFER and self._motion.segment.free is None:
            self._enter(StrokeStage.LIFT)

    def resume(self, t: int, contact: ContactMeasurement) -> None:
        """At `t` [ns], goes on after a pause, from where the arm is now: while the driver held, the tissue has pushed it.

        Sideways too: what is on the path may be deep in the tissue, and the arm is not to be drawn through it.
        """
        self._recovery.paused = False
        if self._motion.segment.free is not None:
            return
        centre_height = self._motion.centre_height(t)
        aside = self._recovery.measure_displacement(contact, self._motion.point, centre_height)
        if aside > MOVED_M:
            self.abandon(f"the arm was moved {aside * 1e3:.0f} mm aside while it was held")
        self._motion.restart(contact)

    def skip_free_motion(self) -> None:
        """The arm is where the free motion under way ends, by another motion: goes on with the next segment."""
        self._recovery.paused = False
        self._next_segment()

    # --- the sequence -------------------------------------------------------------------------------------------------

    def step(self, t: int, contact: ContactMeasurement, rate: float = 1.0) -> PalpationStep:
        """One planning period on, at `t` [ns], given the measured contact; `rate` as in `RestartRamp`."""
        self._time += self._period_s
        self._descent.taring, self._descent.touched = False, None
        self._recovery.return_to_path(contact)
        if self.stage not in (StrokeStage.SLIDE, StrokeStage.HOLD):
            self._descent.make_sure()
        if contact.load > self._limits.force_soft_stop_n and self.stage in PRESSING:
            self._recovery.soft_stop(contact.load, self._motion.segment, self._motion.along.position)
            self._enter(StrokeStage.LIFT)
        self._heed_the_elbow(contact)
        self._heed_the_wall(t, contact)
        if self.stage is StrokeStage.SLIDE:
            self._slide()
        elif self.stage is StrokeStage.LIFT:
            self._lift(t)
        elif self.stage is StrokeStage.TRANSFER:
            self._transfer(rate)
        elif self.stage is StrokeStage.REST:
            self._rest(contact)
        elif self.stage is StrokeStage.DESCEND:
            self._descend(t, contact)
        elif self.stage is StrokeStage.SETTLE:
            self._settle(contact)
        elif self.stage is StrokeStage.HOLD:
            self._hold()
        elif self.stage is StrokeStage.WAIT:
            self._wait()
        in_contact = contact.touching and self.stage is not StrokeStage.LIFT
        self._motion.regulate(contact, in_contact=in_contact, pushing=self.stage in PUSHING)
        return self._report(t, contact, rate)

    def _heed_the_elbow(self, contact: ContactMeasurement) -> None:
        """Lifts off before the arm would have to stretch, in a stroke or on the way to the next, and ends."""
        followed = self.stage in PRESSING or (self.stage is StrokeStage.TRANSFER and self._motion.segment.free is None)
        if followed and self._motion.bend_ahead < (needed := self._motion.bend_needed(contact.q)):
            self.bend_needed = needed
            self.leave(STRETCHED)

    def _heed_the_wall(self, t: int, contact: ContactMeasurement) -> None:
        """Lifts off where the wall does what was not expected; that piece of the stroke is repeated."""
        sliding = self.stage is StrokeStage.SLIDE
        adrift, leaving = sliding and not contact.touching, self._motion.segment.free is not None
        self._watch.step(t, adrift=adrift, leaving=leaving)
        if self._watch.hidden:
            self.leave(HIDES)
        elif self._watch.ended:
            self.leave(self._watch.ended)
        elif self._watch.spoiled and self.stage in PRESSING:
            back = REPEAT_M if sliding else 0.0
            self._repeat(back, "the wall could not be followed")
        elif self._watch.leaps:
            self._rise()

    def _repeat(self, back: float, why: str) -> None:
        """Lifts off, and takes the stroke up again `back` [m] before where it is, for `why`."""
        self._recovery.repeat(self._motion.segment, self._motion.along.position, back, why)
        self._enter(StrokeStage.LIFT)

    def _enter(self, stage: StrokeStage) -> None:
        self.stage = stage
        self._time = self._settled = self._held = self._highest = 0.0
        if stage is StrokeStage.REST:
            self._descent.start()

    def _next_segment(self) -> None:
        if self._number + 1 == len(self._segments):
            self._enter(StrokeStage.WAIT if self._more else StrokeStage.DONE)
            return
        self._number += 1
        segment = self._segments[self._number]
        self._motion.start(segment)
        self._joined = self._joined and segment.free is None
        self._enter(StrokeStage.REST if segment.contact else StrokeStage.TRANSFER)

    def _wait(self) -> None:
        """Above the skin, until it is known what comes next."""
        self._motion.depth.step(-HOVER_M, LIFT_MPS)
        if self._time > WAIT_MAX_S:
            self.left = f"no further stroke was asked for within {WAIT_MAX_S:g} s"
        if self.failed or self.left:
            self._enter(StrokeStage.DONE)
        elif not self._recovery.paused and (len(self._segments) > self._number + 1 or not self._more):
            self._next_segment()

    def _rest(self, contact: ContactMeasurement) -> None:
        """Above the skin, in free air, until the sensor is tared."""
        if not self._joined:
            self._motion.restart(contact)
            self._joined = True
        if not self._watch.calm or self._recovery.displacement is not None:
            self._descent.start()
        if not self._recovery.paused and self._descent.rest(self._at_least(_clearance(contact.wall.sigma)), LIFT_MPS):
            self._enter(StrokeStage.DESCEND)

    def _descend(self, t: int, contact: ContactMeasurement) -> None:
        """Down to the skin, and once it is touched down to depth, or as deep as the force allows."""
        if not self._descent.probe(contact, t):
            if self._descent.missed:
                end = self.abandon if self.stroke == 1 else self.leave
                end(self._descent.missed)
            elif self._descent.pushed:
                self._repeat(0.0, PUSHED)
        elif self._motion.segment.touch:
            self._enter(StrokeStage.LIFT)
        else:
            there = self._motion.deepen()
            stopped = self._motion.slowdown(0.7, 1.0, 0.0) < STOPPED
            self._settled = self._settled + self._period_s if stopped else 0.0
            if there or self._settled > SETTLED_S:
                self._enter(StrokeStage.SETTLE)

    def _settle(self, contact: ContactMeasurement) -> None:
        self._motion.deepen()
        near = abs(self._motion.regulation.reference - contact.depth) < SETTLED_M
        self._settled = self._settled + self._period_s if near else 0.0
        if self._settled >= SETTLED_S or self._time >= SETTLE_MAX_S:
            self._enter(StrokeStage.SLIDE if self._motion.segment.path.length > 0 else StrokeStage.HOLD)

    def _slide(self) -> None:
        self._motion.deepen()
        if not self._watch.open:
            self._motion.brake()
        elif self._motion.slide():
            self._enter(StrokeStage.LIFT)

    def _hold(self) -> None:
        self._held += self._period_s if self._watch.open else 0.0
        if self._held >= HOLD_S:
            self._enter(StrokeStage.LIFT)

    def _lift(self, t: int) -> None:
        self._motion.brake()
        if not self._motion.depth.step(-self._at_least(self._height(t)), LIFT_MPS) or self._recovery.paused:
            return
        if self.failed or self.left:
            self._enter(StrokeStage.DONE)
        elif not self._watch.calm or self._recovery.displacement is not None:
            return
        elif self._recovery.resume_at is not None or not self._motion.ended:  # the next way begins at the stroke's end
            self._enter(StrokeStage.TRANSFER)
        else:
            self._next_segment()

    def _at_least(self, height: float) -> float:
        """The greatest height [m] asked for in this stage: one that falls and rises with what is known is never reached."""
        self._highest = max(self._highest, height)
        return self._highest

    def _height(self, t: int) -> float:
        """How high to lift at `t` [ns]; in metres."""
        sure = self._watch.calm and not self._recovery.paused
        if self.failed or self.left or not sure or self._number == len(self._segments) - 1:
            return self._motion.free_height(t)
        if self._recovery.resume_at is not None:
            return HOP_M
        way, wall = self._segments[self._number + 1], self._motion.wall
        if way.free is not None:
            return self._motion.free_height(t)
        return _clearance(wall.sigma(wall.perceived.xy(way.path.p[-1]), t))

    def _transfer(self, rate: float) -> None:
        motion, recovery = self._motion, self._recovery
        if recovery.paused:
            motion.brake()
        elif motion.segment.free is not None:
            if motion.follow_free_motion(rate):
                self._next_segment()
        elif recovery.displacement is not None:
            motion.depth.step(min(-HOP_M, motion.depth.position), LIFT_MPS)
        elif recovery.resume_at is None:
            if motion.travel(motion.segment.path.length):
                self._next_segment()
        elif motion.travel(recovery.resume_at):
            recovery.resume_at = None
            self._enter(StrokeStage.REST)

    def _report(self, t: int, contact: ContactMeasurement, rate: float) -> PalpationStep:
        motion = self._motion
        setpoint = motion.setpoint(t, contact, rate)
        if motion.segment.free is not None:
            return PalpationStep(setpoint, self.stage, -HOVER_M, False, False, int(motion.segment.path.targets[-1]))
        if self._recovery.displacement is not None:
            setpoint = self._recovery.displacement.move(setpoint)
        limited = motion.regulation.limited or (motion.short_of_depth and self.stage in AT_DEPTH)
        fast = motion.along.velocity >= STEADY_FRACTION * self._exam.speed_mps or limited
        steady = (
            contact.touching
            and self._watch.open
            and (self.stage is StrokeStage.HOLD or (self.stage is StrokeStage.SLIDE and fast))
        )
        descent = self._descent
        return PalpationStep(
            setpoint, self.stage, motion.regulation.reference, steady, limited, motion.target, descent.taring, descent.touched
        )


def _clearance(sigma: float) -> float:
    """Height [m] at which the skin, known within `sigma` [m], is surely not touched, and from which it is sought."""
    return min(max(HOP_M, SIGMAS * sigma + ALLOWANCE_M), HOVER_M)
