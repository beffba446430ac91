"""Interruptions of the strokes: a wall that cannot be tracked, too much force, a pause; and how the strokes continue."""

from collections import deque
from collections.abc import Iterable
from typing import Final, NamedTuple

import numpy as np
import pinocchio as pin

from palpate_bus.messages.codes import Reason
from palpate_bus.setpoint import Setpoint
from palpate_models.numerics.frames import Array, Mask
from palpate_models.scenario.schema import Exam, Following, Limits
from palpate_planning.contact import ContactMeasurement
from palpate_planning.motion.planner import JerkLimitedAxis
from palpate_planning.reasons import MOVED, NO_CAUSE, Cause, Tally
from palpate_planning.stroke import Duration
from palpate_planning.stroke_motion import MOTION
from palpate_planning.strokes.path import PathPoint, centre
from palpate_planning.strokes.plan import Segment
from palpate_planning.wall.wall import Breath


class WallTuning(NamedTuple):
    """Times and limits for a wall that cannot be tracked or touched."""

    calm_s: float = 1.0
    """After a cough or a deep breath the wall is left alone until it has been tracked for this time."""
    hidden_timeout_s: float = 5.0
    """The arm leaves if it hides the wall for this time; a deep breath or a cough, which also hides it, is shorter."""
    contact_lost_s: float = 0.3
    """Maximum time without contact at depth; then the wall is touched again."""
    contact_losses_max: int = 5
    gate_closed_max_s: float = 15.0
    """Maximum time without an end of expiration with gated breathing; then the arm lifts."""
    gate_m: float = 0.001
    """Maximum displacement of a counted sample from the end of expiration with gated breathing, where the wall moves most."""


class RecoveryTuning(NamedTuple):
    """Limits for strokes that are taken up again."""

    soft_stops_max: int = 3
    repeats_max: int = 3
    """A stroke that is interrupted at one place more often is skipped from there on."""
    blind_places_max: int = 2
    """After no tissue was felt at this many places in a row, the surface or the force sensor is wrong."""
    one_place_m: float = 0.010
    """Two interruptions of a stroke that are closer than this are at one place."""
    displaced_max_m: float = 0.02
    """An arm that was pushed aside further while it was held does not continue."""
    tilted_max_rad: float = 0.3
    """An arm whose tool was tilted further while it was held does not continue."""
    lever_m: float = 0.1
    """A turn by an angle takes as long as a motion by this lever times the angle."""
    clear_height_m: float = 0.003
    """Above this height an arm that was pushed aside may move laterally."""
    on_path_m: float = 1e-6


class SurgeTuning(NamedTuple):
    """A force that rises faster than any motion of the arm can cause: the patient coughs or tenses."""

    over: int = 3
    """Periods over which the rate is measured."""
    min_nps: float = 60.0
    """Twice the rate in the fastest descent into a stiff wall."""
    ahead_s: float = 0.1
    """The arm retreats if the force would pass its working limit within this time: a cough lifts the wall for as long."""


WALL: Final = WallTuning()
SURGE: Final = SurgeTuning()
RECOVERY: Final = RecoveryTuning()


