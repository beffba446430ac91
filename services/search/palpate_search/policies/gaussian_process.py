"""Baselines: a Gaussian process of the measured forces (scikit-learn) and the maximum of an acquisition function.

They have no lump model: the process is one smooth field of log-force with a squared exponential kernel and white noise, as in the
papers. The amplitude comes from the measurements; length and noise are set for this task, not for the papers' phantoms.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.stats import norm
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, WhiteKernel

from palpate_assessment.standard import load_calibration
from palpate_models.numerics.frames import Array
from palpate_models.scenario import press
from palpate_search.posterior import PRESSES, Budget, Posterior, Task


class ProcessTuning(NamedTuple):
    """Parameters of the process and of its acquisitions."""

    length_m: float = 0.020
    """Length scale of the process: the lump radius."""
    noise: float = 0.15
    """SD of the white noise over that of the process."""
    first: int = 4
    """Presses before the first fit, spread over the region."""
    ucb: float = 2.0
    """Standard deviations of the upper confidence bound."""
    straddle: float = 1.96
    """Weight of the standard deviation in the straddle (Bryan et al. 2005)."""
    level: float = 0.5
    """Level between the least (0) and greatest (1) mean."""
    garg: float = 0.5
    """Weight of nearness to the level against uncertainty."""
    localised: int = 30
    """Presses after which Yan and Pan's search has localised the lump."""


TUNING = ProcessTuning()

Acquisition = Callable[[Array, Array, Array], Array]
"""A function of mean and SD at the places, shape (p,) each, and the measurements, shape (n,)."""


def _fit(posterior: Posterior) -> tuple[Array, Array, Array]:
    """Return mean and SD of the process at the places, and the standardised measurements."""
    exponent = load_calibration().exponent
    xy = np.array([felt.xy for felt in posterior.presses])
    force = np.array([max(felt.force, 0.1) for felt in posterior.presses])
    depth = np.array([max(felt.depth, PRESSES.min_measured_m) for felt in posterior.presses])
    y = np.log(force) - exponent * np.log(depth / press.DEPTH_M)
    y = (y - y.mean()) / max(float(y.std()), 0.05)
    kernel = RBF(TUNING.length_m) + WhiteKernel(TUNING.noise**2)
    process = GaussianProcessRegressor(kernel, optimizer=None).fit(xy, y)
    mean, sd = process.predict(posterior.task.places, return_std=True)
    return mean, np.sqrt(np.maximum(sd**2 - TUNING.noise**2, 1e-9)), y


def _greatest(posterior: Posterior, budget: Budget, acquisition: Acquisition) -> tuple[Array, float]:
    if posterior.asked < TUNING.first or not posterior.presses:
        return first(posterior.task, posterior.asked % TUNING.first), posterior.task.depth
    score = np.where(posterior.open, acquisition(*_fit(posterior)), -np.inf)
    return posterior.task.places[int(np.argmax(score))], posterior.task.depth


def first(task: Task, k: int) -> Array:
    """Return the k-th initial press, the centre of a quarter of the region [m], shape (2,)."""
    share = np.array(((0.25, 0.25), (0.75, 0.75), (0.25, 0.75), (0.75, 0.25))[k])
    return np.asarray(task.low + share * (task.high - task.low))


def expected_improvement(posterior: Posterior, budget: Budget) -> tuple[Array, float]:
    """Mockus 1975; Jones, Schonlau and Welch 1998: expected excess over the stiffest place measured."""

    def improvement(mean: Array, sd: Array, felt: Array) -> Array:
        gain = mean - felt.max()
        return np.asarray(gain * norm.cdf(gain / sd) + sd * norm.pdf(gain / sd))

    return _greatest(posterior, budget, improvement)


def upper_confidence_bound(posterior: Posterior, budget: Budget) -> tuple[Array, float]:
    """Srinivas et al. 2010: mean plus `ucb` standard deviations."""
    return _greatest(posterior, budget, lambda mean, sd, _: mean + TUNING.ucb * sd)


def straddle(posterior: Posterior, budget: Budget) -> tuple[Array, float]:
    """Bryan et al. 2005: 1.96 standard deviations less the distance from the level, half way between least and greatest mean."""
    return _greatest(posterior, budget, lambda mean, sd, _: TUNING.straddle * sd - np.abs(mean - _level(mean)))


def garg_2016(posterior: Posterior, budget: Budget) -> tuple[Array, float]:
    """Garg et al. 2016, implicit level set upper confidence bound: uncertainty against distance from the implicit level.

    Their level is a share of the greatest mean. Their weights were set for their phantom; here they are `garg` and `level`.
    """
    return _greatest(posterior, budget, lambda mean, sd, _: (1 - TUNING.garg) * sd - TUNING.garg * np.abs(mean - _level(mean)))


def yan_pan_2021(posterior: Posterior, budget: Budget) -> tuple[Array, float]:
    """Yan and Pan 2021: Bayesian optimisation for `localised` presses, then along the border of the finding.

    Expected improvement stands in for their acquisition function, which the abstract does not state. They slide along the border;
    this policy presses where the side of the border is least certain.
    """
    if len(posterior.presses) < TUNING.localised:
        return expected_improvement(posterior, budget)

    def border(mean: Array, sd: Array, _: Array) -> Array:
        peak = posterior.task.places[int(np.argmax(mean))]
        near = np.linalg.norm(posterior.task.places - peak, axis=1) < 2.5 * TUNING.length_m
        return np.where(near, sd - np.abs(mean - _level(mean)), -np.inf)

    return _greatest(posterior, budget, border)


def _level(mean: Array) -> float:
    return float(mean.min() + TUNING.level * (mean.max() - mean.min()))
