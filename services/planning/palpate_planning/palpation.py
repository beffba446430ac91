"""Carrying out the planned strokes: descend, indent, slide or hold at depth, lift, move over to the next."""

from __future__ import annotations

from enum import Enum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_models.scenario import Exam, Limits
from palpate_planning.depth import LIMITED_M, DepthRegulator, Regulation
from palpate_planning.legs import HOVER_M, Leg
from palpate_planning.measure import Contact
from palpate_planning.onset import OnsetEstimator
from palpate_planning.poses import centre
from palpate_planning.setpoint import NORMAL_STIFFNESS, ControlMode, Setpoint
from palpate_planning.timing import PERIOD_S, Axis

Array = NDArray[np.float64]

SLOW_M = 0.003
"""Nearer to the surface than this the indenter descends slowly: more than the surface can be wrong after the first touch."""
HOP_M = 0.008
"""Height of short ways between strokes ..."""
HOP_LENGTH_M = 0.05
"""... shorter than this; on longer ones and on free motions it is `HOVER_M`."""
DESCEND_MPS = 0.08
PLUNGE_MPS = 0.015
PROBE_MPS = 0.008
"""The first descent, in which the onset of force is sought, from `PROBE_M` above the surface on."""
PROBE_M = 0.008
LIFT_MPS = 0.12
TRANSFER_MPS = 0.15
DEPTH_ACCELERATION = 0.5
"""[m/s^2]"""
SETTLED_M = 0.0005
"""Depth error at which an indentation counts as settled ..."""
SETTLED_S = 0.08
"""... for so long,"""
SETTLE_MAX_S = 0.8
"""or after this anyhow: it will say so by its measured depth."""
HOLD_S = 0.3
"""Time at a point in which samples are taken."""
STEADY_FRACTION = 0.5
"""Samples count from this part of the path's speed on."""
CREEP = 0.1
"""Below this part of its speed the descent counts as stopped by force."""
SOFT_STOPS_MAX = 3
MOVED_M = 0.02
"""An arm that was pushed further aside than this while it was held does not go on where it was."""
CLEAR_M = 0.003
"""So far above the surface nothing is touched: an arm that was pushed aside may go back sideways."""
UNMOVED_M = 1e-6
"""Less is no offset."""


class Doing(Enum):
    """Part of a stroke."""

    DESCEND = "descending"
    SETTLE = "settling at depth"
    SLIDE = "sliding at depth"
    HOLD = "holding at depth"
    LIFT = "lifting"
    TRANSFER = "moving to the next stroke"
    DONE = "done"


PRESSING: Final = (Doing.SLIDE, Doing.HOLD, Doing.SETTLE, Doing.DESCEND)
"""Parts of a stroke in which the tissue is pressed, or is about to be."""
AT_DEPTH: Final = (Doing.SLIDE, Doing.HOLD, Doing.SETTLE)


class Progress(NamedTuple):
    """What a step of the palpation did."""

    setpoint: Setpoint
    doing: Doing
    depth_setpoint: float
    """[m]"""
    steady: bool
    limited: bool
    target: int
    """Index of the latest target reached."""


class Aside:
    """Where an arm that was pushed is against its path, and its way back."""

    def __init__(self, gap: Array) -> None:
        """`gap` [m], world axes, shape (3,): the arm's centre less the one that the path asks for; not zero."""
        length = float(np.linalg.norm(gap))
        self._direction = gap / length
        self._length = Axis(length, 0.8, 8.0)

    @property
    def offset(self) -> Array:
        """What is left of the gap [m], shape (3,)."""
        return self._direction * self._length.position

    @property
    def velocity(self) -> Array:
        """Its rate [m/s], shape (3,)."""
        return self._direction * self._length.velocity

    def fade(self) -> bool:
        """One period of the way back; returns whether it is made."""
        return self._length.step(0.0, TRANSFER_MPS)

    def stand(self) -> None:
        """Stays where it is."""
        self._length.stand()


