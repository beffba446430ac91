"""The perceived rest surface as a smooth height field over the abdomen's xy plane.

A supine abdomen, seen from above, has one height a point (x, y) of frame A. Bicubic splines give height and slopes that
are smooth enough to regulate depth against: a mesh's facets would show as ripples in depth and orientation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from palpate_models.frames import apply, inverse
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

from palpate_planning.spline import UniformField

Array = NDArray[np.float64]

GRID_M = 0.004
"""Spacing of the grid on which the splines stand; finer than the perceived detail."""
STEEPEST = 10.0
"""Largest slope kept: past this (84 degrees) a height field says nothing."""


class Surface:
    """z = h(x, y) in frame A with outward normals. Points in and out are in world W unless named otherwise."""

    def __init__(self, X_WA: Array, field: UniformField) -> None:
        """`field` holds height [m], slope along x and slope along y."""
        self.X_WA = X_WA
        self.X_AW = inverse(X_WA)
        self._field = field
        self.offset = 0.0
        """Shift of the whole surface along its outward normals [m], from the onset of force."""

    @staticmethod
    def from_mesh(vertices_W: Array, normals_W: Array | None, X_WA: Array) -> Surface:
        """Fits the field to a mesh: vertices [m] shape (n, 3), outward unit normals of the same shape or None.

        Slopes come from the normals where they are given (perception smooths them), else from the heights. Outside the
        mesh the nearest vertex's height and slope hold. Raises ValueError for fewer than four vertices or no extent.
        """
        if len(vertices_W) < 4:
            raise ValueError(f"perceived surface has {len(vertices_W)} vertices, at least 4 are needed")
        p_A = apply(inverse(X_WA), np.asarray(vertices_W, dtype=float))
        xy = p_A[:, :2]
        low, high = xy.min(axis=0), xy.max(axis=0)
        if np.any(high - low < 4 * GRID_M):
            raise ValueError(f"perceived surface spans {high - low} m, at least {4 * GRID_M} m are needed each way")
        counts = [max(8, round(float(extent) / GRID_M) + 1) for extent in high - low]
        axes = [np.linspace(low[k], high[k], counts[k]) for k in (0, 1)]
        step = (float(axes[0][1] - axes[0][0]), float(axes[1][1] - axes[1][0]))
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        columns = [p_A[:, 2]]
        if normals_W is not None and len(normals_W):
            n_A = np.asarray(normals_W, dtype=float) @ X_WA[:3, :3]
            up = np.maximum(n_A[:, 2], 1.0 / STEEPEST)
            columns += [-n_A[:, 0] / up, -n_A[:, 1] / up]
        given = np.stack(columns, axis=1)
        values = np.asarray(LinearNDInterpolator(xy, given)(grid))
        outside = np.isnan(values[..., 0])
        if outside.any():
            values[outside] = NearestNDInterpolator(xy, given)(grid[outside])
        if len(columns) == 1:
            slopes = np.gradient(values[..., 0], *step)
            values = np.stack((values[..., 0], *slopes), axis=-1)
        return Surface(X_WA, UniformField((float(low[0]), float(low[1])), step, values))

    @staticmethod
    def plane(X_WA: Array) -> Surface:
        """The xy plane of A: what is assumed while nothing has been perceived."""
        return Surface(X_WA, UniformField((-1.0, -1.0), (0.25, 0.25), np.zeros((9, 9, 3))))

    def at(self, xy_A: Array) -> tuple[Array, Array]:
        """Surface points and outward unit normals over xy_A, shape (n, 2): two arrays in world, shape (n, 3)."""
        values = self._field.many(xy_A)
        p_A = np.column_stack((xy_A, values[:, 0]))
        n_A = np.column_stack((-values[:, 1], -values[:, 2], np.ones(len(values))))
        n_A /= np.linalg.norm(n_A, axis=1, keepdims=True)
        return apply(self.X_WA, p_A + self.offset * n_A), n_A @ self.X_WA[:3, :3].T

    def nearest(self, c_W: Array, iterations: int = 4) -> tuple[Array, Array, float]:
        """Foot of the perpendicular from c_W, shape (3,): surface point, outward normal (world), signed distance [m].

        Fixed point: slide the foot by the tangential part of what separates it from c. Converges at the rate of distance
        over radius of curvature, about 0.03 an iteration in contact. Far away (0.2 m and more) it is approximate.
        """
        c_A = self.X_AW[:3, :3] @ c_W + self.X_AW[:3, 3]
        x, y = float(c_A[0]), float(c_A[1])
        for k in range(iterations):
            h, slope_x, slope_y = self._field.one(x, y)
            n_A = np.array((-slope_x, -slope_y, 1.0)) / np.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
            foot = np.array((x, y, h))
            gap = c_A - foot
            distance = float(gap @ n_A)
            slide = gap - distance * n_A
            size = max(abs(float(slide[0])), abs(float(slide[1])))
            if size < 1e-6 or k == iterations - 1:
                break
            limit = min(1.0, 0.02 / size)
            x, y = x + limit * float(slide[0]), y + limit * float(slide[1])
        p_A = foot + self.offset * n_A
        return self.X_WA[:3, :3] @ p_A + self.X_WA[:3, 3], self.X_WA[:3, :3] @ n_A, distance - self.offset
