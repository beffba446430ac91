"""A smooth belly that the suites show to perception and assessment: a paraboloid in the abdomen's frame."""

from __future__ import annotations

import numpy as np

from palpate_models.frames import Array

CURVATURE = 2.0
"""z = -CURVATURE (x^2 + y^2) [1/m]: a radius of a quarter metre at the top."""
REACH = 0.17
"""How far it goes from its axis [m]."""


def height(x: Array, y: Array) -> Array:
    """Z of the surface [m] in the abdomen's frame."""
    return np.asarray(-CURVATURE * (x**2 + y**2))


def normals(x: Array, y: Array) -> Array:
    """Outward unit normals, shape (n, 3)."""
    n = np.column_stack((2 * CURVATURE * x, 2 * CURVATURE * y, np.ones_like(x)))
    return np.asarray(n / np.linalg.norm(n, axis=1)[:, None])


def mesh(half: float, pitch: float) -> tuple[Array, Array, Array]:
    """Vertices and normals, shape (n, 3), and triangles, shape (m, 3), of a square patch in the abdomen's frame."""
    axis = np.arange(-half, half + 1e-9, pitch)
    x, y = (part.ravel() for part in np.meshgrid(axis, axis))
    index = np.arange(x.size).reshape(len(axis), len(axis))
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    triangles = np.vstack((np.column_stack((a, b, c)), np.column_stack((a, c, d))))
    return np.column_stack((x, y, height(x, y))), normals(x, y), triangles


def depth_image(K: Array, X_AC: Array, shape: tuple[int, int], floor: float) -> Array:
    """Depth [m] along the optical axis, shape `shape`, of the belly above a level floor at z = `floor` in the abdomen's frame.

    Takes intrinsics, shape (3, 3), and the optical frame's pose in the abdomen's, shape (4, 4). The quadratic of ray and
    paraboloid is solved in closed form.
    """
    v, u = np.indices(shape)
    rays = np.stack(((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(shape)), axis=-1) @ X_AC[:3, :3].T
    p = X_AC[:3, 3]
    a = CURVATURE * (rays[..., 0] ** 2 + rays[..., 1] ** 2)
    b = 2 * CURVATURE * (rays[..., 0] * p[0] + rays[..., 1] * p[1]) + rays[..., 2]
    c = CURVATURE * (p[0] ** 2 + p[1] ** 2) + p[2]
    root = b**2 - 4 * a * c
    with np.errstate(invalid="ignore", divide="ignore"):
        near = np.where(a > 1e-12, (-b - np.sqrt(np.maximum(root, 0))) / (2 * a), -c / b)
        near = np.where((root >= 0) & (near > 0), near, np.inf)
        x, y = p[0] + near * rays[..., 0], p[1] + near * rays[..., 1]
        near = np.where(np.hypot(x, y) < REACH, near, np.inf)
        ground = (floor - p[2]) / rays[..., 2]
    depth = np.minimum(near, np.where(ground > 0, ground, np.inf))
    return np.where(np.isfinite(depth), depth, np.nan)
