"""One stroke: rest and tare above the wall, descend to the touch, indent, settle, slide or hold, lift.

`press`, `lift` and `travel` are generators. Each resumption is one planning period: it receives a `StrokeInput`, moves the
indenter (`StrokeMotion`) and yields the stage of the stroke. The planning service and the quick tier drive the same generators.
"""

from collections.abc import Callable, Generator
from enum import Enum
from typing import Final, NamedTuple, TypeVar

from palpate_bus.messages.codes import Reason
from palpate_planning.contact import ContactMeasurement
from palpate_planning.reasons import NO_CAUSE, Cause
from palpate_planning.stroke_motion import MOTION, StrokeMotion
from palpate_planning.strokes.plan import SEGMENTS
from palpate_planning.wall.touch import FELT_N, Onset
from palpate_planning.wall.wall import PublishedTouch


class StrokeTuning(NamedTuple):
    """Tolerances, times and heights of a stroke."""

    hop_height_m: float = 0.010
    """Minimum height between strokes; it is `SEGMENTS.hover_m` on free motions and where the wall is uncertain."""
    lift_mps: float = 0.12
    settled_error_m: float = 0.0005
    """An indentation has settled when its depth error stays below this for `settled_s`, or after `settle_timeout_s`."""
    settled_s: float = 0.08
    settle_timeout_s: float = 0.8
    press_s: float = 0.5
    """Time at depth before a slide: the hold of the standard press, by which slides are converted for this patient."""
    hold_s: float = 0.3
    """Time at a point in which samples are taken."""
    steady_speed_fraction: float = 0.5
    """Samples count from this fraction of the path's speed on."""


class TouchTuning(NamedTuple):
    """Times of taring, speeds and range of the search for the wall."""

    descend_mps: float = 0.08
    probe_mps: float = 0.014
    """Speed at which the wall is sought: force rises by about 3 N/s."""
    sigmas: float = 3.0
    """The wall is sought within this many standard deviations of its estimate."""
    blind_m: float = 0.020
    """Maximum search depth below the estimated wall: three SD of camera and arm together (6.5 mm with typical
    errors, 1,000 tuning seeds)."""
    margin_m: float = 0.003
    """The search begins at this height above that range: the fit of the onset needs samples in air."""
    rest_s: float = 0.15
    """Time at rest before taring, in which the arm's oscillations fade."""
    tare_s: float = 0.25
    """Time of taring: 25 means over 10 ms of 0.1 N noise leave 6 mN."""


STROKE: Final = StrokeTuning()
TOUCH: Final = TouchTuning()


class StrokeStage(Enum):
    """Part of a stroke; its value is the text of `exam/state`."""

    REST = "resting above the skin"
    DESCEND = "descending"
    SETTLE = "settling at depth"
    SLIDE = "sliding at depth"
    HOLD = "holding at depth"
    LIFT = "lifting"
    TRANSFER = "moving to the next stroke"
    WAIT = "waiting for the next stroke"
    DONE = "done"


AT_DEPTH: Final = (StrokeStage.SLIDE, StrokeStage.HOLD, StrokeStage.SETTLE)
PRESSING: Final = (*AT_DEPTH, StrokeStage.DESCEND)
"""Stages in which the tissue is pressed, or is about to be."""
PUSHING: Final = (*PRESSING, StrokeStage.LIFT)
"""Stages in which the measured force is fed forward."""


class StrokeInput(NamedTuple):
    """Input of a stroke at one planning period."""

    t: int
    """[ns]"""
    contact: ContactMeasurement
    gate_open: bool = True
    """True if samples may be taken at this moment of the breath."""
    calm: bool = True
    """True if the wall has been tracked well for long enough to be touched."""
    aligned: bool = True
    """True if the arm is on its path: it was not pushed aside."""
    paused: bool = False
    """True if the arm has to wait above the wall."""
    ending: bool = False
    """True if no stroke follows: the arm lifts, whatever the wall does."""
    rate: float = 1.0
    """Samples of a free motion to advance by; see `RestartRamp`."""


T = TypeVar("T")
Stages = Generator[StrokeStage, StrokeInput, T]
"""Part of a stroke, period by period."""