class Palpation:
    """Executes the legs of a plan; one `step` each planning period until `doing` is DONE.

    Targets that a soft stop passes over are in `skipped`; `failed` says why it gave up, if it did.
    """

    def __init__(self, legs: tuple[Leg, ...], exam: Exam, limits: Limits, radius: float, surface_noise: float = 0.0) -> None:
        """`surface_noise`: standard deviation of the perceived surface [m]."""
        self._legs, self._exam, self._limits, self._radius = legs, exam, limits, radius
        self._regulator = DepthRegulator(PERIOD_S, NORMAL_STIFFNESS, limits.force_working_n, limits.depth_m)
        self._regulator.reset(-HOVER_M)
        self._depth = Axis(-HOVER_M, DEPTH_ACCELERATION, DEPTH_ACCELERATION / 0.05)
        self._regulation = Regulation(-HOVER_M, 0.0, -HOVER_M, 0.0, False, 0.0)
        self._onset = OnsetEstimator(surface_noise)
        self.offset = 0.0
        """Outward shift of the perceived surface that the onset of force asks for [m]."""
        self._soft_stops = 0
        self._resume: float | None = None
        self._paused = False
        self._aside: Aside | None = None
        self.skipped: dict[int, str] = {}
        self.failed = ""
        self._k = -1
        self._rate = 1.0
        self._next_leg()

    # --- the sequence -------------------------------------------------------------------------------------------------

    def _next_leg(self) -> None:
        self._k += 1
        if self._k == len(self._legs):
            self._k -= 1
            self._enter(Doing.DONE)
            return
        leg = self._leg = self._legs[self._k]
        speed = self._exam.speed_mps if leg.contact else TRANSFER_MPS
        self._limit = leg.path.speed_limit(speed, self._limits)
        self._free_step = 0.0
        self._s = Axis(0.0, 0.2 if leg.contact else 0.8, 2.0 if leg.contact else 8.0)
        self._enter(Doing.DESCEND if leg.contact else Doing.TRANSFER)

    def _enter(self, doing: Doing) -> None:
        self.doing = doing
        self._time = 0.0
        self._settled = 0.0

    @property
    def _target(self) -> int:
        return self._leg.path.target(self._s.position + 1e-6)

    @property
    def _height(self) -> float:
        """How high to lift: low before a short way, or to hop on within the stroke."""
        if self.failed or self._k == len(self._legs) - 1:
            return HOVER_M
        way = self._legs[self._k + 1]
        return HOP_M if self._resume is not None or (way.free is None and way.path.length < HOP_LENGTH_M) else HOVER_M

    def abandon(self, why: str) -> None:
        """Lifts off and ends."""
        self.failed = self.failed or why
        self._paused = False
        if self.doing not in (Doing.LIFT, Doing.DONE):
            self._enter(Doing.LIFT)

    @property
    def free_goal(self) -> Array | None:
        """Where the free motion under way ends [rad], shape (7,); None on a path."""
        free = self._leg.free
        return None if free is None or self.failed or self.doing is Doing.DONE else np.asarray(free.q[-1])

    def arrive(self) -> None:
        """The free motion under way has been made by others: the arm is where it ends."""
        self._next_leg()

    def pause(self) -> None:
        """Lifts off along the normal and waits there; `resume` comes back to where it was."""
        self._paused = True
        if self.doing in PRESSING:
            braking = self._s.velocity**2 / 0.3
            self._resume = min(self._s.position + braking, self._leg.path.length)
            self._enter(Doing.LIFT)

    def resume(self, contact: Contact) -> None:
        """Goes on after a pause, from where the arm is now: while the driver held, the tissue has pushed it.

        Sideways too: what is on the path may be deep in the tissue, and the arm is not to be drawn through it.
        """
        self._paused = False
        path = self._leg.path
        if self._leg.free is None:
            place = path.at(self._s.position)
            gap = contact.X_WI[:3, 3] - place.p
            aside = float(np.linalg.norm(gap - (gap @ place.n) * place.n))
            if aside > MOVED_M:
                self.abandon(f"the arm was moved {aside * 1e3:.0f} mm aside while it was held")
            self._depth = Axis(contact.depth, DEPTH_ACCELERATION, DEPTH_ACCELERATION / 0.05)
            self._s = Axis(self._s.position, 0.2 if self._leg.contact else 0.8, 8.0)
            self._regulator.reset(contact.depth)
            gap = contact.X_WI[:3, 3] - centre(place.p, place.n, self._radius + self.offset, contact.depth)
            self._aside = Aside(gap) if float(np.linalg.norm(gap)) > UNMOVED_M else None

    def step(self, contact: Contact, rate: float = 1.0) -> Progress:
        """One planning period on, given the measured contact; free motions go on by `rate` samples, see `Pace`."""
        self._time += PERIOD_S
        self._rate = rate
        if self._aside is not None:
            self._come_back(self._aside, contact)
        if contact.force > self._limits.force_soft_stop_n and self.doing in PRESSING:
            self._soft_stop(contact.force)
        if self.doing is Doing.SLIDE:
            self._slide()
        elif self.doing is Doing.LIFT:
            self._lift()
        elif self.doing is Doing.TRANSFER:
            self._transfer()
        elif self.doing is Doing.DESCEND:
            self._descend(contact)
        elif self.doing is Doing.SETTLE:
            self._settle(contact)
        elif self.doing is Doing.HOLD and self._time >= HOLD_S:
            self._enter(Doing.LIFT)
        lifting = self.doing is Doing.LIFT
        self._regulation = self._regulator.update(
            self._depth.position, contact.depth, contact.force, contact.touching and not lifting
        )
        return self._progress(contact)

    def _come_back(self, aside: Aside, contact: Contact) -> None:
        """An arm that was pushed aside goes back over its path when it is clear of the skin, unless this is given up."""
        if self.failed or self._paused or contact.depth > -CLEAR_M:
            aside.stand()
        elif aside.fade():
            self._aside = None

    def _slow_down(self, full: float, none: float, floor: float) -> float:
        """Part of the speed that the expected force leaves: all below `full` of the limit, none at `none`, yet `floor`."""
        force = self._regulation.expected_force / self._regulator.force_max
        return min(max((none - force) / (none - full), floor), 1.0)

    def _descend(self, contact: Contact) -> None:
        if not self._onset.done:
            self._probe(contact)
            return
        near = self._depth.position > -SLOW_M - self._depth.velocity**2 / DEPTH_ACCELERATION
        there = self._deeper() if near else self._depth.step(self._exam.depth_m, DESCEND_MPS)
        self._settled = self._settled + PERIOD_S if self._slow_down(0.7, 1.0, 0.0) < CREEP else 0.0
        if there or self._settled > SETTLED_S:  # at depth, or as deep as the force allows
            self._enter(Doing.SETTLE)

    def _probe(self, contact: Contact) -> None:
        """The first descent: slow, down to where the tissue begins, wherever the camera said it would be."""
        near = self._depth.position > -PROBE_M - self._depth.velocity**2 / DEPTH_ACCELERATION
        self._onset.add(contact.depth, contact.force)
        if self._onset.done:
            self._shift(self._onset.correction())
        elif self._depth.step(self._limits.depth_m, PROBE_MPS if near else DESCEND_MPS):
            self.abandon(f"no tissue felt down to {self._limits.depth_m * 1e3:.0f} mm below the perceived surface")

    def _shift(self, onset: float) -> None:
        """Counts depth from where force set in; the commanded position stays where it is."""
        self.offset -= onset
        self._depth.shift(-onset)
        self._regulator.shift(-onset)

    def _deeper(self) -> bool:
        """Goes on to full depth, the slower the nearer the force is to its limit; returns whether it is there."""
        return self._depth.step(self._exam.depth_m, PLUNGE_MPS * self._slow_down(0.7, 1.0, 0.01))

    def _settle(self, contact: Contact) -> None:
        self._deeper()
        near = abs(self._regulation.reference - contact.depth) < SETTLED_M
        self._settled = self._settled + PERIOD_S if near else 0.0
        if self._settled >= SETTLED_S or self._time >= SETTLE_MAX_S:
            self._enter(Doing.SLIDE if self._leg.path.length > 0 else Doing.HOLD)

    def _slide(self) -> None:
        self._deeper()
        path = self._leg.path
        allowed = self._limit.at(self._s.position + self._s.velocity * PERIOD_S)
        if self._s.step(path.length, max(allowed * self._slow_down(1.0, 1.1, 0.3), 1e-3)):
            self._enter(Doing.LIFT)

    def _lift(self) -> None:
        if self._s.velocity > 1e-4:
            self._s.step(self._s.position + self._s.velocity**2 / 0.3, max(self._s.velocity, 1e-3))
        if not self._depth.step(-self._height, LIFT_MPS) or self._paused:
            return
        if self.failed:
            self._enter(Doing.DONE)
        elif self._aside is not None:
            return
        elif self._resume is not None:
            self._enter(Doing.TRANSFER)
        else:
            self._next_leg()

    def _transfer(self) -> None:
        if self._paused:
            self._s.step(self._s.position + self._s.velocity**2 / 1.2, max(self._s.velocity, 1e-3))
            return
        free = self._leg.free
        if free is not None:
            self._free_step = min(self._free_step + self._rate, len(free) - 1.0)
            if self._free_step >= len(free) - 1:
                self._next_leg()
            return
        if self._aside is not None:
            self._depth.step(min(-HOP_M, self._depth.position), LIFT_MPS)
            return
        path = self._leg.path
        goal = path.length if self._resume is None else self._resume
        if not self._s.step(goal, max(self._limit.at(self._s.position), 1e-3)):
            return
        if self._resume is None:
            self._next_leg()
        else:
            self._resume = None
            self._enter(Doing.DESCEND)

    def _soft_stop(self, force: float) -> None:
        """Retreats along the normal and passes over the targets nearby; the third time it gives up."""
        path = self._leg.path
        self._soft_stops += 1
        why = f"soft stop at {force:.1f} N, limit {self._limits.force_soft_stop_n:g} N"
        here = self._s.position
        passed = (path.visits > here - 1e-6) & (path.visits < here + self._exam.spacing_m)
        self.skipped |= dict.fromkeys((int(i) for i in path.targets[passed]), why)
        ahead = path.visits[path.visits >= here + self._exam.spacing_m]
        self._resume = float(ahead[0]) if len(ahead) else None
        if self._soft_stops >= SOFT_STOPS_MAX:
            self.failed = f"{why}, {self._soft_stops} times"
        self._enter(Doing.LIFT)

    # --- set-points ---------------------------------------------------------------------------------------------------

    def _progress(self, contact: Contact) -> Progress:
        leg, regulation = self._leg, self._regulation
        if leg.free is not None:
            q, qd = leg.free.at(self._free_step)
            setpoint = Setpoint(ControlMode.JOINT, contact.X_WI, q, qd=self._rate * qd)
            return Progress(setpoint, self.doing, -HOVER_M, False, False, int(leg.path.targets[-1]))
        rate = self._s.velocity
        arm = self._radius + self.offset - regulation.depth
        setpoint = leg.path.setpoint(self._s.position, rate, arm, regulation.rate, regulation.force)
        if self._aside is not None:
            setpoint.X_WI[:3, 3] += self._aside.offset
            setpoint.V_WI[:3] += self._aside.velocity
        deep_enough = self._depth.position >= self._exam.depth_m - LIMITED_M
        limited = regulation.limited or (not deep_enough and self.doing in AT_DEPTH)
        fast = rate >= STEADY_FRACTION * self._exam.speed_mps or limited
        steady = contact.touching and (self.doing is Doing.HOLD or (self.doing is Doing.SLIDE and fast))
        return Progress(setpoint, self.doing, regulation.reference, steady, limited, self._target)
