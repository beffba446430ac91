"""The map's mesh: a regular grid over the examined region in the xy plane of A, lifted to the perceived surface."""

from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyvander
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator

from palpate_models.numerics.frames import Array

_DEGREE = 4
"""Degree of the polynomial that stands for the abdomen's shape: slopes are those of the trunk, not of the noise."""
_POWER_X, _POWER_Y = np.array([(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]).T
"""Exponents of its terms."""


class MapGrid(NamedTuple):
    """A regular grid of nodes on the perceived surface, row by row: node j * nx + i is at (x[i], y[j])."""

    x: Array
    """[m], shape (nx,), in A."""
    y: Array
    """[m], shape (ny,), in A."""
    z: Array
    """Height of the perceived surface [m], shape (ny, nx)."""
    area: Array
    """Area of the surface that belongs to each node [m^2], shape (ny * nx,)."""

    @property
    def pitch(self) -> float:
        """Distance of neighbouring nodes in the xy plane [m]."""
        return float(self.x[1] - self.x[0])

    @property
    def nodes(self) -> Array:
        """Positions [m], shape (ny * nx, 3), in A."""
        xx, yy = np.meshgrid(self.x, self.y)
        return np.column_stack((xx.ravel(), yy.ravel(), self.z.ravel()))

    @property
    def triangles(self) -> NDArray[np.uint32]:
        """Two triangles a cell, shape (m, 3), counter-clockwise seen from outside."""
        nx, ny = len(self.x), len(self.y)
        corner = (np.arange(ny - 1)[:, None] * nx + np.arange(nx - 1)).ravel()
        lower = np.column_stack((corner, corner + 1, corner + nx + 1))
        upper = np.column_stack((corner, corner + nx + 1, corner + nx))
        return np.concatenate((lower, upper)).astype(np.uint32)


def _terms(x: Array, y: Array) -> Array:
    return np.asarray(polyvander(x / 0.1, _DEGREE)[..., _POWER_X] * polyvander(y / 0.1, _DEGREE)[..., _POWER_Y])


def map_grid(surface: Array, centre: tuple[float, float], size: tuple[float, float], margin: float, pitch: float) -> MapGrid:
    """Return the grid over a region of `size` [m] about `centre` [m], widened by `margin` [m], on a perceived surface.

    `surface`: vertices [m], shape (n, 3), in A. Where none is near, the smooth shape through all of them stands in.
    Raises ValueError when fewer than 30 vertices lie in the region.
    """
    half = 0.5 * np.asarray(size) + margin
    near = surface[np.all(np.abs(surface[:, :2] - centre) <= half + 0.03, axis=1)]
    near = near[np.isfinite(near).all(axis=1)]
    if len(near) < 30:
        raise ValueError(f"perceived surface: {len(near)} vertices in the examined region, expected at least 30")
    shape = np.linalg.lstsq(_terms(near[:, 0], near[:, 1]), near[:, 2], rcond=None)[0]
    count = np.maximum(np.round(2 * half / pitch).astype(int) + 1, 3)
    x = centre[0] + (np.arange(count[0]) - 0.5 * (count[0] - 1)) * pitch
    y = centre[1] + (np.arange(count[1]) - 0.5 * (count[1] - 1)) * pitch
    xx, yy = np.meshgrid(x, y)
    smooth = _terms(xx, yy) @ shape
    rest = near[:, 2] - _terms(near[:, 0], near[:, 1]) @ shape
    z = smooth + LinearNDInterpolator(near[:, :2], rest, fill_value=0.0)(xx, yy)
    zy, zx = np.gradient(smooth, pitch)
    area = pitch**2 * np.sqrt(1 + zx**2 + zy**2)
    return MapGrid(x, y, z, area.ravel())
