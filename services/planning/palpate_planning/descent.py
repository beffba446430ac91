"""The descent of a stroke: a rest above the skin in which the sensor is tared, then slowly down to the touch that zeroes depth.

It comes down fast to as near as the wall can be, and from there at probe speed until force sets in; the touch corrects the wall,
and depth is counted from there on.
"""

from __future__ import annotations

from palpate_planning.contact import ContactMeasurement
from palpate_planning.stroke_motion import DEPTH_ACCELERATION, StrokeMotion
from palpate_planning.wall.touch import FELT_N, Onset
from palpate_planning.wall.wall import TouchedSkin

DESCEND_MPS = 0.08
PROBE_MPS = 0.014
"""Speed at which the skin is sought: force rises by about 3 N/s."""
SIGMAS = 3.0
"""Within so many standard deviations of where the skin is believed to be it is sought,"""
ALLOWANCE_M = 0.003
"""from this above: the onset is fitted to force before it, too."""
REST_S = 0.15
"""Time at rest before taring: the arm's oscillations fade."""
TARE_S = 0.25
"""Time of taring: 25 means over 10 ms of 0.1 N noise leave 6 mN."""


class Descent:
    """Takes one stroke after another down to the skin; `start` before each."""

    def __init__(self, motion: StrokeMotion, depth: float, period_s: float, before: int = 0) -> None:
        """`depth` [m]: so far below the skin, at least, force is felt. There were `before` descents before."""
        self._motion, self._depth, self._period_s = motion, depth, period_s
        self.stroke = before
        """Number of the descent under way or last made, from 1 on."""
        self.taring = False
        """Whether the arm is at rest in free air, so that what the sensor reads is bias and weight."""
        self.touched: TouchedSkin | None = None
        """The touch of the latest step, at which there was one."""
        self.missed = ""
        """Why no skin was felt; empty if it was, or may be yet."""
        self.start()

    def start(self) -> None:
        """Before a descent: at rest, soon, above the skin."""
        self._rested = self._deepest = 0.0
        self._onset = Onset()
        self.pushed = False
        """Whether a force was felt higher than the skin can be: something else pushes the tool, or the wall has leapt."""
        self._felt = self._sure = False
        """Whether the skin has been touched, and whether where is known as surely as it will be."""

    def rest(self, height: float, speed: float) -> bool:
        """Rests `height` [m] above the skin, getting there at `speed` [m/s]; returns whether it has rested and tared."""
        self._rested = self._rested + self._period_s if self._motion.depth.step(-height, speed) else 0.0
        self.taring = self._rested >= REST_S
        if self._rested < REST_S + TARE_S:
            return False
        self.taring = False
        self.stroke += 1
        return True

    def probe(self, contact: ContactMeasurement, t: int) -> bool:
        """Sinks towards the skin at `t` [ns]; returns whether it has been touched, at this step or before."""
        if self._felt:
            return True
        motion = self._motion
        unsure = SIGMAS * contact.wall.sigma
        braking = motion.depth.velocity**2 / DEPTH_ACCELERATION
        near = motion.depth.position > -unsure - ALLOWANCE_M - braking
        self._deepest = max(self._deepest, unsure + self._depth)  # one that falls and rises with what is known is never reached
        there = motion.depth.step(self._deepest, PROBE_MPS if near else DESCEND_MPS)
        if near:
            self._onset.add(contact.depth, contact.force, t, contact.wall.displacement)
        if contact.force >= FELT_N and not near:
            self.pushed = True
        elif contact.force >= FELT_N or (there and contact.touching):
            self.touched, outward = motion.wall.touched(contact.foot, self._onset.touch(), self.stroke, t)
            motion.shift(outward)
            self._felt = True
        elif there:
            self.missed = f"no tissue felt down to {self._deepest * 1e3:.0f} mm below where it is believed to be"
        return self._felt

    def make_sure(self) -> None:
        """Finds the touch anew as soon as perception has seen how the wall moved in it: before the indenter is at its depth."""
        if self._sure or not self._felt:
            return
        outward = self._motion.wall.revise(self._onset)
        if outward is not None:
            self._motion.shift(outward)
            self._sure = True
