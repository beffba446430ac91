"""Single presses on a simulated patient, with the errors and durations of whole examinations.

`PatientHand` presses the true tissue as the quick tier does. `SurrogateHand` scales the apparent stiffness of the standard press
(`palpate.quick.felt`): no physics, a hundredth of the time. Places are in the registered abdomen frame.
"""

from dataclasses import replace
from typing import Final, NamedTuple, Protocol

import numpy as np

from palpate.quick.errors import Loop, loop_errors
from palpate.quick.examination import QuickExamination
from palpate.quick.felt import FeltPatient, between
from palpate_models.numerics.frames import Array, apply, inverse
from palpate_models.numerics.seeds import generator
from palpate_models.patient.breathing import BreathingCurve
from palpate_models.scenario.errors import draw_errors
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import Scenario
from palpate_planning.stroke import STROKE
from palpate_search.presses import Press, Task, press_duration


class SurrogateTuning(NamedTuple):
    """Noise and least depth of the surrogate's presses."""

    tare_n: float = 0.05
    """SD of the force after taring."""
    noise_n: float = 0.02
    """SD of the mean force of a press."""
    shallowest_m: float = 0.002


SURROGATE: Final = SurrogateTuning()
_EXPONENT: Final = (1.35, 0.1)
"""Mean and SD over persons of the surrogate's exponent of force over depth."""


class Hand(Protocol):
    """Presses one patient."""

    task: Task
    spent: float
    """Time since the search began [s]."""

    def press(self, xy: Array, depth: float) -> Press:
        """Press at a place [m], shape (2,), to `depth` [m]; return the measurement. Raises ValueError outside the region."""


class _BaseHand:
    """Task, and errors of the examination, common to both hands."""

    def __init__(self, scenario: Scenario) -> None:
        self._errors = loop_errors(scenario)
        self.task = replace(Task.of(exam_input(scenario)), depth_uncertainty=self._errors.uncertainty_m)
        self._loop = Loop(scenario, self._errors)
        self.spent = 0.0

    def _check(self, xy: Array, depth: float) -> None:
        if not np.all((xy >= self.task.low - 1e-9) & (xy <= self.task.high + 1e-9)):
            raise ValueError(f"place = {xy.tolist()} m: expected {self.task.low.tolist()} to {self.task.high.tolist()} m")
        if not 0 < depth <= self.task.deepest + 1e-9:
            raise ValueError(f"depth = {depth} m: expected more than 0 and at most {self.task.deepest} m")


class PatientHand(_BaseHand):
    """Presses the true tissue."""

    def __init__(self, scenario: Scenario) -> None:
        """Raises what `Patient` does, and UnknownLoopError without fitted errors."""
        super().__init__(scenario)
        self._examination = QuickExamination(scenario, self._loop)

    def press(self, xy: Array, depth: float) -> Press:
        """Press; see `Hand.press`. A press that feels no tissue measures the force at its deepest point."""
        self._check(xy, depth)
        rows = self._examination.press(xy, depth)
        self.spent = rows[-1].time - self._loop.begin_s
        held = [row for row in rows if row.steady] or [max(rows, key=lambda row: row.depth)]
        depths, forces = np.array([(row.depth, row.force) for row in held]).T
        noise, limited = float(np.std(forces) / np.sqrt(len(held))), any(row.limited for row in held)
        depth, force = float(depths.mean()), float(forces.mean())
        return Press(float(xy[0]), float(xy[1]), depth, force, held[-1].time, noise, limited, self.task.depth_uncertainty)


class SurrogateHand(_BaseHand):
    """Scales the standard press's apparent stiffness; without relaxation, friction or memory of earlier presses."""

    def __init__(self, scenario: Scenario, felt: FeltPatient) -> None:
        """`felt`: apparent stiffness of the patient."""
        super().__init__(scenario)
        self.felt = felt
        self._X_AtA = inverse(draw_errors(scenario.errors, scenario.seed).X_AAt)
        self._here: Array | None = None
        self._strokes = 0
        self._breathing = BreathingCurve(scenario.phantom.breathing, scenario.seed)
        self._rng = generator(scenario.seed, "surrogate")
        self._exponent = float(self._rng.normal(*_EXPONENT))

    def press(self, xy: Array, depth: float) -> Press:
        """Press; see `Hand.press`."""
        self._check(xy, depth)
        loop, rng = self._loop, self._rng
        self.spent += float(press_duration(self._here, xy))
        self._here, self._strokes = xy, self._strokes + 1
        time = loop.begin_s + self.spent
        place = self.touched(xy)[None]
        stiff, share = (float(between(grid, place)[0]) for grid in (self.felt.force, self.felt.breathing))
        excursion = np.mean([self._breathing.excursion(time - part * STROKE.hold_s) for part in (0.0, 0.5, 1.0)])
        unseen = (1.0 - loop.followed) * share * (float(excursion) - self._breathing.mean_m)
        wander = self._errors.wander_m * float(rng.standard_normal())
        wrong = float(loop.wrong(xy[None])[0]) + loop.zero(self._strokes) + wander - unseen

        def felt(measured: float) -> float:
            return float(stiff * (max(measured - wrong, 0.0) / 0.010) ** self._exponent)

        limited = felt(depth) > self.task.force
        if limited:
            depths = np.linspace(0.0, depth, 50)
            depth = float(np.interp(self.task.force, [felt(d) for d in depths.tolist()], depths))
        force = max(felt(depth) + float(rng.normal(0.0, SURROGATE.tare_n) + rng.normal(0.0, SURROGATE.noise_n)), 0.02)
        x, y, measured = float(xy[0]), float(xy[1]), max(depth, SURROGATE.shallowest_m)
        return Press(x, y, measured, force, time, SURROGATE.noise_n, limited, self.task.depth_uncertainty)

    def touched(self, xy: Array) -> Array:
        """Return where in the true abdomen frame the tool is at a place [m], both of shape (2,)."""
        return apply(self._X_AtA, self.felt.skin_at(xy + self._loop.aside_m))[:2]
