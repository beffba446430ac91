"""Sim-to-real figures from paired outcomes of several bodies, such as levels, detections or errors of findings.

R_i is the outcome of body i on hardware and S_i in simulation. Mean maximum rank violation: the mean over i of the largest
|R_i - R_j| of a pair whose order the simulation reverses (Li et al., Evaluating Real-World Robot Manipulation Policies in
Simulation, arXiv 2405.05941). Prediction-powered mean of the outcome on hardware, with bodies that were only simulated, as in
SureSim (arXiv 2510.04354): theta = lambda mean(S of these) + mean(R - lambda S of the pairs), with the lambda of minimum variance
(Angelopoulos, Duchi and Zrnic, PPI++, arXiv 2311.01453).
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import pearsonr, t

from palpate.recording.readings import read_table
from palpate_errors import UserError
from palpate_models.numerics.frames import Array

COLUMNS = ("body", "real", "simulated")
MIN_PAIRS = 3


class SimToReal(NamedTuple):
    """Agreement of outcomes."""

    pairs: int
    simulated_only: int
    pearson: float | None
    """Null if all outcomes on hardware, or all simulated ones, are equal."""
    pearson_90: tuple[float, float] | None
    rank_violation: float
    """Mean maximum rank violation, in the unit of the outcome."""
    bias: float
    """Mean of simulated minus real."""
    mean_90: tuple[float, float]
    """Interval of the mean outcome on hardware, from hardware alone (Student's t)."""
    prediction_powered_90: tuple[float, float]
    """Interval of the mean outcome on hardware, with the simulated bodies added."""
    weight: float
    """lambda [1]: 0 if the simulation predicts nothing."""


def read_outcomes(path: Path) -> tuple[Array, Array, Array]:
    """Return real and simulated outcomes of the pairs, shapes (n,), and those of bodies that were only simulated, shape (m,).

    The table has the columns `body`, `real` and `simulated`; `real` is empty without hardware. Raises UserError.
    """
    rows = read_table(path)
    lacking = [name for name in COLUMNS if name not in rows]
    if lacking:
        raise UserError(f"{path}: lacks the column {lacking[0]}; expected {', '.join(COLUMNS)}")
    try:
        real, simulated = (rows[name].to_numpy(float) for name in COLUMNS[1:])
    except ValueError as error:
        raise UserError(f"{path}: {error}; expected numbers in the columns real and simulated") from None
    if not np.isfinite(simulated).all():
        raise UserError(f"{path}: column simulated has gaps; expected a number for each body")
    paired = np.isfinite(real)
    if paired.sum() < MIN_PAIRS:
        raise UserError(f"{path}: {paired.sum()} bodies with real and simulated; at least {MIN_PAIRS} are needed")
    return real[paired], simulated[paired], simulated[~paired]


def sim_to_real(real: Array, simulated: Array, more: Array, confidence: float = 0.9) -> SimToReal:
    """Return the figures of pairs, shapes (n,), and of outcomes that were simulated only, shape (m,)."""
    correlation = pearsonr(simulated, real) if np.ptp(real) and np.ptp(simulated) else None
    band = None if correlation is None else correlation.confidence_interval(confidence)
    swapped = (np.sign(simulated[:, None] - simulated) != np.sign(real[:, None] - real)) & ~np.eye(len(real), dtype=bool)
    violation = np.where(swapped, np.abs(real[:, None] - real), 0.0).max(axis=1).mean()
    weight = _weight(real, simulated, more)
    n, m = len(real), max(len(more), 1)
    rest = real - weight * simulated
    powered = rest.mean() + weight * (more.mean() if len(more) else 0.0)
    variance = rest.var(ddof=1) / n + weight**2 * (more.var(ddof=1) / m if len(more) > 1 else 0.0)
    return SimToReal(
        pairs=n,
        simulated_only=len(more),
        pearson=None if correlation is None else float(correlation.statistic),
        pearson_90=None if band is None else (float(band.low), float(band.high)),
        rank_violation=float(violation),
        bias=float((simulated - real).mean()),
        mean_90=_around(float(real.mean()), float(real.var(ddof=1) / n), n, confidence),
        prediction_powered_90=_around(float(powered), float(variance), n, confidence),
        weight=weight,
    )


def _weight(real: Array, simulated: Array, more: Array) -> float:
    """Return the lambda of minimum variance, in [0, 1]; 0 without bodies that were simulated only."""
    if len(more) < 2 or np.ptp(simulated) == 0:
        return 0.0
    variance = np.concatenate((simulated, more)).var(ddof=1) * (1 + len(real) / len(more))
    return float(np.clip(np.cov(real, simulated)[0, 1] / variance, 0.0, 1.0))


def _around(middle: float, variance: float, n: int, confidence: float) -> tuple[float, float]:
    half = float(t.ppf(0.5 + confidence / 2, n - 1)) * variance**0.5
    return middle - half, middle + half


def draw_outcomes(path: Path, real: Array, simulated: Array, more: Array) -> None:
    """Draw simulated against real outcomes, and those that were simulated only along the axis."""
    figure = Figure(figsize=(5, 4.6), layout="constrained")
    axes = figure.subplots()
    axes.plot(simulated, real, "o", label="pairs")
    every = np.concatenate((real, simulated, more))
    ends = float(every.min()), float(every.max())
    axes.plot(ends, ends, color="grey", lw=0.8)
    axes.plot(more, np.full(len(more), ends[0]), "|", color="tab:orange", label="simulated only")
    axes.set(xlabel="simulated", ylabel="real")
    axes.legend()
    figure.savefig(path, dpi=110)
