"""The posterior as maps over the places: the input of a learned policy."""

from __future__ import annotations

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_search.posterior import Posterior
from palpate_search.presses import PRESS_S, seconds

LAYERS = 6


def shape(posterior: Posterior) -> tuple[int, int]:
    """Places along x and along y."""
    rows = len(np.unique(posterior.task.places[:, 0]))
    return rows, len(posterior.task.places) // rows


def maps(posterior: Posterior) -> Array:
    """Layers over the places, shape (LAYERS, nx, ny), all about -1 to 1.

    The logarithm of the probability of a lump there, over that of chance; mean (about that of all places) and standard deviation
    of the field, in the logarithm; how long the way there takes [s]; the probability that there is a lump; the share of presses
    that is left.
    """
    mean, variance = posterior.field()
    left = 1.0 - len(posterior.presses) / posterior.task.budget.presses
    layers = np.empty((LAYERS, len(mean)))
    layers[0] = np.log(posterior.by_place * len(mean) + 0.01) / np.log(len(mean))
    layers[1], layers[2] = mean - mean.mean(), np.sqrt(variance)
    layers[3] = seconds(posterior.here, posterior.task.places) - PRESS_S
    layers[4], layers[5] = posterior.lump, left
    return layers.reshape(LAYERS, *shape(posterior))
