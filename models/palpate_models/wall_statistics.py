"""How the wall differs between people and between places, from the walls fitted to what was measured on living people."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from palpate_models.frames import Array
from palpate_models.remus2024 import fitted


@dataclass(frozen=True)
class WallStatistics:
    """Moments of a place's ln k_w [N/m^3], ln length [m] and stiffening [1/m], in this order.

    Some of the fitted places do not stiffen at all, so the stiffening has no logarithm.
    """

    mean: Array
    """Over people, shape (3,)."""
    between: Array
    """Covariance between people, of each one's mean over places, shape (3, 3)."""
    places: Array
    """Covariance between the places of one person, of k_w and stiffening at one and the same length, shape (2, 2)."""


@cache
def wall_statistics() -> WallStatistics:
    """The statistics of the measured places, `fitted.csv`."""
    walls = [fit.wall for fit in fitted().values()]
    values = np.array([(np.log(wall.k_w_n_per_m3), np.log(wall.length_m), wall.stiffening_per_m) for wall in walls])
    return moments(values, np.array([person for _, person in fitted()]))


def moments(values: Array, person: NDArray[np.str_]) -> WallStatistics:
    """Moments of `values` (n, 3), each a place of a `person` (n,), by the analysis of variance.

    The covariance of the means over a person's places holds a part of that between places, which is taken away. A person's wall
    has one length; what the other two vary by at that length is their covariance given the length.
    """
    people = [values[person == one] for one in np.unique(person)]
    means = np.array([rows.mean(axis=0) for rows in people])
    scatter = [(rows - mean).T @ (rows - mean) for rows, mean in zip(people, means, strict=True)]
    within = np.sum(scatter, axis=0) / (len(values) - len(people))
    repeats = float(np.mean([1 / len(rows) for rows in people]))
    variances, axes = np.linalg.eigh(np.cov(means.T) - repeats * within)
    between = (axes * np.maximum(variances, 0)) @ axes.T
    rest, length = [0, 2], 1
    places = within[np.ix_(rest, rest)] - np.outer(within[rest, length], within[rest, length]) / within[length, length]
    return WallStatistics(means.mean(axis=0), between, places)
