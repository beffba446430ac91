"""Posterior as maps over the places: the input of the learned policy."""

from __future__ import annotations

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_search.posterior import Posterior
from palpate_search.presses import PRESS_S, seconds

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
    layers[3] = seconds(posterior.here, posterior.task.places) - PRESS_S
    layers[4], layers[5] = posterior.lump, left
    return layers.reshape(LAYERS, *shape(posterior))
