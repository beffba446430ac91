"""Task, presses and budget of a search, and the posterior probability of a lump: a sequential Bayesian test.

The log-force of the standard press is a Gaussian field z with errors (`palpate_assessment.model`). A hypothesis h is a round lump
with a place and radius; it adds the bump b_h to z, times an unknown log-contrast e. With S the covariance of everything else, and
e ~ N(m, s^2), the Bayes factor of the data y against no lump is

    log B_h = -1/2 log(1 + s^2 p) + 1/2 (m / s^2 + c)^2 / (1 / s^2 + p) - 1/2 m^2 / s^2,    p = b' S^-1 b,  c = b' S^-1 y

The amplitudes of natural variation and depth errors are unknown: S has a few variants, each weighted by its evidence. A press
adds one row to each Cholesky factor, so an update takes about a millisecond.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Final, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import erfc, logsumexp

from palpate_assessment.model import field_covariances, lump_covariance, lump_variance
from palpate_assessment.shapes import Bump
from palpate_assessment.standard import ABDOMEN, USUAL, load_calibration
from palpate_models.numerics.frames import Array, Mask
from palpate_models.scenario import press
from palpate_models.scenario.schema import ExamInput
from palpate_plugins import PluginKind


class PressTuning(NamedTuple):
    """Places, depths and durations of presses."""

    places_m: float = 0.010
    """Spacing of candidate places."""
    border_m: float = 0.010
    """Minimum distance of presses from the region's edge: reach and surface are known only inside."""
    min_measured_m: float = 0.002
    """Minimum measured depth that methods use: a measured depth may be zero, and its logarithm is taken."""
    shallowest_ratio: float = 0.6
    """Depth of the shallowest press, as a multiple of the nominal depth."""
    deepest_ratio: float = 1.4
    """Depth of the deepest press, as a multiple of the nominal depth."""
    travel_mps: float = 0.12
    """Mean speed between presses."""
    press_s: float = 3.2
    """Duration of a press without travel: rest and tare in free air, descent, settling, hold and lift."""


PRESSES: Final = PressTuning()


class Press(NamedTuple):
    """One press as it was measured, in the abdomen frame."""

    x: float
    """[m]"""
    y: float
    """[m]"""
    depth: float
    """[m]"""
    force: float
    """Normal force at that depth [N]."""
    time: float
    """Time of the measurement [s]."""
    noise_n: float = 0.02
    """Standard error of the force [N]."""
    limited: bool = False
    """True if the force limit stopped the press before its depth."""
    depth_uncertainty: float = 0.001
    """Reported SD of the depth [m]."""
    stroke: int = 0
    """Number of the descent."""

    @property
    def xy(self) -> Array:
        """Place [m], shape (2,)."""
        return np.array((self.x, self.y))


@dataclass(frozen=True)
class Budget:
    """Remaining presses and time."""

    presses: int
    seconds: float


@dataclass(frozen=True)
class Task:
    """The searched region and the limits of presses."""

    centre: tuple[float, float]
    """Centre of the region, in the abdomen frame [m]."""
    size: tuple[float, float]
    """Size of the region along x and y [m]."""
    depth: float = 0.010
    """Nominal depth of a press [m]."""
    deepest: float = 0.014
    """Maximum depth of a press [m]."""
    force: float = 15.0
    """Force limit of a press [N]."""
    depth_uncertainty: float = 0.001
    """Expected SD of the depth before the first press [m]."""
    budget: Budget = Budget(100, 600.0)
    """Budget at the start."""
    seed: int = 0
    """Seed of a policy's random numbers."""

    @property
    def shallowest(self) -> float:
        """Minimum depth of a press [m]."""
        return PRESSES.shallowest_ratio * self.depth

    @classmethod
    def of(cls, known: ExamInput) -> "Task":
        """Return the task of an examination."""
        exam, limits = known.exam, known.limits
        deepest = min(PRESSES.deepest_ratio * exam.depth_m, limits.depth_m)
        budget = Budget(exam.budget.presses, exam.budget.seconds)
        return cls(exam.centre_m, exam.region_m, exam.depth_m, deepest, limits.force_working_n, budget=budget, seed=exam.seed)

    @cached_property
    def places(self) -> Array:
        """Candidate places [m], shape (p, 2): a lattice with a spacing of about PRESSES.places_m, ordered by x."""
        axes = [self._axis(k) for k in (0, 1)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)

    @cached_property
    def low(self) -> Array:
        """Minimum x and y of a press [m], shape (2,)."""
        return np.array(self.centre) - self._half

    @cached_property
    def high(self) -> Array:
        """Maximum x and y of a press [m], shape (2,)."""
        return np.array(self.centre) + self._half

    @property
    def _half(self) -> Array:
        return np.maximum(0.5 * np.array(self.size) - PRESSES.border_m, 0.0)

    def _axis(self, k: int) -> Array:
        low, high = self.low[k], self.high[k]
        return np.linspace(low, high, max(round((high - low) / PRESSES.places_m), 0) + 1)


