"""Default policy: the press with the greatest expected information per second."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from palpate_assessment.calibration import learned
from palpate_assessment.model import WHITE_SD
from palpate_models.numerics.frames import Array
from palpate_models.scenario import press
from palpate_search.information import information
from palpate_search.posterior import Posterior
from palpate_search.presses import Budget, seconds

_PROMISING: Final = 12
"""Number of best places that are also evaluated for a deeper press."""
_SAFE: Final = 0.8
"""A deeper press must have an expected force below this share of the force limit."""
_KNOWN: Final = 1.0
"""A deeper press needs a variance of the log-force below this."""


def next_press(posterior: Posterior, budget: Budget) -> tuple[Array, float]:
    """Return the place and depth with the greatest expected information per second, including travel."""
    task, calibration = posterior.task, learned()
    mean, variance = posterior.field()
    contrast, contrast_variance = posterior.contrast()
    unexplained, probability = posterior.unexplained(), posterior.probability
    duration = seconds(posterior.here, task.places)
    exponent, spread = calibration.exponent, calibration.exponent_sd

    def rate(some: NDArray[np.intp], depth: float) -> Array:
        """Return information per second of presses at some of the places, shape (k,)."""
        noise = (exponent / depth * posterior.noise_m) ** 2 + (spread * np.log(depth / press.DEPTH_M)) ** 2 + WHITE_SD**2
        gain = information(unexplained[some], contrast, contrast_variance, probability, variance[some] + noise)
        return np.asarray(gain / duration[some])

    rates = np.where(posterior.open, rate(np.arange(len(task.places)), task.depth), 0.0)
    best, depth = int(np.argmax(rates)), task.depth
    if rates[best] <= 0:  # no information before the first press: the level is unknown
        best = int(np.argmin(np.where(posterior.open, np.linalg.norm(task.places - np.array(task.centre), axis=1), np.inf)))
        return task.places[best], task.depth
    greatest = rates[best]
    promising = np.argsort(-rates)[:_PROMISING]
    force = np.exp(mean + exponent * np.log(task.deepest / press.DEPTH_M))
    safe = promising[(force[promising] < _SAFE * task.force) & (variance[promising] < _KNOWN)]
    if len(safe) and (deeper := rate(safe, task.deepest)).max() > greatest:
        best, depth = int(safe[int(np.argmax(deeper))]), task.deepest
    return task.places[best], depth
