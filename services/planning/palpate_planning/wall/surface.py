"""The perceived surface as a height field of bicubic splines.

scipy fits the splines and evaluates them at many points. At one point scipy takes ten times as long, mostly for preparation, so
the single-point functions are compiled; the values are equal.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.interpolate import LinearNDInterpolator, NdBSpline, NearestNDInterpolator, make_interp_spline

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array, apply, inverse

DEGREE = 3


class CubicPieces(NamedTuple):
    """A piecewise cubic curve y(s) in m dimensions, in the format of scipy's `CubicSpline`."""

    knots: Array
    """Values of s, ascending, shape (n,)."""
    coefficients: Array
    """Coefficients of (s - knot)^3, (s - knot)^2, s - knot and 1 between the knots, shape (4, n - 1, m)."""


class BicubicSpline(NamedTuple):
    """A field of m values over a plane: tensor product of cubic B-splines."""

    knots_x: Array
    """Shape (nx + 4,)."""
    knots_y: Array
    """Shape (ny + 4,)."""
    coefficients: Array
    """Shape (nx, ny, m)."""


@compiled
def cubic_at(curve: CubicPieces, s: float) -> tuple[Array, Array]:
    """Return the value y and its derivative dy/ds at `s`, shapes (m,)."""
    knots, c = curve
    i = min(max(int(np.searchsorted(knots, s, side="right")) - 1, 0), len(knots) - 2)
    u = s - knots[i]
    value = ((c[0, i] * u + c[1, i]) * u + c[2, i]) * u + c[3, i]
    derivative = (3.0 * c[0, i] * u + 2.0 * c[1, i]) * u + c[2, i]
    return value, derivative


@compiled
def bicubic_at(field: BicubicSpline, x: float, y: float) -> Array:
    """Return the values at (x, y), shape (m,); outside the knots those of the nearest edge."""
    i, weights_x = _basis(field.knots_x, x)
    j, weights_y = _basis(field.knots_y, y)
    nearby = field.coefficients[i : i + DEGREE + 1, j : j + DEGREE + 1].copy()
    return np.outer(weights_x, weights_y).ravel() @ nearby.reshape((DEGREE + 1) ** 2, -1)


@compiled
def _basis(knots: Array, x: float) -> tuple[int, Array]:
    """Return the first B-spline that is nonzero at x and the four values, shape (4,), by de Boor's recursion."""
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


class FieldTuning(NamedTuple):
    """Settings of the height field and its compiled search."""

    grid_m: float = 0.004
    """Spacing of the spline grid; finer than the perceived detail."""
    steepest: float = 10.0
    """Maximum slope (84 degrees) that a height field represents."""
    iterations: int = 4
    """Maximum number of iterations in the search for the foot of a perpendicular."""
    converged_m: float = 1e-6
    stride_m: float = 0.02
    """Maximum motion of the foot in one iteration."""


FIELD = FieldTuning()


class BicubicField:
    """Height and slopes over a plane, interpolated by bicubic B-splines (twice continuously differentiable)."""

    def __init__(self, x: Array, y: Array, values: Array) -> None:
        """`values`: height [m] and slopes along x and y at grid lines x (nx,) and y (ny,) [m], shape (nx, ny, 3)."""
        along_x = make_interp_spline(x, values, k=3, bc_type="clamped", axis=0)
        along_xy = make_interp_spline(y, along_x.c, k=3, bc_type="clamped", axis=1)
        self.spline = BicubicSpline(along_x.t, along_xy.t, np.ascontiguousarray(along_xy.c.swapaxes(0, 1)))
        self._low, self._high = np.array((x[0], y[0])), np.array((x[-1], y[-1]))

    def __call__(self, xy: Array) -> Array:
        """Return height and slopes, shape (..., 3), at points of shape (..., 2); outside the grid those of the nearest edge."""
        knots_x, knots_y, coefficients = self.spline
        return np.asarray(NdBSpline((knots_x, knots_y), coefficients, 3)(np.clip(xy, self._low, self._high)))


class Foot(NamedTuple):
    """The foot of a perpendicular on the surface."""

    p_W: Array
    """[m], shape (3,)."""
    n_W: Array
    """Outward unit normal there, shape (3,)."""
    distance: float
    """Signed length of the perpendicular [m], positive outward."""
    xy_A: Array
    """Position in A's xy plane [m], shape (2,)."""