class Duration:
    """Time for which a condition has held without interruption [s]."""

    def __init__(self, period_s: float, begin_s: float = 0.0) -> None:
        self._period_s, self.s = period_s, begin_s

    def update(self, holds: bool) -> float:
        """Add a period in which the condition holds, or start again from zero; return the time."""
        self.s = self.s + self._period_s if holds else 0.0
        return self.s


def clearance(sigma: float) -> float:
    """Return the height [m] from which skin that is known within `sigma` [m] is sought, where it is not touched yet.

    At most `hover_m`, the height of the planned paths.
    """
    return min(max(STROKE.hop_height_m, TOUCH.sigmas * sigma + TOUCH.margin_m), SEGMENTS.hover_m)


def press(motion: StrokeMotion, descent: "Descent") -> Stages[Cause]:
    """Press along the segment; return why the wall was not pressed, if it was not."""
    yield from _rest(motion, descent)
    cause = yield from _descend(motion, descent)
    if cause or motion.segment.touch:
        return cause
    yield from _settle(motion)
    if motion.segment.path.length > 0:
        yield from _slide(motion)
    else:
        yield from _hold(motion)
    return NO_CAUSE


def _rest(motion: StrokeMotion, descent: "Descent") -> Stages[None]:
    """Rest above the wall, in free air, until the sensor is tared."""
    descent.start()
    height, rested = 0.0, False
    while not rested:
        now = yield StrokeStage.REST
        motion.join(now.contact)
        if not (now.calm and now.aligned):
            descent.start()
        if not now.paused:
            height = max(height, clearance(now.contact.wall.sigma))  # monotonic: a height that falls and rises is never reached
            rested = descent.rest(height)


def _descend(motion: StrokeMotion, descent: "Descent") -> Stages[Cause]:
    """Descend to the touch, and in tissue to depth, or as deep as the force allows."""
    while not descent.probe((yield StrokeStage.DESCEND)):
        if descent.failed:
            return descent.failed
    if not motion.segment.touch:
        stopped = Duration(motion.period_s)
        while not motion.deepen() and stopped.update(motion.stopped_by_force) <= STROKE.settled_s:
            yield StrokeStage.DESCEND
    return NO_CAUSE


def _settle(motion: StrokeMotion) -> Stages[None]:
    """Wait until the depth error is small; before a slide also for the hold of a standard press."""
    settled, waited = Duration(motion.period_s), Duration(motion.period_s)
    min_s = STROKE.press_s if motion.segment.path.length > 0 else 0.0
    while waited.s < min_s or (settled.s < STROKE.settled_s and waited.s < STROKE.settle_timeout_s):
        now = yield StrokeStage.SETTLE
        motion.deepen()
        settled.update(abs(motion.regulation.reference_m - now.contact.depth) < STROKE.settled_error_m)
        waited.update(True)


def _slide(motion: StrokeMotion) -> Stages[None]:
    """Follow the path at depth; with gated breathing only at the end of expiration."""
    arrived = False
    while not arrived:
        now = yield StrokeStage.SLIDE
        motion.deepen()
        if now.gate_open:
            arrived = motion.slide()
        else:
            motion.brake()


def _hold(motion: StrokeMotion) -> Stages[None]:
    """Hold at depth; with gated breathing only the end of expiration counts."""
    held_s = 0.0
    while held_s < STROKE.hold_s:
        now = yield StrokeStage.HOLD
        held_s += motion.period_s if now.gate_open else 0.0


def lift(motion: StrokeMotion, height: Callable[[int], float]) -> Stages[None]:
    """Rise along the normal to `height(t)` [m], and wait there at rest until the arm may move on."""
    highest = 0.0
    while True:
        now = yield StrokeStage.LIFT
        resting = motion.brake()
        highest = max(highest, height(now.t))
        up = motion.move_depth(-highest, STROKE.lift_mps)
        if up and resting and not now.paused and (now.ending or (now.calm and now.aligned)):
            return


def travel(motion: StrokeMotion, goal: float) -> Stages[None]:
    """Follow the path above the wall to path length `goal` [m]."""
    arrived = False
    while not arrived:
        now = yield StrokeStage.TRANSFER
        if now.paused:
            motion.brake()
        elif not now.aligned:
            motion.move_depth(min(-STROKE.hop_height_m, motion.depth_axis.position), STROKE.lift_mps)
        else:
            arrived = motion.travel(goal)


