"""Geometry in messages as arrays, and back: poses, twists, wrenches, points, surface meshes, point clouds and depth images.

Rotations are matrices in arrays and unit quaternions in messages.
"""

from collections.abc import Iterable, Sequence
from math import sqrt
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from palpate_bus import messages as ros

Array = NDArray[np.float64]

DEPTH_ENCODINGS: Final = {"32FC1": ("f4", 1.0), "16UC1": ("u2", 1e-3), "mono16": ("u2", 1e-3)}
"""Depth encodings of ROS (REP 118): pixel type and unit [m]. Pixels without a measurement are NaN, 0 or 65535 mm."""
MAX_DEPTH_M: Final = 65.5
"""Upper limit of a valid depth [m]; 65535 mm and infinity mean no measurement."""


class MeshArrays(NamedTuple):
    """The arrays of a `SurfaceMesh`."""

    vertices: Array
    """[m], shape (n, 3), in the frame of the header."""
    normals: Array
    """Outward unit normals, shape (n, 3), or (0, 3) if the message has none."""
    triangles: NDArray[np.int64]
    """Vertex indices, shape (m, 3), counter-clockwise seen from outside."""
    breathing: Array
    """Relative breathing motion of each vertex [1], shape (n,), or (0,) if the message has none."""


def quaternion(R: Array) -> tuple[float, float, float, float]:
    """Return the unit quaternion (x, y, z, w) with w >= 0 of a rotation matrix, shape (3, 3). Shepperd's method (1978)."""
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


def rotation(orientation: ros.Quaternion) -> Array:
    """Return the rotation matrix, shape (3, 3). Raises ValueError if the quaternion's norm is off by 1 % or more."""
    x, y, z, w = orientation.x, orientation.y, orientation.z, orientation.w
    norm = sqrt(x * x + y * y + z * z + w * w)
    if not abs(norm - 1.0) < 0.01:  # also true for NaN
        raise ValueError(f"orientation = ({x}, {y}, {z}, {w}) has norm {norm}: must be 1")
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def pose_matrix(message: ros.Pose) -> Array:
    """Return the homogeneous matrix, shape (4, 4). Raises ValueError as `rotation` does."""
    return _homogeneous(rotation(message.orientation), vector(message.position))


def transform_matrix(message: ros.Transform) -> Array:
    """Return the homogeneous matrix, shape (4, 4). Raises ValueError as `rotation` does."""
    return _homogeneous(rotation(message.rotation), vector(message.translation))


def pose_of_frame(message: ros.TFMessage, frame: str | None, parent: str) -> Array | None:
    """Return the pose of `frame` in `parent`, shape (4, 4); None if it is missing. Raises ValueError as `rotation` does."""
    for item in message.transforms:
        if item.child_frame_id == frame and item.header.frame_id == parent:
            return transform_matrix(item.transform)
    return None


def _homogeneous(R: Array, p: Array) -> Array:
    X = np.eye(4)
    X[:3, :3] = R
    X[:3, 3] = p
    return X


def pose_message(R: Array, p: Array) -> ros.Pose:
    """Return the `Pose` of a rotation matrix, shape (3, 3), and an origin [m], shape (3,)."""
    return ros.Pose(ros.Point(*p.tolist()), ros.Quaternion(*quaternion(R)))


def transform_message(X: Array) -> ros.Transform:
    """Return the `Transform` of a homogeneous matrix, shape (4, 4)."""
    return ros.Transform(ros.Vector3(*X[:3, 3].tolist()), ros.Quaternion(*quaternion(X[:3, :3])))


def twist_message(V: Array) -> ros.Twist:
    """Return the `Twist` of an array, linear [m/s] then angular [rad/s], shape (6,)."""
    return ros.Twist(ros.Vector3(*V[:3].tolist()), ros.Vector3(*V[3:].tolist()))


def wrench_message(F: Array) -> ros.Wrench:
    """Return the `Wrench` of an array, force [N] then torque [N m], shape (6,)."""
    return ros.Wrench(ros.Vector3(*F[:3].tolist()), ros.Vector3(*F[3:].tolist()))


def tool_message(header: ros.Header, motion: Sequence[float], radius: float) -> ros.ToolState:
    """Return the `ToolState` of an indenter with a radius [m] in world.

    `motion`: position [m], orientation x, y, z, w, and velocities [m/s, rad/s] of its centre.
    """
    px, py, pz, x, y, z, w, vx, vy, vz, wx, wy, wz = motion
    pose = ros.Pose(ros.Point(px, py, pz), ros.Quaternion(x, y, z, w))
    return ros.ToolState(header, pose, ros.Twist(ros.Vector3(vx, vy, vz), ros.Vector3(wx, wy, wz)), radius)


def frames_message(header: ros.Header, names: Sequence[str], poses: Array) -> ros.TFMessage:
    """Return the `TFMessage` of frames by name: position [m], orientation x, y, z, w, shape (n, 7)."""
    transforms = [ros.Transform(ros.Vector3(*pose[:3]), ros.Quaternion(*pose[3:])) for pose in poses.tolist()]
    return ros.TFMessage([ros.TransformStamped(header, *pair) for pair in zip(names, transforms, strict=True)])


