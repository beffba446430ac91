"""Single presses on a simulated patient, with the errors and durations of whole examinations.

`PatientHand` presses the true tissue in steps of 10 ms. `SurrogateHand` scales the apparent stiffness of the standard press
(`palpate.quick.felt`): no physics, a hundredth of the time. Places are in the registered abdomen frame.
"""

from dataclasses import replace
from typing import Final, NamedTuple, Protocol

import numpy as np

from palpate.quick.errors import Loop, loop_errors
from palpate.quick.felt import FeltPatient
from palpate.quick.patient import PERIOD_S, Patient
from palpate_models.numerics.frames import Array
from palpate_models.numerics.seeds import generator
from palpate_models.patient.breathing import BreathingCurve
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import Scenario
from palpate_search.presses import Press, Task, press_duration


class HandTuning(NamedTuple):
    """Presses of the hands."""

    descent_mps: float = 0.030
    hold_s: float = 0.3
    tare_n: float = 0.05
    """SD of the surrogate's force after taring."""
    noise_n: float = 0.02
    """SD of the surrogate's mean force of a press."""
    shallowest_m: float = 0.002


HAND: Final = HandTuning()
_EXPONENT: Final = (1.35, 0.1)
"""Mean and SD over persons of the surrogate's exponent of force over depth."""


class Hand(Protocol):
    """Presses one patient."""

    task: Task
    spent: float
    """Time since the search began [s]."""

    def press(self, xy: Array, depth: float) -> Press:
        """Press at a place [m], shape (2,), to `depth` [m]; return the measurement. Raises ValueError outside the region."""


class _Timed:
    """Errors of the examination and elapsed time, common to both hands."""

    def __init__(self, scenario: Scenario) -> None:
        self._errors = loop_errors(scenario)
        self._reported_sd_m = self._errors.uncertainty_m
        self.task = replace(Task.of(exam_input(scenario)), depth_uncertainty=self._reported_sd_m)
        self._loop = Loop(scenario, self._errors)
        self.spent = 0.0
        self._here: Array | None = None
        self._strokes = 0

    def _begin(self, xy: Array, depth: float) -> float:
        """Check and count a press; return its duration [s]."""
        if not np.all((xy >= self.task.low - 1e-9) & (xy <= self.task.high + 1e-9)):
            raise ValueError(f"place = {xy.tolist()} m: expected {self.task.low.tolist()} to {self.task.high.tolist()} m")
        if not 0 < depth <= self.task.deepest + 1e-9:
            raise ValueError(f"depth = {depth} m: expected more than 0 and at most {self.task.deepest} m")
        duration = float(press_duration(self._here, xy))
        self.spent += duration
        self._here, self._strokes = xy, self._strokes + 1
        return duration

    def _depth_error(self, xy: Array) -> float:
        """Return the constant depth error of the stroke [m], positive where depth is overestimated."""
        return float(self._loop.wrong(xy[None])[0]) + self._loop.zero(self._strokes)


class PatientHand(_Timed):
    """Presses the true tissue."""

    def __init__(self, scenario: Scenario) -> None:
        """Raises what `Patient` does, and UnknownLoopError without fitted errors."""
        super().__init__(scenario)
        self.patient = Patient(scenario, time=self._loop.begin_s)
        self._begin_s = self._loop.begin_s
        self._breathing = self.patient.surface.between(self.patient.tissue.model.breathing)
        self._mean = self.patient.tissue.breathing.mean_m

    def press(self, xy: Array, depth: float) -> Press:
        """Press; see `Hand.press`."""
        patient, loop = self.patient, self._loop
        idle = self._begin(xy, depth) - depth / HAND.descent_mps - HAND.hold_s
        patient.rest(max(idle, 0.0))
        loop.sensor.tare(self._period)
        places, normals = patient.surface.points((xy + loop.aside_m)[None])
        place, normal = places[0], normals[0]
        gain = loop.sensor.gains(normals)[0]
        share, wrong = float(self._breathing((xy + loop.aside_m)[None])[0]), self._depth_error(xy)
        measured, force, limited, held = 0.0, 0.0, False, 0
        depths: list[float] = []
        forces: list[float] = []
        while held < round(HAND.hold_s / PERIOD_S):
            if force >= self.task.force:
                limited = True
            at_depth = limited or measured >= depth
            held += at_depth
            measured = measured if at_depth else min(measured + HAND.descent_mps * PERIOD_S, depth)
            excursion = patient.tissue.excursion(patient.time + PERIOD_S)
            unseen = (1.0 - loop.followed) * share * (excursion - self._mean)
            true = measured - wrong - loop.wander.at(self._period) + unseen
            felt = patient.move(place + (patient.radius - true + share * excursion) * normal)
            force = float(gain @ felt) + loop.sensor.tared_reading(self._period)
            if at_depth:
                depths.append(measured)
                forces.append(force)
        patient.rest(PERIOD_S)
        noise = float(np.std(forces) / np.sqrt(len(forces)))
        depth, force = float(np.mean(depths)), float(np.mean(forces))
        return Press(float(xy[0]), float(xy[1]), depth, force, patient.time, noise, limited, self._reported_sd_m)

    @property
    def _period(self) -> int:
        return max(round((self.patient.time - self._begin_s) / PERIOD_S), 0)


class SurrogateHand(_Timed):
    """Scales the standard press's apparent stiffness; without relaxation, friction or memory of earlier presses."""

    def __init__(self, scenario: Scenario, felt: FeltPatient) -> None:
        """`felt`: apparent stiffness of the patient."""
        super().__init__(scenario)
        self.felt = felt
        self._breathing = BreathingCurve(scenario.phantom.breathing, scenario.seed)
        self._rng = generator(scenario.seed, "surrogate")
        self._exponent = float(self._rng.normal(*_EXPONENT))

    def press(self, xy: Array, depth: float) -> Press:
        """Press; see `Hand.press`."""
        loop, rng = self._loop, self._rng
        self._begin(xy, depth)
        time = loop.begin_s + self.spent
        excursion = np.mean([self._breathing.excursion(time - share * HAND.hold_s) for share in (0.0, 0.5, 1.0)])
        unseen = (1.0 - loop.followed) * (float(excursion) - self._breathing.mean_m)
        wander = self._errors.wander_m * float(rng.standard_normal())
        stiff = float(self.felt.force_at((xy + loop.aside_m)[None])[0])

        def felt(measured: float) -> float:
            true = max(measured - self._depth_error(xy) - wander + unseen, 0.0)
            return float(stiff * (true / 0.010) ** self._exponent)

        limited = felt(depth) > self.task.force
        if limited:
            depths = np.linspace(0.0, depth, 50)
            depth = float(np.interp(self.task.force, [felt(d) for d in depths.tolist()], depths))
        force = max(felt(depth) + float(rng.normal(0.0, HAND.tare_n) + rng.normal(0.0, HAND.noise_n)), 0.02)
        return Press(
            float(xy[0]), float(xy[1]), max(depth, HAND.shallowest_m), force, time, HAND.noise_n, limited, self._reported_sd_m
        )