def follow(motion: StrokeMotion) -> Stages[None]:
    """Follow the segment's free motion."""
    arrived = False
    while not arrived:
        now = yield StrokeStage.TRANSFER
        arrived = motion.follow_free_motion(now.rate)


def is_steady(stage: StrokeStage, motion: StrokeMotion, *, limited: bool) -> bool:
    """Return True if a sample taken in contact at this stage is valid: at depth, and at speed while sliding."""
    fast = limited or motion.along.velocity >= STROKE.steady_speed_fraction * motion.speed_mps
    return stage is StrokeStage.HOLD or (stage is StrokeStage.SLIDE and fast)


def is_limited(stage: StrokeStage, motion: StrokeMotion) -> bool:
    """Return True if force keeps the indenter from the depth of the examination."""
    return motion.regulation.limited or (motion.short_of_depth and stage in AT_DEPTH)


class Descent:
    """Takes one stroke after another down to the wall; the touch corrects its estimate, and depth is counted from there."""

    def __init__(self, motion: StrokeMotion, depth: float, strokes: int = 0) -> None:
        """Args: `depth` [m] below the wall at which force is measured at the latest; `strokes`: descents made before."""
        self._motion, self._depth = motion, depth
        self.stroke = strokes
        """Number of the present or latest descent, from 1 on."""
        self.taring = False
        """True if the arm is at rest in free air, so that the sensor reads bias and weight."""
        self.touched: PublishedTouch | None = None
        """The touch, in the period in which it was found."""
        self.start()

    def start(self) -> None:
        """Reset the state for the next descent."""
        self._rested = Duration(self._motion.period_s)
        self._deepest = 0.0
        self._onset = Onset()
        self._found = self._revised = False
        self.failed = NO_CAUSE
        """Cause of a failed search, if any."""

    def rest(self, height: float) -> bool:
        """Rest `height` [m] above the wall; return True once the sensor is tared."""
        rested_s = self._rested.update(self._motion.move_depth(-height, STROKE.lift_mps))
        over = rested_s >= TOUCH.rest_s + TOUCH.tare_s
        self.taring = not over and rested_s >= TOUCH.rest_s
        self.stroke += over
        return over

    def probe(self, now: StrokeInput) -> bool:
        """Descend fast to the uncertainty of the wall, from there at probe speed; return True once the wall is touched.

        What is known of the wall bounds the descent, whatever the force is.
        """
        contact, depth = now.contact, self._motion.depth_axis
        unsure = TOUCH.sigmas * contact.wall.sigma
        braking = depth.velocity**2 / MOTION.depth_acceleration_mps2  # twice the stopping distance, since jerk is limited
        near = depth.position > -unsure - TOUCH.margin_m - braking
        self._deepest = max(self._deepest, unsure + self._depth)  # monotonic, as the height of a rest
        arrived = self._motion.move_depth(self._deepest, TOUCH.probe_mps if near else TOUCH.descend_mps)
        there = arrived or depth.position >= TOUCH.blind_m
        if near:
            self._onset.add(contact.depth, contact.force, now.t, contact.wall.displacement)
        if contact.force >= FELT_N and not near:
            self.failed = Cause(Reason.UNEXPECTED_CONTACT, "contact force above the skin")
        elif contact.joints_only and contact.force < FELT_N:
            self.failed = Cause(Reason.UNEXPECTED_CONTACT, "joint torques show a contact, the F/T sensor does not", "ft/wrench")
        elif contact.force >= FELT_N or (there and contact.touching):
            self._found = True
            self.learn(now)
        elif there:
            text = f"no tissue felt down to {min(self._deepest, TOUCH.blind_m) * 1e3:.0f} mm below where it is believed to be"
            self.failed = Cause(Reason.NO_TISSUE, text)
        return self._found

    def learn(self, now: StrokeInput) -> None:
        """Correct the wall by the touch."""
        self.touched, outward = self._motion.wall.touch(now.contact.foot, self._onset.touch(), self.stroke, now.t)
        self._motion.shift(outward)

    def revise(self) -> None:
        """Refit the touch once the wall's motion in it was measured, before the indenter is at its depth."""
        if self._found and not self._revised:
            outward = self._motion.wall.revise(self._onset)
            if outward is not None:
                self._motion.shift(outward)
                self._revised = True