def press_duration(begin: Array | None, end: Array) -> Array:
    """Return the duration [s], shape () or (k,), of a press at `end` [m], shape (2,) or (k, 2), with the way from `begin` [m]."""
    hop = np.linalg.norm(end - (end if begin is None else begin), axis=-1)
    return np.asarray(PRESSES.press_s + hop / PRESSES.travel_mps)


class LumpPrior(NamedTuple):
    """Hypotheses of a lump, and when one is found."""

    radii_m: tuple[float, float, float] = (0.014, 0.022, 0.030)
    """Palpable radii of the lump hypotheses."""
    edge_m: float = 0.013
    """SD of the smooth edge of a palpated lump: a press deforms a few centimetres of skin."""
    outside: float = 0.2
    """Relative prior of a lump that extends beyond the region: the region is chosen to contain the lump."""
    probability: float = 0.5
    """Prior probability of a lump."""
    another: float = 0.2
    """Prior probability of another lump after one was found."""
    near_m: float = 0.020
    """Hypotheses within this distance count as one lump."""
    found: float = 0.95
    """A lump with this probability counts as found."""
    placed_m: float = 0.006
    """RMS uncertainty of the place below which a lump counts as located."""


LUMPS: Final = LumpPrior()

CONTRAST: Final = (float(np.log(2.0)), 0.25)
"""Prior mean and standard deviation of a lump's log-contrast."""


class FieldPrior(NamedTuple):
    """Natural variation of the log-force, and errors of the depth."""

    natural_sd: tuple[float, float, float, float, float, float] = (0.025, 0.060, 0.13, 0.105, 0.16, 0.048)
    """Amplitudes of the fields of natural variation, strips last (`palpate_assessment.model.field_covariances`)."""
    bone_sd: float = 0.27
    """Amplitude of bone."""
    variation_scales: tuple[float, float] = (0.75, 1.3)
    """Model variants: natural variation over its typical amplitude."""
    depth_error_scales: tuple[float, float] = (0.75, 1.3)
    """Model variants: depth errors over their typical size."""


FIELD: Final = FieldPrior()

SURFACE_SHARE, STROKE_SHARE = 0.45, 0.75
"""Fractions of the reported depth uncertainty that are spatially correlated and independent. Maximum likelihood over healthy
tuning patients (`research.search.prior`, docs/search.md)."""
USUAL_N, LEVEL_SD = 2.2, 1.0
"""Prior mean [N] and SD (in the logarithm) of the force of the standard press; much wider than the variation between people."""


