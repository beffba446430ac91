"""How strokes recover: after a soft stop, after a hold, and when the arm was pushed aside meanwhile."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from palpate_bus.setpoint import Setpoint
from palpate_models.numerics.frames import Array
from palpate_models.scenario.schema import Exam, Limits
from palpate_planning.contact import ContactMeasurement
from palpate_planning.motion.timing import JerkLimitedAxis
from palpate_planning.strokes.coverage import Bools
from palpate_planning.strokes.path import PathPoint, centre
from palpate_planning.strokes.segments import Segment

SOFT_STOPS_MAX = 3
"""With this many soft stops the examination is given up."""
REPEATS_MAX = 3
"""So often a stroke is taken up again after it was spoiled at one place; then the rest of it is passed over."""
NEAR_M = 0.010
"""Less far from each other, two places of a stroke are one."""
MOVED_M = 0.02
"""An arm that was pushed further aside than this while it was held does not go on where it was."""
CLEAR_M = 0.003
"""This far above the surface nothing is touched: an arm that was pushed aside may go back sideways."""
UNMOVED_M = 1e-6
"""An arm that is nearer to its path than this has not been pushed."""
RETURN_MPS = 0.15
RETURN_ACCELERATION = 0.8
"""[m/s^2]"""


class Displacement:
    """How far an arm that was pushed is off its path, and its way back."""

    def __init__(self, gap: Array, period_s: float) -> None:
        """`gap` [m], world axes, shape (3,): the arm's centre less the one that the path asks for; not zero."""
        length = float(np.linalg.norm(gap))
        self._direction = gap / length
        self._length = JerkLimitedAxis(length, RETURN_ACCELERATION, 10 * RETURN_ACCELERATION, period_s)

    def move(self, setpoint: Setpoint) -> Setpoint:
        """The set-point, displaced by what is left of the gap."""
        V_WD = setpoint.V_WD.copy()
        V_WD[:3] += self._direction * self._length.velocity
        return replace(setpoint, p_WD=setpoint.p_WD + self._direction * self._length.position, V_WD=V_WD)

    def shrink(self) -> bool:
        """Makes one period of the way back; returns whether it is at its end."""
        return self._length.step(0.0, RETURN_MPS)

    def stay(self) -> None:
        """Stays as it is."""
        self._length.stand()


class Recovery:
    """What has interrupted the strokes, and how they go on: from where, without which targets, or not at all."""

    def __init__(self, exam: Exam, limits: Limits, period_s: float) -> None:
        self._exam, self._limits, self._period_s = exam, limits, period_s
        self._soft_stops = 0
        self._spoiled_at, self._repeats = 0.0, 0
        self.paused = False
        """Whether the arm waits above the surface."""
        self.resume_at: float | None = None
        """Path length [m] at which the stroke is taken up again once the arm has lifted; None: it goes on to the next segment."""
        self.displacement: Displacement | None = None
        self.skipped: dict[int, str] = {}
        """Targets that are passed over, with the reason."""
        self.failed = ""
        """Why the strokes are given up; empty if they are not."""

    def give_up(self, why: str) -> None:
        """Ends the strokes: the arm lifts off and stays up."""
        self.failed = self.failed or why
        self.paused = False

    def soft_stop(self, force: float, segment: Segment, s: float) -> None:
        """Passes over the targets near path length s; with the last of `SOFT_STOPS_MAX` stops it gives up."""
        path = segment.path
        self._soft_stops += 1
        why = f"soft stop at {force:.1f} N, limit {self._limits.force_soft_stop_n:g} N"
        passed = (path.visits > s - 1e-6) & (path.visits < s + self._exam.spacing_m)
        self._pass_over(segment, passed, why)
        ahead = path.visits[path.visits >= s + self._exam.spacing_m]
        self.resume_at = float(ahead[0]) if len(ahead) else None
        if self._soft_stops >= SOFT_STOPS_MAX:
            self.failed = f"{why}, {self._soft_stops} times"

    def repeat(self, segment: Segment, s: float, back: float, why: str) -> None:
        """Takes the stroke up again `back` [m] before path length s, where it was spoiled; or passes over its rest, for `why`."""
        again = self._repeats > 0 and s < self._spoiled_at + NEAR_M
        self._spoiled_at, self._repeats = s, self._repeats + 1 if again else 1
        self.resume_at = max(s - back, 0.0)
        if self._repeats > REPEATS_MAX:
            self._pass_over(segment, segment.path.visits > s - 1e-6, why)
            self.resume_at, self._repeats = None, 0

    def _pass_over(self, segment: Segment, visits: Bools, why: str) -> None:
        """A target where the skin is only touched is pressed later all the same."""
        if not segment.touch:
            self.skipped |= dict.fromkeys((int(i) for i in segment.path.targets[visits]), why)

    def measure_displacement(self, contact: ContactMeasurement, point: PathPoint, radius: float) -> float:
        """How far [m] the arm stands beside its path point, across the normal; the way back starts from there.

        `radius` [m]: distance of the sphere's centre from the perceived surface at zero depth.
        """
        p_WI = contact.X_WI[:3, 3]
        gap = p_WI - centre(point.p, point.n, radius, contact.depth)
        self.displacement = Displacement(gap, self._period_s) if float(np.linalg.norm(gap)) > UNMOVED_M else None
        gap = p_WI - point.p
        return float(np.linalg.norm(gap - (gap @ point.n) * point.n))

    def return_to_path(self, contact: ContactMeasurement) -> None:
        """One period of the way back to the path: only clear of the skin, and not while waiting or giving up."""
        if self.displacement is None:
            return
        if self.failed or self.paused or contact.depth > -CLEAR_M:
            self.displacement.stay()
        elif self.displacement.shrink():
            self.displacement = None
