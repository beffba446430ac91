"""What is known of an abdomen's stiffness before it is touched: Gaussian fields of log k_w on the map grid.

A field is a sum of squared-exponential components, c(r) = sd^2 exp(-r^2 / (2 l^2)) in the xy plane, each optionally scaled by
an envelope over the nodes. On the regular grid a component is a Kronecker product, so its product with a matrix costs two
small ones. So does that with its factor, and half of them: what samples J see of a field, J K J', is cheapest by J B, K = B B'.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from palpate_assessment.grid import MapGrid
from palpate_models.frames import Array

_NEGLIGIBLE = 1e-5
"""Modes of a component below this part of its greatest are left out: they hold less than 1e-3 of its variance."""
_BLOCK = 16
"""Rows that are multiplied at a time: what is between the axes' products stays in the cache."""


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
    """A Gaussian field of log k_w over the nodes of a grid, with covariance K.

    Fields add: `Field(grid, HEALTHY) + Field(grid, LESION, envelope)`. K = B B' with a factor B that has a column for each mode
    of each component.
    """

    def __init__(self, grid: MapGrid, components: tuple[Component, ...], envelope: Array | None = None) -> None:
        """`envelope`: factor on the standard deviation at each node, shape (ny * nx,)."""
        self._shape = grid.z.shape
        self._parts = [_Part(grid, components, envelope)]

    def __add__(self, other: Field) -> Field:
        """The sum of two independent fields on the same grid."""
        both = copy(self)
        both._parts = self._parts + other._parts
        return both

    def times(self, rows: Array) -> Array:
        """Rows [m, n] times the covariance: rows @ K, shape (m, n)."""
        return self.unfold(self.factor(rows))

    def factor(self, rows: Array) -> Array:
        """Rows [m, n] times the factor: G = rows @ B, shape (m, modes), so that rows @ K @ rows' = G G'.

        Rows that follow each other, like samples of a stroke, see few of the grid's lines: the others' zeros are left out.
        """
        ny, nx = self._shape
        factor = np.empty((len(rows), sum(part.modes for part in self._parts)))
        for first in range(0, len(rows), _BLOCK):
            block = rows[first : first + _BLOCK].reshape(-1, ny, nx)
            lines = np.flatnonzero(block.any(axis=(0, 2)))
            near = slice(lines.min(initial=ny), lines.max(initial=-1) + 1)
            begin = 0
            for part in self._parts:
                part.factor(block[:, near], near, factor[first : first + _BLOCK, begin : begin + part.modes])
                begin += part.modes
        return factor

    def unfold(self, factor: Array) -> Array:
        """G [m, modes] of `factor` times the factor again: G B' = rows @ K, shape (m, n)."""
        rows = np.zeros((len(factor), *self._shape))
        for first in range(0, len(rows), _BLOCK):
            begin = 0
            for part in self._parts:
                rows[first : first + _BLOCK] += part.unfold(factor[first : first + _BLOCK, begin : begin + part.modes])
                begin += part.modes
        return rows.reshape(len(factor), -1)


class _Part:
    """Components under one envelope: B = envelope * [By kron Bx of each component, side by side], never formed."""

    def __init__(self, grid: MapGrid, components: tuple[Component, ...], envelope: Array | None) -> None:
        ny, nx = grid.z.shape
        self._envelope = None if envelope is None else envelope.reshape(ny, nx)
        along_y = [c.sd * _modes(ny, grid.pitch, c.length) for c in components]
        self._along_x = [_modes(nx, grid.pitch, c.length) for c in components]
        self._along_y = np.hstack(along_y)
        """By of the components side by side, so that the larger product is one."""
        self._ky = [y.shape[1] for y in along_y]
        self.modes = sum(y.shape[1] * x.shape[1] for y, x in zip(along_y, self._along_x, strict=True))

    def factor(self, block: Array, lines: slice, modes: Array) -> None:
        """Writes block @ B, shape (m, modes), for a block of shape (m, len(lines), nx) of the grid's lines."""
        scaled = block if self._envelope is None else block * self._envelope[lines]
        within = self._along_y[lines].T @ scaled
        for along_x, share, mine in self._components(within, modes):
            np.matmul(share, along_x, out=mine)

    def unfold(self, modes: Array) -> Array:
        """Modes @ B', shape (m, ny, nx), for modes of shape (m, modes)."""
        within = np.empty((len(modes), self._along_y.shape[1], len(self._along_x[0])))
        for along_x, share, mine in self._components(within, modes):
            np.matmul(mine, along_x.T, out=share)
        block = self._along_y @ within
        return block if self._envelope is None else block * self._envelope

    def _components(self, within: Array, modes: Array) -> Iterator[tuple[Array, Array, Array]]:
        """Yields for each component Bx, and its share of `within` as (m, ky, nx) and of `modes` as (m, ky, kx)."""
        row = begin = 0
        for ky, along_x in zip(self._ky, self._along_x, strict=True):
            end = begin + ky * along_x.shape[1]
            yield along_x, within[:, row : row + ky], modes[:, begin:end].reshape(len(modes), ky, -1)
            row, begin = row + ky, end


@lru_cache(maxsize=64)
def _modes(count: int, pitch: float, length: float) -> Array:
    """Factor B of the squared exponential on a regular axis, B B' = exp(-r^2 / (2 length^2)): the modes that count.

    `count` nodes `pitch` [m] apart; shape (count, modes), read-only: the grids and fields of an examination share it.
    """
    x = pitch * np.arange(count)
    values, vectors = np.linalg.eigh(np.exp(-0.5 * ((x[:, None] - x) / length) ** 2))
    keep = values > _NEGLIGIBLE * values[-1]
    modes = np.ascontiguousarray(vectors[:, keep] * np.sqrt(values[keep]))
    modes.flags.writeable = False
    return modes