class Posterior:
    """Posterior probability of each hypothesis, and of the field, given the presses."""

    def __init__(
        self,
        task: Task,
        accepted: Sequence[Bump] = (),
        models: Sequence[tuple[float, float]] = tuple(product(FIELD.variation_scales, FIELD.depth_error_scales)),
    ) -> None:
        """`accepted`: lumps that were found; the search is for others. `models`: scales of natural variation and depth errors."""
        self.task = task
        self.accepted = tuple(accepted)
        self.presses: list[Press] = []
        self.vain = 0
        """Presses that were asked for and gave no sample."""
        places = task.places
        self.centres: Array = np.tile(places, (len(LUMPS.radii_m), 1))
        """Centres of the hypotheses' lumps [m], shape (h, 2)."""
        self.open: Mask = np.ones(len(places), dtype=bool)
        """Places that may be pressed, shape (p,): all but those that the arm could not take."""
        self.radii: Array = np.repeat(LUMPS.radii_m, len(places))
        """Their radii [m], shape (h,)."""
        self.shapes: Array = self._shapes(places)
        """Each bump at each place, shape (p, h)."""
        likely = self._likely()
        there = LUMPS.another if self.accepted else LUMPS.probability
        self._log_prior = np.log(np.append(there * likely / max(likely.sum(), 1e-9), 1 - there) + 1e-300)
        self._models = tuple(models)
        self._parts = np.array([[*(np.array(FIELD.natural_sd) * rough) ** 2, FIELD.bone_sd**2] for rough, _ in self._models])
        count, most = len(self._models), 16
        self._factor = np.zeros((count, most, most))
        self._whitened = np.zeros((count, most))
        self._bumps = np.zeros((count, most, len(self.radii)))
        self._field = np.zeros((count, most, len(places)))
        self._power = np.zeros((count, len(self.radii)))
        self._match = np.zeros((count, len(self.radii)))
        self._evidence = np.zeros(count)
        self._error: list[float] = []
        self._log_depth: list[float] = []
        self._weigh()

    # --- what it says -------------------------------------------------------------------------------------------------

    @property
    def lump(self) -> float:
        """Probability of a lump besides the accepted ones: of a missed one, if none is reported."""
        return float(1.0 - self.none)

    @property
    def at(self) -> tuple[Array, float]:
        """Most probable place of a lump [m], shape (2,), and the probability of a lump within LUMPS.near_m of it."""
        centre = self.task.places
        there = self.by_place
        peak = centre[int(np.argmax(there))]
        near = np.linalg.norm(centre - peak, axis=1) <= LUMPS.near_m
        weight = there[near]
        total = float(weight.sum())
        return (weight @ centre[near] / total if total > 0 else peak), total

    @property
    def by_place(self) -> Array:
        """Probability that a lump's centre is at each place, shape (p,)."""
        return np.asarray(self.probability.reshape(len(LUMPS.radii_m), -1).sum(axis=0))

    @property
    def asked(self) -> int:
        """Number of finished requests."""
        return len(self.presses) + self.vain

    @property
    def here(self) -> Array | None:
        """Place of the indenter [m], shape (2,); None before the first press."""
        return self.presses[-1].xy if self.presses else None

    @property
    def found(self) -> Bump | None:
        """A lump with probability LUMPS.found and uncertainty of place LUMPS.placed_m; None without one."""
        (x, y), probability = self.at
        apart = np.hypot(self.centres[:, 0] - x, self.centres[:, 1] - y)
        weight = np.where(apart <= LUMPS.near_m, self.probability, 0.0)
        if probability < LUMPS.found or weight @ apart**2 > LUMPS.placed_m**2 * weight.sum():
            return None
        return Bump(float(x), float(y), float(weight @ self.radii / weight.sum()), LUMPS.edge_m)

    @property
    def likeliest(self) -> int:
        """Index of the most probable model."""
        return int(np.argmax(self._weights))

    @property
    def noise_m(self) -> float:
        """SD of the next press's depth error under that model [m], taken from the latest press."""
        reported = self.presses[-1].depth_uncertainty if self.presses else self.task.depth_uncertainty
        return float(self._models[self.likeliest][1] * reported)

    def contrast(self) -> tuple[Array, Array]:
        """Return mean and variance of the log-contrast under each hypothesis, shape (h,) each, by the most probable model."""
        k = self.likeliest
        mean, sd = CONTRAST
        variance = 1.0 / (1.0 / sd**2 + self._power[k])
        return (mean / sd**2 + self._match[k]) * variance, variance

    def field(self) -> tuple[Array, Array]:
        """Return mean and variance of z without a lump at the places, shape (p,) each, by the most probable model."""
        k, n = self.likeliest, len(self.presses)
        seen = self._field[k, :n]
        mean = np.log(USUAL_N) + self._whitened[k, :n] @ seen
        variance = LEVEL_SD**2 + self._parts[k, :-1].sum() + self._parts[k, -1] * ABDOMEN.bone(self.task.places) ** 2
        variance = variance + sum((lump_variance(bump, self.task.places, USUAL) for bump in self.accepted), np.zeros(1))
        return mean, np.maximum(variance - (seen**2).sum(axis=0), 1e-6)

    def unexplained(self) -> Array:
        """Return the added mean at each place per unit log-contrast, shape (p, h), by the most probable model."""
        k, n = self.likeliest, len(self.presses)
        return np.asarray(self.shapes - self._field[k, :n].T @ self._bumps[k, :n])

    # --- one more press -----------------------------------------------------------------------------------------------

    def add(self, felt: Press) -> None:
        """Update the posterior with a press."""
        calibration = load_calibration()
        depth, force = max(felt.depth, PRESSES.min_measured_m), max(felt.force, 0.1)
        log_depth, error = float(np.log(depth / press.DEPTH_M)), calibration.exponent / depth * felt.depth_uncertainty
        y = float(np.log(force)) - calibration.exponent * log_depth - np.log(USUAL_N)
        xy, n = felt.xy[None], len(self.presses)
        old = np.array([one.xy for one in self.presses]).reshape(-1, 2)
        self._grow(n + 1)
        with_old, with_places, with_itself = (self._natural(xy, other)[:, 0] for other in (old, self.task.places, xy))
        wrong = np.array([wrong for _, wrong in self._models])
        if n:
            apart = ((old - xy) ** 2).sum(axis=1)
            shared = SURFACE_SHARE**2 * error * np.array(self._error) * np.exp(-0.5 * apart / USUAL.errors.surface_m**2)
            with_old = with_old + wrong[:, None] ** 2 * shared
            with_old += calibration.exponent_sd**2 * log_depth * np.array(self._log_depth)
        white = USUAL.errors.white_sd**2 + (felt.noise_n**2 + USUAL.tare_n**2) / force**2
        white += (calibration.exponent_sd * log_depth) ** 2
        itself = with_itself[:, 0] + white + (STROKE_SHARE**2 + SURFACE_SHARE**2) * (wrong * error) ** 2
        new_bump = self._shapes(xy)[0]
        for k in range(len(self._models)):
            row = solve_triangular(self._factor[k, :n, :n], with_old[k], lower=True) if n else np.zeros(0)
            sd = float(np.sqrt(max(itself[k] - row @ row, 1e-9)))
            residual = (y - row @ self._whitened[k, :n]) / sd
            bumps = (new_bump - row @ self._bumps[k, :n]) / sd
            self._factor[k, n, :n], self._factor[k, n, n] = row, sd
            self._whitened[k, n], self._bumps[k, n] = residual, bumps
            self._field[k, n] = (with_places[k] - row @ self._field[k, :n]) / sd
            self._power[k] += bumps**2
            self._match[k] += bumps * residual
            self._evidence[k] -= np.log(sd) + 0.5 * residual**2
        self.presses.append(felt)
        self._error.append(error)
        self._log_depth.append(log_depth)
        self._weigh()

    def refuse(self, xy: Array) -> None:
        """Exclude the place nearest to xy [m], shape (2,): the arm cannot press it."""
        self.open[np.argmin(np.linalg.norm(self.task.places - xy, axis=1))] = False

    def accept(self, bump: Bump) -> "Posterior":
        """Return the posterior of further lumps, given this one."""
        other = Posterior(self.task, (*self.accepted, bump), self._models)
        for felt in self.presses:
            other.add(felt)
        other.open, other.vain = self.open, self.vain
        return other

    def remaining(self, spent_s: float) -> Budget:
        """Return the remaining budget."""
        whole = self.task.budget
        return Budget(max(whole.presses - len(self.presses), 0), whole.seconds - spent_s)

    # --- parts --------------------------------------------------------------------------------------------------------

    def _weigh(self) -> None:
        mean, sd = CONTRAST
        power, match = self._power, self._match
        gain = 0.5 * (mean / sd**2 + match) ** 2 / (1 / sd**2 + power) - 0.5 * mean**2 / sd**2 - 0.5 * np.log1p(sd**2 * power)
        joint = self._evidence[:, None] + np.column_stack((gain, np.zeros(len(gain)))) + self._log_prior
        joint = np.exp(joint - logsumexp(joint))
        self._weights = joint.sum(axis=1)
        self.probability: Array = joint[:, :-1].sum(axis=0)
        """Probability of each hypothesis, shape (h,)."""
        self.none = float(joint[:, -1].sum())
        """Probability of no lump besides the accepted ones."""

    def _natural(self, a: Array, b: Array) -> Array:
        """Return the covariance of the field without a lump under each model, shape (models, k, l)."""
        parts = np.array(field_covariances(a, b, USUAL))
        known = sum((lump_covariance(bump, a, b, USUAL) for bump in self.accepted), np.zeros((len(a), len(b))))
        return np.asarray(LEVEL_SD**2 + np.tensordot(self._parts, parts, 1) + known)

    def _shapes(self, xy: Array) -> Array:
        """Return the bump of each hypothesis at places, shape (k, 2) -> (k, h)."""
        r = np.linalg.norm(xy[:, None] - self.centres, axis=2)
        return np.asarray(0.5 * erfc((r - self.radii) / (np.sqrt(2) * LUMPS.edge_m)))

    def _likely(self) -> Array:
        """Return the unnormalised prior of each hypothesis given the accepted lumps, shape (h,)."""
        out = np.abs(self.centres - self.task.centre) + self.radii[:, None] > 0.5 * np.array(self.task.size) + 1e-9
        likely = np.where(out.any(axis=1), LUMPS.outside, 1.0)
        for bump in self.accepted:
            likely *= np.hypot(self.centres[:, 0] - bump.x, self.centres[:, 1] - bump.y) > self.radii + bump.radius
        return likely

    def _grow(self, n: int) -> None:
        most = self._whitened.shape[1]
        if n > most:
            self._factor = np.pad(self._factor, ((0, 0), (0, most), (0, most)))
            self._whitened = np.pad(self._whitened, ((0, 0), (0, most)))
            self._bumps = np.pad(self._bumps, ((0, 0), (0, most), (0, 0)))
            self._field = np.pad(self._field, ((0, 0), (0, most), (0, 0)))


