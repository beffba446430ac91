"""What is known of an abdomen's stiffness before it is touched: Gaussian fields of log k_w on the map grid.

A field is a sum of squared-exponential components, c(r) = sd^2 exp(-r^2 / (2 l^2)) in the xy plane, each optionally scaled by
an envelope over the nodes. On the regular grid a component is a Kronecker product, so its product with a matrix costs two
small ones.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate_assessment.grid import MapGrid

Array = NDArray[np.float64]


_NEGLIGIBLE = 1e-5
"""Modes of a component below this part of its greatest are left out: they hold less than 1e-3 of its variance."""


@dataclass(frozen=True)
class Component:
    """One squared-exponential part of a field."""

    sd: float
    """Standard deviation of log k_w [1]."""
    length: float
    """Correlation length l [m]; infinity makes it a constant."""


LEVEL = Component(0.7, float("inf"))
"""The patient's own level about the literature's: slim and strong walls differ by a factor of two either way."""
SHAPE = Component(0.2, 0.12)
"""Slow change over the trunk: stiffer towards costal margin and pelvis."""
BACKGROUND = Component(0.2, 0.05)
"""Natural variation (the literature's spread of wall moduli at rest is about 20 %)."""
HEALTHY = (LEVEL, SHAPE, BACKGROUND)
LESION = (Component(0.35, 0.010), Component(0.55, 0.022))
"""Variation that a healthy wall does not have: steep edges, and amplitudes of a factor of two to ten."""


class Field:
    """A Gaussian field of log k_w over the nodes of a grid.

    Fields add: `Field(grid, HEALTHY) + Field(grid, LESION, envelope)`.
    """

    def __init__(self, grid: MapGrid, components: tuple[Component, ...], envelope: Array | None = None) -> None:
        """`envelope`: factor on the standard deviation at each node, shape (ny * nx,)."""
        self._shape = grid.z.shape
        axes = [(c.sd, _modes(grid.y, c.length), _modes(grid.x, c.length)) for c in components]
        self._parts: list[tuple[Array | None, list[tuple[float, Array, Array]]]] = [(envelope, axes)]
        squared = np.ones(grid.z.size) if envelope is None else envelope**2
        self.variance: Array = sum(c.sd**2 for c in components) * squared

    def __add__(self, other: Field) -> Field:
        """The sum of two independent fields on the same grid."""
        both = copy(self)
        both._parts = self._parts + other._parts
        both.variance = self.variance + other.variance
        return both

    def times(self, rows: Array) -> Array:
        """Rows [m, n] times the covariance: rows @ K, shape (m, n)."""
        total = np.zeros((len(rows), *self._shape))
        for envelope, components in self._parts:
            scaled = (rows if envelope is None else rows * envelope).reshape(total.shape)
            product = total if envelope is None else np.zeros_like(total)
            for sd, along_y, along_x in components:
                within = sd**2 * (along_y.T @ (scaled @ along_x))
                product += along_y @ (within @ along_x.T)
            if envelope is not None:
                product *= envelope.reshape(self._shape)
                total += product
        return total.reshape(len(rows), -1)


def _modes(x: Array, length: float) -> Array:
    """Factor B of the squared exponential on an axis, B B' = exp(-r^2 / (2 length^2)), shape (n, modes): the modes that count."""
    values, vectors = np.linalg.eigh(np.exp(-0.5 * ((x[:, None] - x) / length) ** 2))
    keep = values > _NEGLIGIBLE * values[-1]
    return np.ascontiguousarray(vectors[:, keep] * np.sqrt(values[keep]))
