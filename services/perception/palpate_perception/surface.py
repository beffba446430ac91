"""Smooth surface through a noisy point cloud: a height field z(x, y) in A by penalised cubic splines.

    minimise  sum_i w_i (z_i - s(x_i, y_i))^2 + lambda E(s),   E = int s_xxx^2 + 3 s_xxy^2 + 3 s_xyy^2 + s_yyy^2

with s a tensor product of cubic B-splines (C^2), w_i = 1/sigma_i^2 and Tukey's biweight against stray points. E does
not see quadratics, so curvature is not smoothed away. On evenly spread data of density rho (sum of w per m^2) the fit
passes a wave of length L with gain 1 / (1 + lambda (2 pi / L)^6 / rho) (Eilers & Marx 1996; Wahba 1990), so lambda is
set by the length at which the gain is one half, which does not depend on noise or range.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse import coo_array, csr_array, kron

from palpate_models.numerics.frames import Array, Indices


class SurfaceTuning(NamedTuple):
    """Tuning of the surface fit."""

    cutoff_m: float = 0.03
    """Wavelength that passes with half its amplitude: longer waves are shape, shorter ones noise."""
    knots_per_cutoff: int = 4
    tukey: float = 4.685
    """Tukey's biweight for 95 % efficiency."""
    rounds: int = 3


TUNING: Final = SurfaceTuning()

DEGREE: Final = 3


class KnotAxis:
    """Cubic B-splines on one axis, with knots evenly spread over [low, high] [m]."""

    def __init__(self, low: float, high: float, spacing: float) -> None:
        self.low, self.high = low, high
        pieces = max(int(np.ceil((high - low) / spacing)), 1)
        self.step = (high - low) / pieces
        self.knots = low + self.step * np.arange(-DEGREE, pieces + DEGREE + 1)
        self.size = pieces + DEGREE
        self._splines = BSpline(self.knots, np.eye(self.size), DEGREE)

    def values(self, x: Array, derivative: int = 0) -> Array:
        """Return the basis functions (or a derivative) at `x` [m], shape (n, size)."""
        clipped = np.clip(x, self.low, self.high)
        return np.asarray(self._splines(clipped, nu=derivative), np.float64)

    def local(self, x: Array) -> tuple[Array, Indices]:
        """Return the DEGREE + 1 basis functions that are not zero at `x`, and their indices, shapes (n, DEGREE + 1)."""
        rows = BSpline.design_matrix(np.clip(x, self.low, self.high), self.knots, DEGREE)
        return rows.data.reshape(-1, DEGREE + 1), rows.indices.reshape(-1, DEGREE + 1).astype(np.intp)

    def gram(self, derivative: int) -> Array:
        """Return int b_i^(d) b_j^(d) dx, shape (size, size), exact by Gauss-Legendre quadrature."""
        node, weight = np.polynomial.legendre.leggauss(DEGREE + 1)
        left = self.knots[DEGREE : -DEGREE - 1]
        x = (left[:, np.newaxis] + self.step * (node + 1) / 2).ravel()
        b = self.values(x, derivative)
        return np.asarray(b.T @ (np.tile(weight * self.step / 2, len(left))[:, np.newaxis] * b))


class FittedSurface(NamedTuple):
    """Fitted surface z = s(x, y) in A with its covariance."""

    x: KnotAxis
    y: KnotAxis
    coefficients: Array
    """Shape (x.size, y.size)."""
    factor: Array
    """Cholesky factor of the normal matrix, lower band."""
    scale: float
    """Ratio of the residuals' standard deviation to the assumed one."""

    def height(self, x: Array, y: Array) -> Array:
        """Return z [m] at points, shapes (n,); outside the fitted rectangle the value at its nearest point."""
        return self._evaluate(x, y, 0, 0)

    def normal(self, x: Array, y: Array) -> Array:
        """Return outward (towards +z) unit normals in A, shape (n, 3)."""
        n = np.stack((-self._evaluate(x, y, 1, 0), -self._evaluate(x, y, 0, 1), np.ones(len(x))), axis=1)
        return np.asarray(n / np.linalg.norm(n, axis=1, keepdims=True))

    def sigma(self, x: Array, y: Array) -> Array:
        """Return the SD [m] of the height at points, shape (n,): the posterior of the smoothing spline (Wahba)."""
        rows = np.einsum("ni,nj->nij", self.x.values(x), self.y.values(y)).reshape(len(x), -1)
        return np.asarray(self.scale * np.sqrt(np.einsum("nm,mn->n", rows, cho_solve_banded((self.factor, True), rows.T))))

    def _evaluate(self, x: Array, y: Array, nu_x: int, nu_y: int) -> Array:
        return np.asarray(
            np.einsum("ni,ij,nj->n", self.x.values(x, nu_x), self.coefficients, self.y.values(y, nu_y), optimize=True)
        )


