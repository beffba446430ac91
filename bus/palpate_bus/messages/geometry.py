"""Poses, twists and wrenches of messages as arrays, and back. Rotations are matrices here and unit quaternions in messages."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from palpate_bus.messages import Point, Pose, Quaternion, Transform, Twist, Vector3, Wrench

Array = NDArray[np.float64]


def quaternion(R: Array) -> tuple[float, float, float, float]:
    """Unit quaternion (x, y, z, w) with w >= 0 of a rotation matrix, shape (3, 3). Shepperd's method (1978)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R.tolist()
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
    norm = sqrt(x * x + y * y + z * z + w * w)
    if w < 0.0:
        norm = -norm
    return x / norm, y / norm, z / norm, w / norm


def rotation(orientation: Quaternion) -> Array:
    """Rotation matrix, shape (3, 3), of a `geometry_msgs/Quaternion`. Raises ValueError if its norm is off by 1 % or more."""
    x, y, z, w = orientation.x, orientation.y, orientation.z, orientation.w
    norm = sqrt(x * x + y * y + z * z + w * w)
    if not abs(norm - 1.0) < 0.01:  # so it is, too, where one is NaN
        raise ValueError(f"orientation = ({x}, {y}, {z}, {w}) has norm {norm}: must be 1")
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def pose_matrix(message: Pose) -> Array:
    """Homogeneous matrix, shape (4, 4), of a `geometry_msgs/Pose`. Raises ValueError as `rotation` does."""
    return _homogeneous(rotation(message.orientation), vector(message.position))


def transform_matrix(message: Transform) -> Array:
    """Homogeneous matrix, shape (4, 4), of a `geometry_msgs/Transform`. Raises ValueError as `rotation` does."""
    return _homogeneous(rotation(message.rotation), vector(message.translation))


def _homogeneous(R: Array, p: Array) -> Array:
    X = np.eye(4)
    X[:3, :3] = R
    X[:3, 3] = p
    return X


def pose_message(R: Array, p: Array) -> Pose:
    """`geometry_msgs/Pose` of a rotation matrix, shape (3, 3), and an origin [m], shape (3,)."""
    return Pose(Point(*p.tolist()), Quaternion(*quaternion(R)))


def transform_message(X: Array) -> Transform:
    """`geometry_msgs/Transform` of a homogeneous matrix, shape (4, 4)."""
    return Transform(Vector3(*X[:3, 3].tolist()), Quaternion(*quaternion(X[:3, :3])))


def twist_message(V: Array) -> Twist:
    """`geometry_msgs/Twist` of a twist, linear [m/s] then angular [rad/s], shape (6,)."""
    return Twist(Vector3(*V[:3].tolist()), Vector3(*V[3:].tolist()))


def wrench_message(F: Array) -> Wrench:
    """`geometry_msgs/Wrench` of a wrench, force [N] then torque [N m], shape (6,)."""
    return Wrench(Vector3(*F[:3].tolist()), Vector3(*F[3:].tolist()))


def vector(message: Point | Vector3) -> Array:
    """The x, y and z of a `geometry_msgs/Point` or `geometry_msgs/Vector3`, shape (3,)."""
    return np.array((message.x, message.y, message.z))


def twist(message: Twist) -> Array:
    """Linear [m/s] then angular [rad/s], shape (6,), of a `geometry_msgs/Twist`."""
    v, w = message.linear, message.angular
    return np.array((v.x, v.y, v.z, w.x, w.y, w.z))


def wrench(message: Wrench) -> Array:
    """Force [N] then torque [N m], shape (6,), of a `geometry_msgs/Wrench`."""
    f, m = message.force, message.torque
    return np.array((f.x, f.y, f.z, m.x, m.y, m.z))
