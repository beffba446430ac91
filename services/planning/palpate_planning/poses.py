"""From a point and its normal to the pose of the indenter.

The indenter's z axis is opposite to the outward normal. The sphere's centre is at p + n (R - depth), so that its deepest
point lies `depth` below the surface point p along the inward normal. Spin about z is free: the sphere is round.
"""

from __future__ import annotations

import numpy as np

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array


def centre(p_W: Array, n_W: Array, radius: float, depth: float | Array) -> Array:
    """Centre of the sphere [m] at `depth` [m] below surface points p_W with outward unit normals n_W, shape (..., 3)."""
    return np.asarray(p_W + n_W * (radius - np.asarray(depth)[..., None]))


def least_twist(z_W: Array, R_ref: Array) -> Array:
    """Rotations, shape (..., 3, 3), whose z axes are unit z_W, shape (..., 3), reached from R_ref by the shortest turn.

    Each turns R_ref about z_ref x z by the angle between them: no spin about z. A function of z alone, it is smooth along
    any path and comes back to itself round a loop. Opposite to z_ref it is not defined; there it turns about R_ref's x.
    """
    z = z_W / np.linalg.norm(z_W, axis=-1, keepdims=True)
    x_ref, _, z_ref = R_ref.T
    c = z @ z_ref
    flipped = c < -1.0 + 1e-9
    along = (z + z_ref) / np.where(flipped, 1.0, 1.0 + c)[..., None]  # v turned: v - along (z.v), for v across z_ref
    x = np.where(flipped[..., None], x_ref, x_ref - along * (z @ x_ref)[..., None])
    x = x - z * np.sum(x * z, axis=-1, keepdims=True)  # near the opposite 1 + c has lost digits: across z all the same
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack((x, np.cross(z, x), z), axis=-1)


@compiled
def frame(z: Array, x_near: Array) -> Array:
    """The rotation, shape (3, 3), with unit z as its z axis and its x axis as near to x_near as it can be."""
    x = x_near - z * (z @ x_near)
    x = x / np.sqrt(x @ x)
    return np.column_stack((x, np.cross(z, x), z))


def pose(R: Array, p: Array) -> Array:
    """Homogeneous matrix, shape (4, 4)."""
    X = np.eye(4)
    X[:3, :3] = R
    X[:3, 3] = p
    return X


@compiled
def angular_velocity(R0: Array, R1: Array, dt: float) -> Array:
    """w_W [rad/s] that turns R0 into R1 in dt [s], shape (3,), for turns of less than 90 degrees."""
    turn = R1 @ R0.T
    axis_by_sine = 0.5 * np.array((turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]))
    sine = np.sqrt(axis_by_sine @ axis_by_sine)
    return axis_by_sine * (np.arcsin(sine) / (sine * dt) if sine > 0.0 else 1.0 / dt)