def vector(message: ros.Point | ros.Vector3) -> Array:
    """Return x, y and z, shape (3,)."""
    return np.array((message.x, message.y, message.z))


def vectors(messages: Iterable[ros.Point | ros.Vector3]) -> Array:
    """Return x, y and z of each message, shape (n, 3)."""
    return np.array([(message.x, message.y, message.z) for message in messages], dtype=np.float64).reshape(-1, 3)


def point_message(p: ArrayLike) -> ros.Point:
    """Return the `Point` of an array, shape (3,)."""
    return ros.Point(*np.asarray(p, dtype=np.float64).tolist())


def vector_message(v: ArrayLike) -> ros.Vector3:
    """Return the `Vector3` of an array, shape (3,)."""
    return ros.Vector3(*np.asarray(v, dtype=np.float64).tolist())


def twist(message: ros.Twist) -> Array:
    """Return linear [m/s] then angular [rad/s], shape (6,)."""
    v, w = message.linear, message.angular
    return np.array((v.x, v.y, v.z, w.x, w.y, w.z))


def wrench(message: ros.Wrench) -> Array:
    """Return force [N] then torque [N m], shape (6,)."""
    f, m = message.force, message.torque
    return np.array((f.x, f.y, f.z, m.x, m.y, m.z))


def mesh_arrays(message: Any) -> MeshArrays:
    """Return the arrays of a message with the fields of `SurfaceMesh`; fields that it lacks are empty."""
    empty = np.empty(0)
    return MeshArrays(
        np.asarray(message.vertices, dtype=np.float64).reshape(-1, 3),
        np.asarray(getattr(message, "normals", empty), dtype=np.float64).reshape(-1, 3),
        np.asarray(message.triangles, dtype=np.int64).reshape(-1, 3),
        np.asarray(getattr(message, "breathing", empty), dtype=np.float64),
    )


def mesh_message(
    header: ros.Header, vertices: ArrayLike, normals: ArrayLike = (), triangles: ArrayLike = (), breathing: ArrayLike = ()
) -> ros.SurfaceMesh:
    """Return the `SurfaceMesh` of arrays, shaped as in `MeshArrays`; arrays that are left out are empty in the message."""

    def flat(array: ArrayLike, kind: Any = np.float32) -> Any:
        return np.ascontiguousarray(array, dtype=kind).reshape(-1)

    return ros.SurfaceMesh(header, flat(vertices), flat(normals), flat(triangles, np.uint32), flat(breathing))


def cloud_message(header: ros.Header, points: Array) -> ros.PointCloud2:
    """Return the `PointCloud2` of points [m], shape (n, 3): x y z as float32."""
    fields = [ros.PointField(name, 4 * i, 7, 1) for i, name in enumerate("xyz")]  # 7: FLOAT32
    data = np.ascontiguousarray(points, "<f4").view(np.uint8).reshape(-1)
    return ros.PointCloud2(header, 1, len(points), fields, False, 12, 12 * len(points), data, True)


def camera_info(header: ros.Header, size_px: tuple[int, int], K: Array) -> ros.CameraInfo:
    """Return the `CameraInfo` of images without distortion: `size_px` height and width, K [px], shape (3, 3)."""
    P, whole = np.hstack((K, np.zeros((3, 1)))).ravel(), ros.RegionOfInterest(0, 0, 0, 0, False)
    return ros.CameraInfo(header, *size_px, "plumb_bob", np.zeros(5), K.ravel(), np.eye(3).ravel(), P, 0, 0, whole)


def depth_message(header: ros.Header, depth: NDArray[np.float32]) -> ros.Image:
    """Return the `Image` of a depth image [m], shape (height, width), NaN where invalid: 32FC1, little-endian."""
    height, width = depth.shape
    data = np.ascontiguousarray(depth, "<f4").view(np.uint8).reshape(-1)
    return ros.Image(header, height, width, "32FC1", 0, 4 * width, data)


def depth_in_metres(name: str, message: ros.Image) -> NDArray[np.float32]:
    """Return depth [m], shape (height, width), NaN where invalid. Rows of the `Image` may be padded.

    Raises ValueError for an encoding that is not in `DEPTH_ENCODINGS`, or too little data. Its text begins with `name`.
    """
    if message.encoding not in DEPTH_ENCODINGS:
        raise ValueError(f"{name}: encoding = {message.encoding!r}, expected one of {', '.join(DEPTH_ENCODINGS)}")
    pixel, unit = DEPTH_ENCODINGS[message.encoding]
    kind = np.dtype((">" if message.is_bigendian else "<") + pixel)
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.frombuffer(message.data, np.uint8)
    if step < width * kind.itemsize or data.size < height * step:
        raise ValueError(f"{name}: {data.size} bytes for {height} rows of {step}, {width} pixels each")
    rows = data[: height * step].reshape(height, step)[:, : width * kind.itemsize]
    depth = np.ascontiguousarray(rows).view(kind).astype(np.float32) * np.float32(unit)
    depth[~((depth > 0) & (depth < MAX_DEPTH_M))] = np.nan
    return depth