LAYERS = 6


def shape(posterior: Posterior) -> tuple[int, int]:
    """Return the number of places along x and y."""
    rows = len(np.unique(posterior.task.places[:, 0]))
    return rows, len(posterior.task.places) // rows


def maps(posterior: Posterior) -> Array:
    """Return layers over the places, shape (LAYERS, nx, ny), all within about -1 to 1.

    Log probability of a lump at the place over chance; mean (centred) and SD of the log field; travel time to the place [s];
    probability of any lump; share of remaining presses.
    """
    mean, variance = posterior.field()
    left = 1.0 - len(posterior.presses) / posterior.task.budget.presses
    layers = np.empty((LAYERS, len(mean)))
    layers[0] = np.log(posterior.by_place * len(mean) + 0.01) / np.log(len(mean))
    layers[1], layers[2] = mean - mean.mean(), np.sqrt(variance)
    layers[3] = press_duration(posterior.here, posterior.task.places) - PRESSES.press_s
    layers[4], layers[5] = posterior.lump, left
    return layers.reshape(LAYERS, *shape(posterior))


Policy = Callable[[Posterior, Budget], tuple[Array, float]]
"""`next_press(posterior, budget) -> place, depth`: xy in the abdomen frame [m], shape (2,), and depth [m]."""
POLICY: Final = PluginKind("policy", "search.policy", "next_press", "posterior, budget")


def policy(choice: str) -> Policy:
    """Return the policy of a name or file. Raises PluginError."""
    return POLICY.load(choice)
