"""Quaternions of plain floats: for one at a time, which scipy's Rotation takes tens of times as long for."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

Rows = Sequence[Sequence[float]]
"""A matrix, row by row, as numpy's `tolist` gives it."""


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