class PerceivedSurface:
    """The perceived surface z = h(x, y) in frame A with outward normals. Points are in W unless named otherwise."""

    def __init__(self, X_WA: Array, field: BicubicField, mode: BicubicField | None = None) -> None:
        """`mode`: see `breathing`; None for no motion."""
        self._X_WA = X_WA
        self._field, self._mode = field, mode

    @staticmethod
    def from_mesh(vertices_W: Array, normals_W: Array | None, X_WA: Array, breathing: Array | None = None) -> PerceivedSurface:
        """Fit the field to a mesh.

        Slopes come from the normals if given (perception smooths them), else from the heights. Outside the mesh the height and
        slope of the nearest vertex are used. Raises ValueError for fewer than four vertices or no extent.

        Args:
            vertices_W: vertices [m], shape (n, 3).
            normals_W: outward unit normals, shape (n, 3), or None.
            X_WA: pose of the abdomen frame, shape (4, 4).
            breathing: relative breathing displacement of each vertex, shape (n,), or None.
        """
        if len(vertices_W) < 4:
            raise ValueError(f"perceived surface has {len(vertices_W)} vertices, at least 4 are needed")
        p_A = apply(inverse(X_WA), np.asarray(vertices_W, dtype=float))
        xy = p_A[:, :2]
        low, high = xy.min(axis=0), xy.max(axis=0)
        if np.any(high - low < 4 * FIELD.grid_m):
            raise ValueError(f"perceived surface spans {high - low} m, at least {4 * FIELD.grid_m} m are needed each way")
        counts = [max(8, round(float(extent) / FIELD.grid_m) + 1) for extent in high - low]
        axes = [np.linspace(low[k], high[k], counts[k]) for k in (0, 1)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        columns = [p_A[:, 2]]
        if normals_W is not None and len(normals_W):
            n_A = np.asarray(normals_W, dtype=float) @ X_WA[:3, :3]
            up = np.maximum(n_A[:, 2], 1.0 / FIELD.steepest)
            columns += [-n_A[:, 0] / up, -n_A[:, 1] / up]
        heights = len(columns)
        if breathing is not None and len(breathing):
            columns.append(breathing)
        given = np.stack(columns, axis=1)
        values = np.asarray(LinearNDInterpolator(xy, given)(grid))
        outside = np.isnan(values[..., 0])
        if outside.any():
            values[outside] = NearestNDInterpolator(xy, given)(grid[outside])
        mode = BicubicField(axes[0], axes[1], values[..., heights:]) if heights < len(columns) else None
        values = values[..., :heights]
        if heights == 1:
            slopes = np.gradient(values[..., 0], *axes)
            values = np.stack((values[..., 0], *slopes), axis=-1)
        return PerceivedSurface(X_WA, BicubicField(axes[0], axes[1], values), mode)

    @staticmethod
    def plane(X_WA: Array) -> PerceivedSurface:
        """Return the xy plane of A, used before the first perceived surface."""
        line = np.linspace(-1.0, 1.0, 9)
        return PerceivedSurface(X_WA, BicubicField(line, line, np.zeros((9, 9, 3))))

    def away_from(self, p_W: Array) -> float:
        """Return the median vertical distance [m] to points of another surface, shape (n, 3)."""
        p_A = apply(inverse(self._X_WA), p_W)
        return float(np.median(np.abs(self._field(p_A[:, :2])[:, 0] - p_A[:, 2])))

    def at(self, xy_A: Array) -> tuple[Array, Array]:
        """Return surface points [m] and outward unit normals in world at xy_A [m], shape (n, 2): two arrays, shape (n, 3)."""
        p_A, n_A = self.in_A(xy_A)
        return apply(self._X_WA, p_A), n_A @ self._X_WA[:3, :3].T

    def in_A(self, xy_A: Array) -> tuple[Array, Array]:
        """Return points [m] and outward unit normals in A at xy_A [m], shape (n, 2): two arrays, shape (n, 3)."""
        values = self._field(xy_A)
        n_A = np.column_stack((-values[:, 1], -values[:, 2], np.ones(len(values))))
        return np.column_stack((xy_A, values[:, 0])), n_A / np.linalg.norm(n_A, axis=1, keepdims=True)

    def xy(self, p_W: Array) -> Array:
        """Return the position in A's xy plane [m], shape (2,), of a point of the surface, shape (3,)."""
        return np.asarray(((p_W - self._X_WA[:3, 3]) @ self._X_WA[:3, :3])[:2])

    def breathing(self, xy_A: Array) -> float:
        """Return the breathing displacement at xy_A [m], shape (2,), relative to that of the point that moves most [1]."""
        return 0.0 if self._mode is None else float(bicubic_at(self._mode.spline, xy_A[0], xy_A[1])[0])

    def nearest(self, c_W: Array) -> Foot:
        """Return the foot of the perpendicular from the point c_W [m], shape (3,), usually the centre of the indenter.

        Fixed-point iteration: move the foot by the tangential part of the gap to c. The error shrinks by the ratio of distance to
        radius of curvature, about 0.03 per iteration in contact. The result is approximate far away (0.2 m and more).
        """
        return Foot(*foot(self._field.spline, self._X_WA, np.ascontiguousarray(c_W)))


@compiled
def foot(field: BicubicSpline, X_WA: Array, c_W: Array) -> tuple[Array, Array, float, Array]:
    """Return the fields of `Foot` for `PerceivedSurface.nearest`, from the surface's spline and pose."""
    R_WA, p_WA = X_WA[:3, :3].copy(), X_WA[:3, 3]
    c_A = (c_W - p_WA) @ R_WA
    xy_A = c_A[:2]
    p_A, n_A, distance = c_A, c_A, 0.0
    for _ in range(FIELD.iterations):
        height, slope_x, slope_y = bicubic_at(field, xy_A[0], xy_A[1])
        p_A = np.array((xy_A[0], xy_A[1], height))
        n_A = np.array((-slope_x, -slope_y, 1.0)) / np.sqrt(1.0 + slope_x**2 + slope_y**2)
        gap = c_A - p_A
        distance = gap @ n_A
        slide = (gap - distance * n_A)[:2]
        size = np.abs(slide).max()
        if size < FIELD.converged_m:
            break
        xy_A = xy_A + min(1.0, FIELD.stride_m / size) * slide
    return R_WA @ p_A + p_WA, R_WA @ n_A, distance, p_A[:2]
