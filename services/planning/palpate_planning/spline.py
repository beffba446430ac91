"""Bicubic B-spline fields on a uniform grid, quick to evaluate at one point and at many."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import spline_filter

Array = NDArray[np.float64]

_BASIS: Final[Array] = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6.0
"""Uniform cubic B-spline: weights of four neighbours = (1, t, t^2, t^3) @ _BASIS."""
_OFFSETS: Final = np.arange(4)


class UniformField:
    """m fields over a plane, interpolated through grid values by bicubic B-splines (twice continuously differentiable)."""

    def __init__(self, origin: tuple[float, float], step: tuple[float, float], values: Array) -> None:
        """`values` has shape (nx, ny, m); value [i, j] stands at origin + (i, j) * step."""
        self._origin, self._step = origin, step
        coefficients = np.stack([spline_filter(values[..., k], order=3, mode="mirror") for k in range(values.shape[2])], axis=-1)
        self._c = np.pad(coefficients, ((1, 2), (1, 2), (0, 0)), mode="reflect")  # as 'mirror' continues them
        self._last = (values.shape[0] - 1.0, values.shape[1] - 1.0)

    def one(self, x: float, y: float) -> Array:
        """Values at one point, shape (m,). Outside the grid the nearest edge's hold."""
        u = min(max((x - self._origin[0]) / self._step[0], 0.0), self._last[0])
        v = min(max((y - self._origin[1]) / self._step[1], 0.0), self._last[1])
        i, j = int(u), int(v)
        u, v = u - i, v - j
        wu = np.array((1.0, u, u * u, u * u * u)) @ _BASIS
        wv = np.array((1.0, v, v * v, v * v * v)) @ _BASIS
        return np.asarray(np.einsum("a,b,abm->m", wu, wv, self._c[i : i + 4, j : j + 4]))

    def many(self, xy: Array) -> Array:
        """Values at points of shape (n, 2): shape (n, m)."""
        uv = np.clip((xy - self._origin) / self._step, 0.0, self._last)
        ij = uv.astype(int)
        t = uv - ij
        powers = np.stack((np.ones_like(t), t, t * t, t * t * t), axis=-1)
        w = powers @ _BASIS  # (n, 2, 4)
        rows = ij[:, 0, None, None] + _OFFSETS[None, :, None]
        columns = ij[:, 1, None, None] + _OFFSETS[None, None, :]
        return np.asarray(np.einsum("na,nb,nabm->nm", w[:, 0], w[:, 1], self._c[rows, columns]))
