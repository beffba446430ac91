"""Surfaces for the suites: a smooth belly, which is a paraboloid in the abdomen frame, and a level square in world."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from palpate_bus.messages import Message, header
from palpate_bus.messages.geometry import mesh_message
from palpate_models.numerics.frames import Array

CURVATURE_PER_M = 2.0
"""z = -CURVATURE_PER_M (x^2 + y^2): radius of 0.25 m at the top."""
REACH_M = 0.17
"""Radius of the belly about its axis."""


def height(x: Array, y: Array) -> Array:
    """Return z of the surface [m] in the abdomen frame."""
    return np.asarray(-CURVATURE_PER_M * (x**2 + y**2))


def normals(x: Array, y: Array) -> Array:
    """Return outward unit normals, shape (n, 3)."""
    n = np.column_stack((2 * CURVATURE_PER_M * x, 2 * CURVATURE_PER_M * y, np.ones_like(x)))
    return np.asarray(n / np.linalg.norm(n, axis=1)[:, None])


def mesh(half: float, pitch: float) -> tuple[Array, Array, NDArray[np.uint32]]:
    """Return vertices and normals, shape (n, 3), and triangles, shape (m, 3), of a square patch in the abdomen frame."""
    x, y, triangles = grid(half, pitch)
    return np.column_stack((x, y, height(x, y))), normals(x, y), triangles


def grid(half: float, pitch: float) -> tuple[Array, Array, NDArray[np.uint32]]:
    """Return x and y of a square lattice about the origin, shapes (n,), and its triangles, shape (m, 3), counter-clockwise."""
    axis = np.arange(-half, half + 1e-9, pitch)
    x, y = (part.ravel() for part in np.meshgrid(axis, axis))
    index = np.arange(x.size, dtype=np.uint32).reshape(len(axis), len(axis))
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    return x, y, np.vstack((np.column_stack((a, b, c)), np.column_stack((a, c, d))))


def level(t: int, half: float, pitch: float, middle: Iterable[float]) -> Message:
    """Return the `palpation_msgs/SurfaceMesh` at `t` [ns] of a level square about `middle` in world [m]."""
    x, y, triangles = grid(half, pitch)
    vertices = np.column_stack((x, y, np.zeros_like(x))) + np.array(tuple(middle))
    return mesh_message(header(t, "world"), vertices, np.tile((0.0, 0.0, 1.0), x.size), triangles)


def depth_image(K: Array, X_AC: Array, shape: tuple[int, int], floor: float) -> Array:
    """Return the depth image [m] of the belly above a level floor.

    Args:
        K: intrinsics, shape (3, 3).
        X_AC: pose of the optical frame in the abdomen frame, shape (4, 4).
        shape: height and width of the image.
        floor: z of the floor in the abdomen frame [m].
    """
    v, u = np.indices(shape)
    rays = np.stack(((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(shape)), axis=-1) @ X_AC[:3, :3].T
    p = X_AC[:3, 3]
    a = CURVATURE_PER_M * (rays[..., 0] ** 2 + rays[..., 1] ** 2)
    b = 2 * CURVATURE_PER_M * (rays[..., 0] * p[0] + rays[..., 1] * p[1]) + rays[..., 2]
    c = CURVATURE_PER_M * (p[0] ** 2 + p[1] ** 2) + p[2]
    root = b**2 - 4 * a * c
    with np.errstate(invalid="ignore", divide="ignore"):
        near = np.where(a > 1e-12, (-b - np.sqrt(np.maximum(root, 0))) / (2 * a), -c / b)
        near = np.where((root >= 0) & (near > 0), near, np.inf)
        x, y = p[0] + near * rays[..., 0], p[1] + near * rays[..., 1]
        near = np.where(np.hypot(x, y) < REACH_M, near, np.inf)
        ground = (floor - p[2]) / rays[..., 2]
    depth = np.minimum(near, np.where(ground > 0, ground, np.inf))
    return np.where(np.isfinite(depth), depth, np.nan)
