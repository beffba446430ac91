"""How the wall differs between people and between places, from the walls fitted to what was measured on living people."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import cache

import numpy as np

from palpate_models.frames import Array
from palpate_models.remus2024 import FOLDER

COLUMNS = ("k_w_n_per_m3", "length_m", "stiffening_per_m")
"""Of `fitted.csv`, in the order of every vector here."""


@dataclass(frozen=True)
class WallStatistics:
    """Moments of the natural logarithms of k_w [N/m^3], length [m] and stiffening [1/m]."""

    mean: Array
    """Over people, shape (3,)."""
    between: Array
    """Covariance between people, of each one's mean over places, shape (3, 3)."""
    places: Array
    """Covariance between the places of one person, of k_w and stiffening at one and the same length, shape (2, 2)."""


@cache
def wall_statistics() -> WallStatistics:
    """The statistics of the fitted places."""
    with (FOLDER / "fitted.csv").open(encoding="ascii", newline="") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    values = np.log([[float(row[name]) for name in COLUMNS] for row in rows])
    return moments(values, np.array([row["person"] for row in rows]))


def moments(values: Array, person: np.ndarray) -> WallStatistics:
    """Moments of `values` (n, 3), each a place of a `person` (n,), by the analysis of variance.

    The covariance of the means over a person's places holds a part of that between places, which is taken away. A person's wall has
    one length; what the other two vary by at that length is their covariance given the length.
    """
    people = [values[person == one] for one in np.unique(person)]
    means = np.array([rows.mean(axis=0) for rows in people])
    within = sum((len(rows) - 1) * np.cov(rows.T) for rows in people) / (len(values) - len(people))
    repeats = np.mean([1 / len(rows) for rows in people])
    between = np.cov(means.T) - repeats * within
    least, axes = np.linalg.eigh(between)
    between = axes @ np.diag(np.maximum(least, 0)) @ axes.T
    rest, length = [0, 2], 1
    places = within[np.ix_(rest, rest)] - np.outer(within[rest, length], within[rest, length]) / within[length, length]
    return WallStatistics(means.mean(axis=0), between, places)
