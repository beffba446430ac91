"""A figure with its interval and its sample size; rates with Wilson intervals, everything else by a bootstrap over patients."""

from collections.abc import Callable
from math import isfinite
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field
from statsmodels.stats.proportion import proportion_confint

from palpate_models.numerics.seeds import generator

Array = NDArray[np.float64]

LEVEL: Final = 0.95
"""Level of all intervals."""
FOLDS: Final = 1000
"""Resamplings of a bootstrap."""


class Row(BaseModel):
    """A part of study.json."""

    model_config = ConfigDict(frozen=True, use_attribute_docstrings=True, arbitrary_types_allowed=True)


Drawn: Any = Field(default=None, exclude=True)
"""A field for plots, which is not in study.json."""


class Estimate(Row):
    """A figure with its 95 % interval; None if the data do not determine it."""

    value: float | None
    low: float | None = None
    high: float | None = None
    n: int
    """Sample size, a number of `of`."""
    of: str
    """Counted unit: patients, lumps, findings."""
    interval: str = "bootstrap over patients"
    """Method of the interval."""


def wilson(successes: float, n: int, of: str) -> Estimate:
    """Return a rate with Wilson's score interval (Wilson, J Am Stat Assoc 1927;22:209)."""
    if n == 0:
        return Estimate(value=None, n=0, of=of, interval="Wilson")
    low, high = proportion_confint(successes, n, alpha=1 - LEVEL, method="wilson")
    return Estimate(value=successes / n, low=float(low), high=float(high), n=n, of=of, interval="Wilson")


class Bootstrap(NamedTuple):
    """Resamplings of patients with replacement, within each population.

    All methods share them, and so are paired. A replicate of a statistic is the statistic with every patient counted as often
    as he was drawn.
    """

    counts: NDArray[np.int32]
    """Number of draws of each patient, shape (folds, patients)."""

    @staticmethod
    def draw(populations: ArrayLike, folds: int = FOLDS, seed: int = 0) -> "Bootstrap":
        """Draw the resamplings; `populations`: population of each patient, shape (patients,)."""
        rng = generator(seed, "bootstrap over patients")
        names = np.asarray(populations)
        counts = np.zeros((folds, len(names)), dtype=np.int32)
        for name in np.unique(names):
            member = np.flatnonzero(names == name)
            counts[:, member] = rng.multinomial(len(member), np.full(len(member), 1 / len(member)), size=folds)
        return Bootstrap(counts)

    def sums(self, values: ArrayLike, patient: ArrayLike) -> Array:
        """Return sums by patient, shape (patients,), of values with the index of their patient, shapes (m,)."""
        weights = np.asarray(values, dtype=np.float64)
        indices = np.asarray(patient, dtype=np.intp)
        return np.bincount(indices, weights=weights, minlength=self.counts.shape[1]).astype(np.float64)

    def ratio(self, above: Array, below: Array) -> Array:
        """Return replicates of sum(above) / sum(below), shape (folds,); both by patient; NaN if the sum below is 0."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray((self.counts @ above) / (self.counts @ below), dtype=np.float64)

    def share(self, hits: ArrayLike, patient: ArrayLike, of: str, out_of: ArrayLike | None = None) -> Estimate:
        """Return sum(hits) / sum(out_of), which is ones by default; values have the index of their patient, shapes (m,)."""
        found = self.sums(hits, patient)
        made = self.sums(np.ones(len(np.asarray(patient))) if out_of is None else out_of, patient)
        n = int(made.sum())
        value = float(found.sum() / n) if n else np.nan
        return bound(value, self.ratio(found, made), n, of, int((made > 0).sum()))

    def quantile(self, values: Array, patient: NDArray[np.intp], q: float) -> Array:
        """Return replicates of the quantile `q`, shape (folds,), of values with the index of their patient, shapes (m,)."""
        order = np.argsort(values)
        drawn = np.cumsum(self.counts[:, patient[order]], axis=1)
        at = np.argmax(drawn >= q * drawn[:, -1:], axis=1)
        return np.where(drawn[:, -1] > 0, values[order][at], np.nan)


def percentiles(replicates: Array, level: float = LEVEL) -> tuple[float, float] | None:
    """Return the percentile interval of replicates (Efron 1979); None if fewer than half of them exist."""
    known = replicates[np.isfinite(replicates)]
    if 2 * len(known) < len(replicates) or not len(known):
        return None
    low, high = np.quantile(known, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def estimate(value: float, replicates: Array, n: int, of: str, degenerate: Callable[[], Estimate] | None = None) -> Estimate:
    """Return a figure with its bootstrap interval.

    Where all replicates are one number, as when every lump was found, resampling says nothing of what was not seen;
    `degenerate` then gives the interval.
    """
    if not isfinite(value):
        return Estimate(value=None, n=n, of=of)
    ends = percentiles(replicates)
    if ends is not None and ends[0] == ends[1] and degenerate is not None:
        return degenerate()
    low, high = ends or (None, None)
    return Estimate(value=float(value), low=low, high=high, n=n, of=of)


def bound(value: float, replicates: Array, n: int, of: str, patients: int) -> Estimate:
    """Return a figure between 0 and 1 with its bootstrap interval; at 0 or 1 with Wilson's, with one trial per patient."""

    def at_the_end() -> Estimate:
        ends = wilson(value * patients, patients, "patients")
        return Estimate(value=float(value), low=ends.low, high=ends.high, n=n, of=of, interval=f"Wilson, of {patients} patients")

    return estimate(value, replicates, n, of, at_the_end)
