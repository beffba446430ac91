"""Rigid transforms as 4 x 4 homogeneous matrices, in monogram notation."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from palpate_models.section import Pose

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]
Ints = NDArray[np.int64]
Array32 = NDArray[np.float32]
Ints32 = NDArray[np.int32]
Unsigned = NDArray[np.uint32]


def frozen(values: ArrayLike) -> Array:
    """Return an array of the values that is never written to."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def rigid(R: ArrayLike, p: ArrayLike) -> Array:
    """Return the homogeneous matrix, shape (4, 4), of a rotation, shape (3, 3), and a translation, shape (3,)."""
    X = np.eye(4)
    X[:3, :3] = R
    X[:3, 3] = p
    return X


def matrix(pose: Pose) -> Array:
    """Return the homogeneous matrix, shape (4, 4), of a scenario pose (fixed-axis roll, pitch, yaw)."""
    return rigid(Rotation.from_euler("xyz", pose.rpy_rad).as_matrix(), pose.xyz_m)


def pose_of(X: Array) -> Pose:
    """Return the scenario pose of a homogeneous matrix, shape (4, 4): the inverse of `matrix`."""
    roll, pitch, yaw = Rotation.from_matrix(X[:3, :3]).as_euler("xyz")
    x, y, z = X[:3, 3]
    return Pose(xyz_m=(float(x), float(y), float(z)), rpy_rad=(float(roll), float(pitch), float(yaw)))


def inverse(X_AB: Array) -> Array:
    """Return X_BA, shape (4, 4)."""
    return rigid(X_AB[:3, :3].T, -X_AB[:3, :3].T @ X_AB[:3, 3])


def apply(X_AB: Array, p_B: Array) -> Array:
    """Return points of B, shape (n, 3), expressed in A."""
    return np.asarray(p_B @ X_AB[:3, :3].T + X_AB[:3, 3])


def path_length(points: Array, least: float = 0.0) -> Array:
    """Return the length of a path up to each of its points, shape (n,); a step counts as at least `least`."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate(([0.0], np.cumsum(np.maximum(steps, least))))


def look_at(position: Array, target: Array) -> Array:
    """Return the pose of an optical frame (z forward, x right, y down) looking from `position` at `target`, shape (4, 4)."""
    z = target - position
    z = z / np.linalg.norm(z)
    x = np.cross(z, (0.0, 0.0, 1.0))
    if np.linalg.norm(x) < 1e-9:  # straight up or down: world's y is up in the picture
        x = np.cross(z, (0.0, 1.0, 0.0))
    x = x / np.linalg.norm(x)
    return rigid(np.column_stack((x, np.cross(z, x), z)), position)


GRAVITY: Final = 9.81
"""Gravity along -z of world [m/s^2]: pinocchio's default, so that plant, controller and planner agree."""
