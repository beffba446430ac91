"""Cubic splines at one point, compiled: scipy's evaluation takes ten times as long there, nearly all of it preparation.

scipy fits the splines and evaluates them at many points; the values here are the same.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array

DEGREE = 3


class CubicPieces(NamedTuple):
    """A curve y(s) in m dimensions made of cubic polynomials, as scipy's `CubicSpline` holds it."""

    knots: Array
    """[s], shape (n,)."""
    coefficients: Array
    """Coefficients of (s - knot)^3, (s - knot)^2, s - knot and 1 between the knots, shape (4, n - 1, m)."""


class BicubicSpline(NamedTuple):
    """m values over a plane as a tensor product of cubic B-splines."""

    knots_x: Array
    """Shape (nx + 4,)."""
    knots_y: Array
    """Shape (ny + 4,)."""
    coefficients: Array
    """Shape (nx, ny, m)."""


@compiled
def cubic_at(curve: CubicPieces, s: float) -> tuple[Array, Array]:
    """Value y and derivative dy/ds at `s`, shapes (m,)."""
    knots, c = curve
    i = min(max(int(np.searchsorted(knots, s, side="right")) - 1, 0), len(knots) - 2)
    u = s - knots[i]
    value = ((c[0, i] * u + c[1, i]) * u + c[2, i]) * u + c[3, i]
    derivative = (3.0 * c[0, i] * u + 2.0 * c[1, i]) * u + c[2, i]
    return value, derivative


@compiled
def bicubic_at(field: BicubicSpline, x: float, y: float) -> Array:
    """Values at (x, y), shape (m,). Outside the knots those of the nearest edge hold."""
    i, weights_x = _basis(field.knots_x, x)
    j, weights_y = _basis(field.knots_y, y)
    nearby = field.coefficients[i : i + DEGREE + 1, j : j + DEGREE + 1].copy()
    return np.outer(weights_x, weights_y).ravel() @ nearby.reshape((DEGREE + 1) ** 2, -1)


@compiled
def _basis(knots: Array, x: float) -> tuple[int, Array]:
    """The B-splines that are not zero at x: index of the first, and their values, shape (4,). The recursion of de Boor."""
    x = min(max(x, knots[0]), knots[-1])
    i = min(max(int(np.searchsorted(knots, x, side="right")) - 1, DEGREE), len(knots) - DEGREE - 2)
    values = np.ones(1)
    for degree in range(1, DEGREE + 1):
        lower, upper = knots[i - degree + 1 : i + 1], knots[i + 1 : i + degree + 1]
        share = values / (upper - lower)
        values = np.zeros(degree + 1)
        values[:-1] += (upper - x) * share
        values[1:] += (x - lower) * share
    return i - DEGREE, values
