"""Region, presses and remaining budget of a search."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_models.scenario.schema import ExamInput

PLACES_M = 0.010
"""Distance of the places that are weighed."""
BORDER_M = 0.010
"""Margin of presses from the edge of the region [m]."""
SHALLOWEST_M = 0.002
"""A depth below this counts as this: it may be measured as none."""
SHALLOWER = 0.6
"""Shallowest press, as a share of the usual depth."""
DEEPER = 1.4
"""Deepest press, as a share of the usual depth."""
TRAVEL_MPS = 0.12
"""Mean speed of a hop from one place to the next."""
PRESS_S = 3.2
"""Duration of a press without the hop [s]: rest and tare in the air, descent, settling, hold and lift."""


@dataclass(frozen=True)
class Press:
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
    """[s]"""
    noise_n: float = 0.02
    """Standard error of the force [N]."""
    limited: bool = False
    """True if the force limit reduced the depth."""
    depth_uncertainty: float = 0.001
    """Standard deviation of the depth, as reported [m]."""
    stroke: int = 0
    """Number of the descent in which it was felt."""

    @property
    def xy(self) -> Array:
        """Place, shape (2,) [m]."""
        return np.array((self.x, self.y))


@dataclass(frozen=True)
class Budget:
    """Remaining presses and seconds."""

    presses: int
    seconds: float


@dataclass(frozen=True)
class Task:
    """Region of a search, and limits of its presses."""

    centre: tuple[float, float]
    """Centre of the region, in the abdomen frame [m]."""
    size: tuple[float, float]
    """Size of the region along x and y [m]."""
    depth: float = 0.010
    """Usual depth of a press [m]."""
    deepest: float = 0.014
    """[m]"""
    force: float = 15.0
    """At this force depth yields [N]."""
    depth_uncertainty: float = 0.001
    """Standard deviation of a press's depth that is expected before the first one [m]."""
    budget: Budget = Budget(100, 600.0)
    """At the beginning."""
    seed: int = 0
    """Seed of what a policy draws."""

    @property
    def shallowest(self) -> float:
        """Least depth of a press [m]."""
        return SHALLOWER * self.depth

    @classmethod
    def of(cls, known: ExamInput) -> Task:
        """The task of an examination."""
        exam, limits = known.exam, known.limits
        deepest = min(DEEPER * exam.depth_m, limits.depth_m)
        budget = Budget(exam.budget.presses, exam.budget.seconds)
        return cls(exam.centre_m, exam.region_m, exam.depth_m, deepest, limits.force_working_n, budget=budget, seed=exam.seed)

    @cached_property
    def places(self) -> Array:
        """Places that may be pressed [m], shape (p, 2): a lattice about PLACES_M apart, x by x."""
        axes = [self._axis(k) for k in (0, 1)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)

    @cached_property
    def low(self) -> Array:
        """Least x and y of a press [m], shape (2,)."""
        return np.array(self.centre) - self._half

    @cached_property
    def high(self) -> Array:
        """Greatest x and y of a press [m], shape (2,)."""
        return np.array(self.centre) + self._half

    @property
    def _half(self) -> Array:
        return np.maximum(0.5 * np.array(self.size) - BORDER_M, 0.0)

    def _axis(self, k: int) -> Array:
        low, high = self.low[k], self.high[k]
        return np.linspace(low, high, max(round((high - low) / PLACES_M), 0) + 1)


def seconds(begin: Array | None, end: Array) -> Array:
    """Return the duration [s] of a press at `end` (2,), or at each of several (k, 2), from `begin`: shape () or (k,)."""
    hop = np.linalg.norm(end - (end if begin is None else begin), axis=-1)
    return np.asarray(PRESS_S + hop / TRAVEL_MPS)
