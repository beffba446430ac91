"""The perceived rest surface as a smooth height field over the abdomen's xy plane.

A supine abdomen, seen from above, has one height a point (x, y) of frame A. Bicubic splines give height and slopes that
are smooth enough to regulate depth against: a mesh's facets would show as ripples in depth and orientation.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

from palpate_models.compiled import compiled
from palpate_models.frames import apply, inverse
from palpate_planning.spline import UniformField, value_at

Array = NDArray[np.float64]

GRID_M = 0.004
"""Spacing of the grid on which the splines stand; finer than the perceived detail."""
ITERATIONS = 4
"""At most so many are made to find the foot of a perpendicular."""
STEEPEST = 10.0
"""Largest slope kept: past this (84 degrees) a height field says nothing."""


class Surface:
    """z = h(x, y) in frame A with outward normals. Points in and out are in world W unless named otherwise."""

    def __init__(self, X_WA: Array, field: UniformField) -> None:
        """`field` holds height [m], slope along x and slope along y."""
        self.X_WA = X_WA
        X_AW = inverse(X_WA)
        self.frames: Array = np.concatenate([part.ravel() for X in (X_WA, X_AW) for part in (X[:3, :3], X[:3, 3])])
        """R_WA row by row, p_WA, R_AW and p_AW, shape (24,), as `foot` takes them."""
        self.field = field
        self.offset = 0.0
        """Shift of the whole surface along its outward normals [m], from the onset of force."""

    @staticmethod
    def from_mesh(vertices_W: Array, normals_W: Array | None, X_WA: Array) -> Surface:
        """Fits the field to a mesh: vertices [m] shape (n, 3), outward unit normals of the same shape or None.

        Slopes come from the normals where they are given (perception smooths them), else from the heights. Outside the
        mesh the nearest vertex's height and slope hold. Raises ValueError for fewer than four vertices, no extent, or what is not
        finite.
        """
        if len(vertices_W) < 4:
            raise ValueError(f"perceived surface has {len(vertices_W)} vertices, at least 4 are needed")
        if not (np.isfinite(vertices_W).all() and (normals_W is None or np.isfinite(normals_W).all())):
            raise ValueError("perceived surface has vertices or normals that are not finite")
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
        values = self.field.many(xy_A)
        p_A = np.column_stack((xy_A, values[:, 0]))
        n_A = np.column_stack((-values[:, 1], -values[:, 2], np.ones(len(values))))
        n_A /= np.linalg.norm(n_A, axis=1, keepdims=True)
        return apply(self.X_WA, p_A + self.offset * n_A), n_A @ self.X_WA[:3, :3].T

    def nearest(self, c_W: Array) -> tuple[Array, Array, float]:
        """Foot of the perpendicular from c_W, shape (3,): surface point, outward normal (world), signed distance [m].

        Fixed point: slide the foot by the tangential part of what separates it from c. Converges at the rate of distance
        over radius of curvature, about 0.03 an iteration in contact. Far away (0.2 m and more) it is approximate.
        """
        field, p_W, n_W = self.field, np.empty(3), np.empty(3)
        c_W = np.ascontiguousarray(c_W)
        return p_W, n_W, foot(self.frames, field.axes, field.coefficients, self.offset, c_W, p_W, n_W)


@compiled
def foot(frames: Array, axes: Array, coefficients: Array, offset: float, c_W: Array, p_W: Array, n_W: Array) -> float:
    """`Surface.nearest` from its parts: p_W [m] and n_W, shape (3,), become point and normal; returns the signed distance [m]."""
    R_WA, p_WA, R_AW, p_AW = frames[:9].reshape(3, 3), frames[9:12], frames[12:21].reshape(3, 3), frames[21:]
    c = R_AW @ c_W + p_AW
    x, y = c[0], c[1]
    below, normal = np.empty(3), np.empty(3)
    distance = 0.0
    for k in range(ITERATIONS):
        h, slope_x, slope_y = value_at(axes, coefficients, x, y)
        below[0], below[1], below[2] = x, y, h
        length = sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
        normal[0], normal[1], normal[2] = -slope_x / length, -slope_y / length, 1.0 / length
        gap = c - below
        distance = float(gap @ normal)
        slide = gap - distance * normal
        size = max(abs(slide[0]), abs(slide[1]))
        if size < 1e-6 or k == ITERATIONS - 1:
            break
        limit = min(1.0, 0.02 / size)
        x, y = x + limit * slide[0], y + limit * slide[1]
    p, n = R_WA @ (below + offset * normal), R_WA @ normal
    for i in range(3):
        p_W[i], n_W[i] = p[i] + p_WA[i], n[i]
    return distance - offset
