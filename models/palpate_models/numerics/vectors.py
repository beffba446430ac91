"""Compiled functions of 3-vectors as tuples, which stay in registers where small arrays would be allocated."""

from math import sqrt

import numpy as np

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array

Vector = tuple[float, float, float]


@compiled
def row(table: Array, k: int, first: int = 0) -> Vector:
    """Return three numbers of row `k` of an array, from column `first`."""
    return table[k, first], table[k, first + 1], table[k, first + 2]


@compiled
def add(a: Vector, b: Vector) -> Vector:
    """Return a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@compiled
def subtract(a: Vector, b: Vector) -> Vector:
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compiled
def scale(factor: float, a: Vector) -> Vector:
    """`factor` times a."""
    return factor * a[0], factor * a[1], factor * a[2]


@compiled
def divide(a: Vector, divisor: float) -> Vector:
    """Return a / `divisor`."""
    return a[0] / divisor, a[1] / divisor, a[2] / divisor


@compiled
def dot(a: Vector, b: Vector) -> float:
    """Return the scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def cross(a: Vector, b: Vector) -> Vector:
    """Return the vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def norm(a: Vector) -> float:
    """Return the length."""
    return sqrt(dot(a, a))


@compiled
def velocity_at(v: Vector, w: Vector, r: Vector) -> Vector:
    """V + w x r: velocity of the point of a rigid body at `r` [m] from where it moves at `v` [m/s] and turns at `w` [rad/s]."""
    return v[0] + w[1] * r[2] - w[2] * r[1], v[1] + w[2] * r[0] - w[0] * r[2], v[2] + w[0] * r[1] - w[1] * r[0]


@compiled
def nearest_vertex(p: Array, vertices: Array) -> tuple[float, int]:
    """Return distance [m] and index of the vertex, shape (n, 3), nearest to `p`, shape (3,); the first of equals.

    Linear search: for one point and some thousand vertices five times as fast as a call of scipy's tree.
    """
    nearest, best = np.inf, 0
    x, y, z = p[0], p[1], p[2]
    for i in range(vertices.shape[0]):
        dx, dy, dz = vertices[i, 0] - x, vertices[i, 1] - y, vertices[i, 2] - z
        square = dx * dx + dy * dy + dz * dz
        if square < nearest:
            nearest, best = square, i
    return sqrt(nearest), best