class ForceWatch:
    """Foresees the force; one `step` each planning period."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._loads: deque[float] = deque(maxlen=SURGE.over + 1)

    def step(self, load: float) -> float:
        """Return the force [N] in `SURGE.ahead_s` if it rises suddenly, else the present one."""
        self._loads.append(load)
        rate = (load - self._loads[0]) / (SURGE.over * self._period_s)
        return load + rate * SURGE.ahead_s if rate > SURGE.min_nps else load


class WallWatch:
    """Checks that the wall is tracked and touched; one `step` each planning period."""

    def __init__(self, breath: Breath, following: Following, period_s: float, tally: Tally) -> None:
        self._breath, self._gated, self._tally = breath, following is Following.GATE, tally
        self._tracked = Duration(period_s, WALL.calm_s)
        self._contact_lost, self._occluded, self._gate_closed = Duration(period_s), Duration(period_s), Duration(period_s)
        self.spoiled = False
        """True if present samples are invalid: the indenter has to lift off."""
        self.leaps = False
        """True if the wall moves against its forecast."""
        self.open = True
        """True if samples may be taken at this moment of the breath."""
        self.moved = False
        """True if the patient has moved."""
        self.ended = NO_CAUSE
        """Cause that ends the strokes, if any."""

    @property
    def calm(self) -> bool:
        """True if the wall has been tracked for long enough to be touched."""
        return self._tracked.s >= WALL.calm_s

    @property
    def hidden(self) -> bool:
        """True if the arm has hidden the wall for too long to wait there."""
        return self._occluded.s > WALL.hidden_timeout_s

    def step(self, t: int, *, contact_lost: bool, on_free_motion: bool = False) -> None:
        """Check the moment `t` [ns]; `contact_lost`: at depth without contact."""
        breath = self._breath
        self.open = not self._gated or abs(breath.displacement(t)) < WALL.gate_m
        tracked = breath.calm(t)
        calm = self._gate_closed.update(not self.open) <= WALL.gate_closed_max_s and tracked
        self._tracked.update(calm)
        self._occluded.update(breath.hidden and not tracked and not on_free_motion)
        lost = self._contact_lost.update(contact_lost) > WALL.contact_lost_s
        if lost:
            self._tally.contact_losses += 1
            self._contact_lost.update(False)
        self.spoiled = lost or not calm
        self.leaps = not (tracked or breath.hidden)
        self.moved = self.moved or breath.moved
        if self.moved:
            self.ended = MOVED
        elif (losses := self._tally.contact_losses) >= WALL.contact_losses_max:
            self.ended = Cause(Reason.CONTACT_LOST, f"contact was lost {losses} times")


class Displacement:
    """Gap between an arm that was pushed aside or tilted and its path, while the arm returns."""

    def __init__(self, gap: Array, period_s: float) -> None:
        """`gap`, shape (6,), not zero: measured less planned centre of the sphere, world axes [m]; `lever_m` times the rotation
        vector of the tool, axes of the path point [m].
        """
        length = float(np.linalg.norm(gap))
        self._direction = gap / length
        acceleration = MOTION.transfer_acceleration_mps2
        self._length = JerkLimitedAxis(length, acceleration, 10 * acceleration, period_s)

    def move(self, setpoint: Setpoint) -> Setpoint:
        """Return the set-point, displaced by the remaining gap."""
        toward, turn, V_WD = self._direction[:3], self._direction[3:] / RECOVERY.lever_m, setpoint.V_WD.copy()
        V_WD[:3] += toward * self._length.velocity
        V_WD[3:] += setpoint.R_WD @ turn * self._length.velocity
        R_WD, p_WD = setpoint.R_WD @ pin.exp3(turn * self._length.position), setpoint.p_WD + toward * self._length.position
        return setpoint._replace(R_WD=R_WD, p_WD=p_WD, V_WD=V_WD)

    def shrink(self, speed: float) -> bool:
        """Return to the path for one period with at most `speed` [m/s]; True once there."""
        return self._length.step(0.0, speed)

    def stay(self) -> None:
        """Stop the return."""
        self._length.stand()


class Recovery:
    """State of interrupted strokes: where they continue, which targets are skipped, or the cause that ends them."""

    def __init__(self, exam: Exam, limits: Limits, period_s: float, tally: Tally) -> None:
        self._exam, self._limits, self._period_s = exam, limits, period_s
        self.tally = tally
        self._spoiled: tuple[Segment | None, float] = None, 0.0
        """Stroke that was interrupted last, and the path length there [m]."""
        self._repeats = 0
        self.paused = False
        """True if the arm has to wait above the wall."""
        self.resume_at: float | None = None
        """Path length [m] at which the stroke is taken up again after the lift; None: the next segment follows."""
        self.displacement: Displacement | None = None
        self.skipped: dict[int, Cause] = {}
        """Cause by target."""
        self.failed = NO_CAUSE
        """Cause of abandoned strokes."""
        self.early_end = NO_CAUSE
        """Cause of an early end without failure."""

    @property
    def ending(self) -> bool:
        """True if the arm lifts and the strokes end."""
        return bool(self.failed or self.early_end)

    def give_up(self, cause: Cause) -> None:
        """Abandon the strokes."""
        self.failed = self.failed or cause
        self.paused = False

    def soft_stop(self, force: float, segment: Segment, s: float) -> None:
        """Skip the targets near path length s; abandon the strokes at the last allowed soft stop."""
        path = segment.path
        self.tally.soft_stops += 1
        cause = Cause(Reason.FORCE, f"soft stop at {force:.1f} N, limit {self._limits.force_soft_stop_n:g} N")
        self._skip(segment, (path.visits > s - 1e-6) & (path.visits < s + self._exam.spacing_m), cause)
        ahead = path.visits[path.visits >= s + self._exam.spacing_m]
        self.resume_at = float(ahead[0]) if len(ahead) else None
        if (stops := self.tally.soft_stops) >= RECOVERY.soft_stops_max:
            self.failed = cause._replace(text=f"{cause.text}, {stops} times")

    def take_up(self, s: float, back: float) -> None:
        """Take the stroke up again `back` [m] before path length s."""
        self.resume_at = max(s - back, 0.0)

    def repeat(self, segment: Segment, s: float, back: float, cause: Cause) -> None:
        """Take the stroke up again `back` [m] before path length s; skip its rest after too many repeats at one place."""
        spoiled, spoiled_at = self._spoiled
        again = segment is spoiled and s < spoiled_at + RECOVERY.one_place_m
        self._spoiled, self._repeats = (segment, s), self._repeats + 1 if again else 1
        self.take_up(s, back)
        if self._repeats > RECOVERY.repeats_max:
            self.give_up_place(segment, s, cause)

    def give_up_place(self, segment: Segment, s: float, cause: Cause) -> None:
        """Skip a stroke from path length s on."""
        self._skip(segment, segment.path.visits > s - 1e-6, cause)
        self.resume_at = None

    def _skip(self, segment: Segment, visits: Mask, cause: Cause) -> None:
        """Skip targets, unless the wall is only touched there: they are pressed later."""
        if not segment.touch:
            self.skipped |= dict.fromkeys((int(i) for i in segment.path.targets[visits]), cause)

    def leave(self, cause: Cause, targets: Iterable[int]) -> None:
        """End the strokes early and skip the targets that are left."""
        self.early_end = cause
        self.skipped |= dict.fromkeys(targets, cause)

    def measured_length(self, position: float, *, measured: bool) -> float:
        """Return the path length up to which the present stroke has been measured [m]: to `position`, or to just before it."""
        if self.resume_at is not None:
            return self.resume_at - MOTION.end_tolerance_m
        return position - (0.0 if measured else MOTION.end_tolerance_m)

    def begin_return(self, contact: ContactMeasurement, point: PathPoint, centre_height: float) -> Cause:
        """Begin the return of the arm to its path point; return a cause if it is too far from there, laterally or by its tilt.

        `centre_height` [m]: distance of the sphere's centre from the perceived surface at zero depth.
        """
        p_WI, R_DI = contact.X_WI[:3, 3], point.R_WD.T @ contact.X_WI[:3, :3]
        away = p_WI - centre(point.p_W, point.n_W, centre_height, contact.depth)
        gap = np.concatenate((away, RECOVERY.lever_m * pin.log3(R_DI)))
        pushed = float(np.linalg.norm(gap)) > RECOVERY.on_path_m
        self.displacement = Displacement(gap, self._period_s) if pushed else None
        lateral, tilt = float(np.linalg.norm(away - (away @ point.n_W) * point.n_W)), float(np.arccos(min(R_DI[2, 2], 1.0)))
        if lateral <= RECOVERY.displaced_max_m and tilt <= RECOVERY.tilted_max_rad:
            return NO_CAUSE
        gaps = f"pushed {lateral * 1e3:.0f} mm off its path and tilted by {np.degrees(tilt):.0f} deg"
        return Cause(Reason.ARM_DISPLACED, f"the arm was {gaps} while it was held")

    def return_to_path(self, contact: ContactMeasurement) -> None:
        """Return to the path for one period: only clear of the wall, and not while the arm waits or gives up."""
        if self.displacement is None:
            return
        if self.failed or self.paused or contact.depth > -RECOVERY.clear_height_m:
            self.displacement.stay()
        elif self.displacement.shrink(min(MOTION.transfer_mps, self._limits.speed_mps)):
            self.displacement = None
