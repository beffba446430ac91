"""One search of one patient by one policy, the hands that press, and the population of such patients.

A hand makes single presses on a simulated patient, with the errors and durations of whole examinations. `PatientHand` presses the
true tissue as the quick tier does. `SurrogateHand` scales the apparent stiffness of the standard press (`palpate.quick.felt`): no
physics, a hundredth of the time. Places are in the registered abdomen frame.
"""

from dataclasses import replace
from time import perf_counter
from typing import Final, NamedTuple, Protocol

import numpy as np

from palpate.quick.errors import Loop, loop_errors
from palpate.quick.examination import QuickExamination
from palpate.quick.felt import FeltPatient, between, felt_patient
from palpate_models.numerics.frames import Array, apply, inverse
from palpate_models.numerics.seeds import generator
from palpate_models.patient.motion import BreathingCurve
from palpate_models.scenario.errors import draw_errors
from palpate_models.scenario.load import exam_input, load_scenario
from palpate_models.scenario.schema import Scenario
from palpate_planning.stroke import STROKE
from palpate_search.posterior import Policy, Posterior, Press, Task, press_duration


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


class TrialLump(NamedTuple):
    """The lump and the budget of a trial."""

    contrast: float = 2.0
    """Felt contrast of each lump, by the surrogate, at its centre."""
    radius_m: float = 0.020
    border_m: float = 0.030
    """Minimum distance of a lump's centre from the region's edge."""
    presses: int = 100


TRIAL: Final = TrialLump()
_MODULI: Final = (1.2, 30.0)
"""Search interval of the modulus contrast."""


class SearchCase(NamedTuple):
    """A patient of the search population."""

    scenario: Scenario
    felt: FeltPatient
    """Apparent stiffness by the standard press."""
    centre: Array | None
    """Centre of the lump in the abdomen frame as registered [m], shape (2,); None without one."""


def case(seed: int, errors: str = "typical") -> SearchCase:
    """Return the patient of a seed: odd seeds have a lump, whose modulus gives the felt contrast `TRIAL.contrast`."""
    settings = [f"errors={errors}", "phantom.breathing.kind=quiet", "phantom.draw.lumps=[0, 0]"]
    settings += [f"exam.budget.presses={TRIAL.presses}", "exam.budget.seconds=3600"]
    if seed % 2 == 0:
        scenario = load_scenario("person", settings, seed)
        return SearchCase(scenario, felt_patient(scenario.phantom, seed), None)
    region = load_scenario("person", settings, seed).exam
    half = 0.5 * np.array(region.region_m) - TRIAL.border_m
    centre = generator(seed, "search lump").uniform(-half, half) + region.centre_m
    low, high = np.log(_MODULI)
    for _ in range(5):  # log felt contrast is nearly linear in log modulus
        middle = 0.5 * (low + high)
        lump = f"{{centre_m: {centre.tolist()}, radii_m: [{TRIAL.radius_m}, {TRIAL.radius_m}], contrast: {np.exp(middle):.4f}}}"
        scenario = load_scenario("person", [*settings, f"phantom.lesions=[{lump}]"], seed)
        felt = felt_patient(scenario.phantom, seed)
        excess = float(felt.excess_at(centre[None])[0])
        low, high = (middle, high) if excess < np.log(TRIAL.contrast) else (low, middle)
    registered = apply(draw_errors(scenario.errors, seed).X_AAt, felt.skin_at(centre))
    return SearchCase(scenario, felt, registered[:2])


class Trial(NamedTuple):
    """A search of n presses."""

    xy: Array
    """Places of the presses [m], shape (n, 2)."""
    depth: Array
    """[m], shape (n,)"""
    force: Array
    """[N], shape (n,)"""
    seconds: Array
    """Time from the start to the end of each press [s], shape (n,)."""
    near: Array
    """Probability of a lump near the most probable place after each press, shape (n,)."""
    lump: Array
    """Probability of any lump after each press, shape (n,)."""
    place: Array
    """The most probable place [m], shape (n, 2)."""
    computing_s: float
    """Mean computing time of policy and posterior per press [s]."""

    def decided(self, threshold: float) -> int | None:
        """Return the index of the first press after which `near` reaches `threshold`; None if it never does."""
        above = np.flatnonzero(self.near >= threshold)
        return int(above[0]) if len(above) else None


def search(hand: Hand, policy: Policy, presses: int | None = None, posterior: Posterior | None = None) -> Trial:
    """Run a policy on a patient until the budget is spent, or for `presses` presses.

    `posterior`: initial posterior; updated in place.
    """
    belief = posterior or Posterior(hand.task)
    rows: list[tuple[float, ...]] = []
    computing_s = 0.0
    left = belief.remaining(hand.spent)
    count = hand.task.budget.presses if presses is None else presses
    while len(rows) < count and left.presses > 0 and left.seconds > 0:
        begin = perf_counter()
        xy, depth = policy(belief, left)
        chosen = perf_counter()
        felt = hand.press(np.asarray(xy, dtype=float), float(depth))
        pressed = perf_counter()
        belief.add(felt)
        place, near = belief.at
        computing_s += perf_counter() - pressed + chosen - begin
        rows.append((*felt.xy, felt.depth, felt.force, hand.spent, near, belief.lump, *place))
        left = belief.remaining(hand.spent)
    table = np.array(rows).reshape(-1, 9)
    depths, forces, seconds, nears, lumps = table[:, 2:7].T
    return Trial(table[:, :2], depths, forces, seconds, nears, lumps, table[:, 7:], computing_s / max(len(rows), 1))
