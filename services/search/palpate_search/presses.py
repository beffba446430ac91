"""Data of a search: the task (region, limits), presses, and the budget."""

from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_models.scenario.schema import ExamInput


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
