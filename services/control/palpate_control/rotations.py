"""Rotation vectors, compiled: what pinocchio's exp3, log3 and Jlog3 compute, for use inside other compiled functions."""

from __future__ import annotations

from math import atan2, cos, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from palpate_models.compiled import compiled

Array = NDArray[np.float64]

_SMALL = 1e-4
"""Angle [rad] below which series to the second order are exact in double precision, or nearly (error 1e-18 relative)."""
_NEAR_HALF_TURN = -0.99
"""Cosine of the angle below which the axis is read off the symmetric part of R: the other one vanishes there."""


@compiled
def exp3(phi: Array, R: Array) -> None:
    """Rotation matrix (3, 3) of the rotation vector `phi` [rad], shape (3,) (Rodrigues)."""
    x, y, z = phi[0], phi[1], phi[2]
    square = x * x + y * y + z * z
    angle = sqrt(square)
    if angle < _SMALL:
        a, b = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        a, b = sin(angle) / angle, (1.0 - cos(angle)) / square
    R[0, 0], R[1, 1], R[2, 2] = 1.0 - b * (y * y + z * z), 1.0 - b * (x * x + z * z), 1.0 - b * (x * x + y * y)
    R[0, 1], R[1, 0] = b * x * y - a * z, b * x * y + a * z
    R[0, 2], R[2, 0] = b * x * z + a * y, b * x * z - a * y
    R[1, 2], R[2, 1] = b * y * z - a * x, b * y * z + a * x


@compiled
def log3(R: Array, phi: Array) -> float:
    """Rotation vector `phi` [rad], shape (3,), of a rotation matrix (3, 3), of length up to pi. Returns that length."""
    x, y, z = 0.5 * (R[2, 1] - R[1, 2]), 0.5 * (R[0, 2] - R[2, 0]), 0.5 * (R[1, 0] - R[0, 1])
    sine = sqrt(x * x + y * y + z * z)
    cosine = 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0)
    angle = atan2(sine, cosine)
    if cosine < _NEAR_HALF_TURN:
        best = 0
        for i in range(1, 3):
            if R[i, i] > R[best, best]:
                best = i
        # R + R' = 2 cos 1 + 2 (1 - cos) n n': the column of the largest n_i gives n but for its sign.
        length = 0.0
        for i in range(3):
            phi[i] = 0.5 * (R[i, best] + R[best, i])
            if i == best:
                phi[i] -= cosine
            length += phi[i] * phi[i]
        scale = angle / sqrt(length)
        if phi[0] * x + phi[1] * y + phi[2] * z < 0.0:
            scale = -scale
        for i in range(3):
            phi[i] *= scale
        return angle
    scale = 1.0 + angle * angle / 6.0 if angle < _SMALL else angle / sine
    phi[0], phi[1], phi[2] = scale * x, scale * y, scale * z
    return angle


@compiled
def jlog3_times(phi: Array, angle: float, w: Array) -> None:
    """`w` (3,) is multiplied in place by Jlog3: the inverse of the right Jacobian of exp3 at `phi`, of length `angle`.

    1 + [phi]/2 + c [phi]^2, c = 1 / angle^2 - (1 + cos) / (2 angle sin).
    """
    c = (
        1.0 / 12.0 + angle * angle / 720.0
        if angle < 1e-2
        else 1.0 / (angle * angle) - (1.0 + cos(angle)) / (2.0 * angle * sin(angle))
    )
    x, y, z = phi[0], phi[1], phi[2]
    ux, uy, uz = y * w[2] - z * w[1], z * w[0] - x * w[2], x * w[1] - y * w[0]
    vx, vy, vz = y * uz - z * uy, z * ux - x * uz, x * uy - y * ux
    w[0] += 0.5 * ux + c * vx
    w[1] += 0.5 * uy + c * vy
    w[2] += 0.5 * uz + c * vz
