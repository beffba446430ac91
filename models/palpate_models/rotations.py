"""Quaternions of plain floats: for one at a time, which scipy's Rotation takes tens of times as long for."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, sin, sqrt

_SMALL_RAD = 1e-3
"""Below this angle the series to its fourth power is exact in double precision."""

Rows = Sequence[Sequence[float]]
"""A matrix, row by row, as numpy's `tolist` gives it."""


def quaternion_of(r: Sequence[float]) -> tuple[float, float, float, float]:
    """Unit quaternion (x, y, z, w) of a rotation vector [rad] no longer than pi, length 3; w >= 0."""
    square = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
    angle = sqrt(square)
    scale = sin(angle / 2.0) / angle if angle > _SMALL_RAD else 0.5 - square / 48.0 + square * square / 3840.0
    return scale * r[0], scale * r[1], scale * r[2], cos(angle / 2.0)


def quaternion(R: Rows) -> tuple[float, float, float, float]:
    """Unit quaternion (x, y, z, w) with w >= 0 of a rotation matrix, 3 rows of 3. Shepperd's method."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R
    trace = xx + yy + zz
    largest = max(xx, yy, zz, trace)
    if xx == largest:
        x, y, z, w = 1.0 - trace + 2.0 * xx, yx + xy, zx + xz, zy - yz
    elif yy == largest:
        x, y, z, w = xy + yx, 1.0 - trace + 2.0 * yy, zy + yz, xz - zx
    elif zz == largest:
        x, y, z, w = xz + zx, yz + zy, 1.0 - trace + 2.0 * zz, yx - xy
    else:
        x, y, z, w = zy - yz, xz - zx, yx - xy, 1.0 + trace
    length = sqrt(x * x + y * y + z * z + w * w)
    if w < 0.0:
        length = -length
    return x / length, y / length, z / length, w / length
