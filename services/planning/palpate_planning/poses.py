"""From a point and its normal to the pose of the indenter.

The indenter's z axis is opposite to the outward normal. The sphere's centre is at p + n (R - depth), so that its deepest
point lies `depth` below the surface point p along the inward normal. Spin about z is free: the sphere is round.
"""

from __future__ import annotations

from math import atan2, sqrt

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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


def frame(x_near: Array, z: Array) -> Array:
    """The rotation, shape (3, 3), with unit z as its z axis and its x axis as near to x_near as it can be."""
    x = x_near - z * float(z @ x_near)
    x = x / np.sqrt(x @ x)
    R = np.empty((3, 3))
    R[:, 0], R[:, 1], R[:, 2] = x, cross(z, x), z
    return R


def cross(a: Array, b: Array) -> Array:
    """Cross product of two 3-vectors; a tenth of numpy.cross's time."""
    return np.array((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))


def pose(R: Array, p: Array) -> Array:
    """Homogeneous matrix, shape (4, 4)."""
    X = np.eye(4)
    X[:3, :3] = R
    X[:3, 3] = p
    return X


def quaternion(R: Array) -> Array:
    """Unit quaternion (x, y, z, w) with w >= 0 of a rotation matrix, shape (4,). Shepperd's method."""
    trace = float(R[0, 0] + R[1, 1] + R[2, 2])
    i = int(np.argmax((R[0, 0], R[1, 1], R[2, 2], trace)))
    q = np.empty(4)
    if i == 3:
        q[:] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 1.0 + trace
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q[i] = 1.0 - trace + 2.0 * R[i, i]
        q[j] = R[j, i] + R[i, j]
        q[k] = R[k, i] + R[i, k]
        q[3] = R[k, j] - R[j, k]
    q /= np.linalg.norm(q)
    return -q if q[3] < 0 else q


def angular_velocity(R0: Array, R1: Array, dt: float) -> Array:
    """w_W [rad/s] that turns R0 into R1 in dt [s], shape (3,)."""
    D = R1 @ R0.T
    v = 0.5 * np.array([D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]])
    s = sqrt(float(v @ v))
    angle = atan2(s, 0.5 * (float(D[0, 0] + D[1, 1] + D[2, 2]) - 1.0))
    return np.asarray(v * ((angle / s if s > 1e-9 else 1.0) / dt))
