"""Bicubic B-spline fields on a uniform grid, quick to evaluate at one point and at many."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import spline_filter

from palpate_models.compiled import compiled

Array = NDArray[np.float64]

_BASIS: Final[Array] = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6.0
"""Uniform cubic B-spline: weights of four neighbours = (1, t, t^2, t^3) @ _BASIS."""
_OFFSETS: Final = np.arange(4)


class UniformField:
    """m fields over a plane, interpolated through grid values by bicubic B-splines (twice continuously differentiable)."""

    def __init__(self, origin: tuple[float, float], step: tuple[float, float], values: Array) -> None:
        """`values` has shape (nx, ny, m); value [i, j] stands at origin + (i, j) * step."""
        self.axes: Array = np.array([(origin[k], step[k], values.shape[k] - 1.0) for k in (0, 1)])
        """Origin, step and last index of the grid along x and along y, shape (2, 3)."""
        coefficients = np.stack([spline_filter(values[..., k], order=3, mode="mirror") for k in range(values.shape[2])], axis=-1)
        self.coefficients: Array = np.pad(coefficients, ((1, 2), (1, 2), (0, 0)), mode="reflect")  # as 'mirror' continues them
        """Of the B-splines, shape (nx + 3, ny + 3, m): those of cell [i, j] are [i : i + 4, j : j + 4]."""

    def many(self, xy: Array) -> Array:
        """Values at points of shape (n, 2): shape (n, m)."""
        origin, step, last = self.axes.T
        uv = np.clip((xy - origin) / step, 0.0, last)
        ij = uv.astype(int)
        t = uv - ij
        powers = np.stack((np.ones_like(t), t, t * t, t * t * t), axis=-1)
        w = powers @ _BASIS  # (n, 2, 4)
        rows = ij[:, 0, None, None] + _OFFSETS[None, :, None]
        columns = ij[:, 1, None, None] + _OFFSETS[None, None, :]
        return np.asarray(np.einsum("na,nb,nabm->nm", w[:, 0], w[:, 1], self.coefficients[rows, columns]))


@compiled
def value_at(axes: Array, coefficients: Array, x: float, y: float) -> Array:
    """Values at one point of the field with these `axes` and `coefficients`, shape (m,). Outside, the nearest edge's hold."""
    u, v = _place(axes[0], x), _place(axes[1], y)
    i, j = int(u), int(v)
    wu, wv = _weights(u - i), _weights(v - j)
    total = np.zeros(coefficients.shape[2])
    for a in range(4):
        for b in range(4):
            weight = wu[a] * wv[b]
            for k in range(total.size):
                total[k] += weight * coefficients[i + a, j + b, k]
    return total


@compiled
def _place(axis: Array, x: float) -> float:
    """Where x is along an axis, in steps from its origin, on the grid; at its origin where x is NaN: it makes an index."""
    u = (x - axis[0]) / axis[1]
    return min(u, axis[2]) if u > 0.0 else 0.0


@compiled
def _weights(t: float) -> Array:
    """Of four neighbours at the part `t` of the way from the second to the third, shape (4,)."""
    return np.array((1.0, t, t * t, t * t * t)) @ _BASIS
