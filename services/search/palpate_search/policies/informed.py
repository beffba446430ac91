"""Expected information of the next press about the presence and place of a lump.

It is the mutual information of the hypothesis h and the next observation y,

    I = H(y) - sum_h p_h H(y | h),

in nats. Under each hypothesis y is Gaussian, so H(y | h) has a closed form. The entropy of the mixture y is a sum over a grid
(Lindley 1956; MacKay 1992, "Information-based objective functions for active data selection").
"""

from typing import Final, NamedTuple

import numpy as np

from palpate_assessment.standard import USUAL, load_calibration
from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array, Indices
from palpate_models.scenario import press
from palpate_search.posterior import Budget, Posterior, press_duration


class InformationGrid(NamedTuple):
    """Sums by which compiled code replaces the integrals over an observation."""

    bins: int = 64
    bin_sd: float = 0.25
    """Bin width: hypotheses in one bin are merged to one Gaussian."""
    nodes: int = 41
    reach_sd: float = 4.0
    """Margin of the grid around the mixture."""
    rare: float = 2e-5
    """Less probable hypotheses count as no lump."""
    same_sd: float = 0.02
    """Hypotheses that shift the observation by less count as no lump."""


GRID = InformationGrid()


@compiled
def information(unexplained: Array, contrast: Array, contrast_variance: Array, probability: Array, variance: Array) -> Array:
    """Return the information of an observation at each place [nat], shape (p,).

    `unexplained`: shape (p, h), added mean per unit log-contrast of a lump; `contrast` and its variance, shape (h,);
    `probability` of each hypothesis, shape (h,); `variance` of the observation without a lump, shape (p,).
    """
    places, hypotheses = unexplained.shape
    out = np.zeros(places)
    weight, first, second = np.empty(GRID.bins + 1), np.empty(GRID.bins + 1), np.empty(GRID.bins + 1)
    for i in range(places):
        sd, low, high = np.sqrt(variance[i]), 0.0, 0.0
        for h in range(hypotheses):
            if probability[h] > GRID.rare:
                shift = contrast[h] * unexplained[i, h]
                low, high = min(low, shift), max(high, shift)
        if high - low < GRID.same_sd * sd:
            continue
        width = max(GRID.bin_sd * sd, (high - low) / (GRID.bins - 1) + 1e-12)
        weight[:], first[:], second[:] = 0.0, 0.0, 0.0
        given, rest = 0.0, 1.0
        for h in range(hypotheses):
            p = probability[h]
            shift = contrast[h] * unexplained[i, h]
            if p > GRID.rare and abs(shift) > GRID.same_sd * sd:
                spread = variance[i] + contrast_variance[h] * unexplained[i, h] ** 2
                k = int((shift - low) / width)
                weight[k] += p
                first[k] += p * shift
                second[k] += p * (shift**2 + spread)
                given += 0.5 * p * np.log(spread)
                rest -= p
        weight[GRID.bins], first[GRID.bins], second[GRID.bins] = max(rest, 0.0), 0.0, max(rest, 0.0) * variance[i]
        given += max(rest, 0.0) * np.log(sd)
        count = 0
        for k in range(GRID.bins + 1):  # from sums to weight, mean and standard deviation, the empty bins left out
            if weight[k] > 0.0:
                mean = first[k] / weight[k]
                spread = np.sqrt(max(second[k] / weight[k] - mean**2, 1e-12))
                weight[count], first[count], second[count] = weight[k], mean, spread
                low, high = min(low, mean - GRID.reach_sd * spread), max(high, mean + GRID.reach_sd * spread)
                count += 1
        step = (high - low) / (GRID.nodes - 1)
        entropy = 0.0
        for node in range(GRID.nodes):
            y, density = low + node * step, 0.0
            for k in range(count):
                density += weight[k] / (np.sqrt(2 * np.pi) * second[k]) * np.exp(-0.5 * ((y - first[k]) / second[k]) ** 2)
            if density > 1e-300:
                entropy -= density * np.log(density) * step
        out[i] = max(entropy - given - 0.5 * np.log(2 * np.pi * np.e), 0.0)
    return out


class DeeperTuning(NamedTuple):
    """When a deeper press is considered."""

    promising: int = 12
    """Number of best places that are also evaluated for a deeper press."""
    safe: float = 0.8
    """A deeper press must have an expected force below this share of the force limit."""
    known: float = 1.0
    """A deeper press needs a variance of the log-force below this."""


DEEPER: Final = DeeperTuning()


def next_press(posterior: Posterior, budget: Budget) -> tuple[Array, float]:
    """Return the place and depth with the greatest expected information per second, including travel."""
    task, calibration = posterior.task, load_calibration()
    mean, variance = posterior.field()
    contrast, contrast_variance = posterior.contrast()
    unexplained, probability = posterior.unexplained(), posterior.probability
    duration = press_duration(posterior.here, task.places)
    exponent, spread = calibration.exponent, calibration.exponent_sd

    def rate(some: Indices, depth: float) -> Array:
        """Return information per second of presses at some of the places, shape (k,)."""
        noise = (exponent / depth * posterior.noise_m) ** 2 + (spread * np.log(depth / press.DEPTH_M)) ** 2
        noise += USUAL.errors.white_sd**2
        gain = information(unexplained[some], contrast, contrast_variance, probability, variance[some] + noise)
        return np.asarray(gain / duration[some])

    rates = np.where(posterior.open, rate(np.arange(len(task.places)), task.depth), 0.0)
    best, depth = int(np.argmax(rates)), task.depth
    if rates[best] <= 0:  # no information before the first press: the level is unknown
        best = int(np.argmin(np.where(posterior.open, np.linalg.norm(task.places - np.array(task.centre), axis=1), np.inf)))
        return task.places[best], task.depth
    greatest = rates[best]
    promising = np.argsort(-rates)[: DEEPER.promising]
    force = np.exp(mean + exponent * np.log(task.deepest / press.DEPTH_M))
    safe = promising[(force[promising] < DEEPER.safe * task.force) & (variance[promising] < DEEPER.known)]
    if len(safe) and (deeper := rate(safe, task.deepest)).max() > greatest:
        best, depth = int(safe[int(np.argmax(deeper))]), task.deepest
    return task.places[best], depth