def fit(
    p: Array, sigma: Array, low: tuple[float, float], high: tuple[float, float], cutoff_m: float = TUNING.cutoff_m
) -> FittedSurface:
    """Fit a surface to points in A, shape (n, 3), with SD `sigma` [m], shape (n,), over the rectangle low to high.

    A wave of length `cutoff_m` passes with half its amplitude. Raises ValueError for fewer than ten points.
    """
    if len(p) < 10:
        raise ValueError(f"surface fit: {len(p)} points, at least 10 are needed")
    x, y = (KnotAxis(a, b, cutoff_m / TUNING.knots_per_cutoff) for a, b in zip(low, high, strict=True))
    rows = _rows(x, y, p)
    width = DEGREE * (y.size + 1)  # half band width of the normal matrix: neighbours in x are y.size apart
    weight = 1 / sigma**2
    area = (high[0] - low[0]) * (high[1] - low[1])
    penalty = _band(_energy(x, y), width) * (cutoff_m / (2 * np.pi)) ** 6 / area
    level = float(np.median(p[:, 2]))
    scale, robust = 1.0, np.ones(len(p))
    for _ in range(TUNING.rounds):
        w = weight * robust
        weighted = rows.multiply(w[:, np.newaxis]).tocsr()
        normal = _band(rows.T @ weighted, width) + w.sum() * penalty
        # A ridge of 1e-9 keeps the matrix definite in corners without data.
        normal[0] += 1e-9 * normal[0].mean()
        factor = cholesky_banded(normal, lower=True)
        c = cho_solve_banded((factor, True), weighted.T @ (p[:, 2] - level))
        residual = (p[:, 2] - level - rows @ c) / sigma
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-6)
        robust = np.clip(1 - (residual / (TUNING.tukey * max(scale, 1.0))) ** 2, 0, None) ** 2
    return FittedSurface(x, y, c.reshape(x.size, y.size) + level, factor, scale)  # B-splines sum to one


def _rows(x: KnotAxis, y: KnotAxis, p: Array) -> csr_array[Any]:
    """Return the tensor-product basis at the points, sparse, shape (n, x.size * y.size)."""
    (bx, ix), (by, iy) = x.local(p[:, 0]), y.local(p[:, 1])
    data = np.einsum("ni,nj->nij", bx, by).ravel()
    column = (ix[:, :, np.newaxis] * y.size + iy[:, np.newaxis, :]).ravel()
    start = np.arange(len(p) + 1) * (DEGREE + 1) ** 2
    return csr_array((data, column, start), shape=(len(p), x.size * y.size))


def _energy(x: KnotAxis, y: KnotAxis) -> Any:
    """Return the matrix of E, sparse, square of size x.size * y.size."""
    gx, gy = ([csr_array(axis.gram(d)) for d in range(4)] for axis in (x, y))
    return sum(k * kron(gx[3 - d], gy[d]) for d, k in enumerate((1.0, 3.0, 3.0, 1.0)))


def _band(matrix: Any, width: int) -> Array:
    """Return the lower band of a symmetric sparse matrix in LAPACK's format: entry (i, j) at [i - j, j], shape (width + 1, n)."""
    entries = coo_array(matrix)
    row, column = entries.coords
    lower = (row >= column) & (row - column <= width)  # entries outside the band are rounding errors
    band = np.zeros((width + 1, entries.shape[0]))
    np.add.at(band, (row[lower] - column[lower], column[lower]), entries.data[lower])
    return band
