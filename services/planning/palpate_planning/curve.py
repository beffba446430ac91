"""Smooth curves through samples, with their tangents: natural cubic splines, quick to evaluate at one point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from palpate_models.compiled import compiled

Array = NDArray[np.float64]


class Curve:
    """y(s) in m dimensions through samples. scipy fits it; its own evaluation at one point takes ten times as long."""

    def __init__(self, s: Array, y: Array) -> None:
        """Samples y, shape (n, m), at increasing s, shape (n,); two at least."""
        spline = CubicSpline(s, y, bc_type="natural")
        self.knots: Array = spline.x
        """Shape (n,)."""
        self.cubics: Array = spline.c
        """Coefficients between the knots, highest power of s - knot first, shape (4, n - 1, m)."""
        self.tangents: Array = spline.derivative().c
        """The same of dy/ds, shape (3, n - 1, m)."""


@compiled
def polynomial_at(knots: Array, coefficients: Array, s: float, y: Array) -> None:
    """`y`, shape (m,), becomes the value at s of a piecewise polynomial with knots (n,) and coefficients (k, n - 1, m)."""
    i, last = 0, len(knots) - 2
    while i < last:  # bisection for the last knot that is not beyond s
        middle = (i + last + 1) // 2
        if knots[middle] <= s:
            i = middle
        else:
            last = middle - 1
    step = s - knots[i]
    power = 1.0
    y[:] = 0.0
    for k in range(coefficients.shape[0] - 1, -1, -1):
        for j in range(y.size):
            y[j] += coefficients[k, i, j] * power
        power *= step
