"""Intrinsics and messages of all backends, and checks of what other makers send: images, intrinsics, static transforms.

Pixel (u, v) looks along ((u - cx)/fx, (v - cy)/fy, 1) of the optical frame C (x right, y down). Pixel centres have integer
coordinates, as in ROS, so the principal point of a w x h image is ((w - 1)/2, (h - 1)/2).
"""

import logging
from collections.abc import Iterable
from math import isfinite
from typing import Any, Final, NamedTuple

import numpy as np

from palpate_bus.messages import Message, Transform, header
from palpate_bus.messages.geometry import (
    MAX_DEPTH_M,
    camera_info,
    depth_in_metres,
    depth_message,
    transform_matrix,
    transform_message,
)
from palpate_errors import UserError
from palpate_models.numerics.frames import Array, Array32
from palpate_models.scenario.schema import Camera


class Pinhole(NamedTuple):
    """Intrinsics in pixels, without distortion."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @classmethod
    def of(cls, camera: Camera) -> "Pinhole":
        """Return the intrinsics of a scenario's camera."""
        focal = camera.focal_px
        return cls(camera.width_px, camera.height_px, focal, focal, (camera.width_px - 1) / 2, (camera.height_px - 1) / 2)

    @property
    def matrix(self) -> Array:
        """K [px], shape (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def every(self, k: int) -> "Pinhole":
        """Return the camera of every `k`-th pixel: its pixel (i, j) is (k // 2 + k i, k // 2 + k j) of this one."""
        first = k // 2
        size = len(range(first, self.width, k)), len(range(first, self.height, k))
        return Pinhole(*size, self.fx / k, self.fy / k, (self.cx - first) / k, (self.cy - first) / k)


FRAME: Final = "camera_depth_optical_frame"
IMAGE: Final = "camera/depth/image_raw"
INFO: Final = "camera/depth/camera_info"
SMALL_IMAGE: Final = "camera/follow/depth"
SMALL_INFO: Final = "camera/follow/camera_info"
SMALL_WIDTH_PX: Final = 96
"""Approximate width of the small image."""


def small_spacing(width: int) -> int:
    """Return the spacing k [px] of the small image's pixels in a full-size image of that width [px]."""
    return max(round(width / SMALL_WIDTH_PX), 1)


def whole_image(t: int, depth: Array32, pinhole: Pinhole) -> dict[str, Message]:
    """Return the messages by topic of a whole image at `t` [ns]; `depth` [m], shape (height, width), NaN where invalid."""
    return {IMAGE: depth_message(header(t, FRAME), depth), INFO: camera_info_message(t, pinhole)}


def small(t: int, depth: Array32, pinhole: Pinhole) -> dict[str, Message]:
    """Return the messages by topic of a small image, as `whole_image`; `pinhole` is that of the small image."""
    return {SMALL_IMAGE: depth_message(header(t, FRAME), depth), SMALL_INFO: camera_info_message(t, pinhole)}


def small_of(t: int, depth: Array32, pinhole: Pinhole) -> dict[str, Message]:
    """Return the messages by topic of the small image of a whole one; arguments as of `whole_image`."""
    k = small_spacing(pinhole.width)
    return small(t, depth[k // 2 :: k, k // 2 :: k], pinhole.every(k))


def camera_info_message(t: int, pinhole: Pinhole) -> Message:
    """Return the `sensor_msgs/CameraInfo` at `t` [ns]."""
    return camera_info(header(t, FRAME), (pinhole.height, pinhole.width), pinhole.matrix)


log = logging.getLogger(__name__)

FOCAL: Final = (0.05, 1000.0)
"""Focal lengths, as shares of the image's size: angles of view of 169 and 0.06 degrees."""
ASPECT: Final = (0.5, 2.0)
"""Ratio of the focal lengths."""
OFF_CENTRE: Final = 0.2
"""Distance of the principal point from the centre, as a share of the image's size; that of half the size is farther away."""
USUAL_DEPTH_M: Final = (0.05, 20.0)
"""Median depth of an image."""
LARGEST_DISTORTION: Final = 1e-9
"""Maximum distortion coefficient of an image that counts as undistorted."""


class CameraError(UserError):
    """A camera that cannot be used. Names topic, field, value and what is wanted."""


class Frame(NamedTuple):
    """One image of a camera."""

    depth: Array32
    """[m], shape (height, width), NaN where nothing was measured."""
    pinhole: Pinhole


class CameraInput(NamedTuple):
    """A camera's pair of topics, and what its messages must agree with."""

    image: str
    """Image topic, as errors name it."""
    info: str
    """Topic of the intrinsics, as errors name it."""
    frame: str
    """Optical frame whose pose is known."""
    other_frame: str
    """Remedy for images in the frame `{}`."""
    distorted: str
    """Remedy for a distorted image."""
    rectified: bool = False
    """True if images are rectified: they use `camera_info`'s P, otherwise its K and distortion."""

    def read(self, image: Message, info: Message) -> Frame:
        """Return an image with its intrinsics. Raises CameraError."""
        for topic, message in ((self.image, image), (self.info, info)):
            named = message.header.frame_id.lstrip("/")
            if named != self.frame:
                raise CameraError(
                    f"{topic} is in frame {named!r}, the pose is of {self.frame!r}: {self.other_frame.format(named)}"
                )
        if (image.width, image.height) != (info.width, info.height):
            raise CameraError(f"{self.image} is {image.width} x {image.height}, {self.info} says {info.width} x {info.height}")
        pinhole = self._pinhole(info)
        try:
            return Frame(depth_in_metres(self.image, image), pinhole)
        except ValueError as error:
            raise CameraError(str(error)) from error

    def _pinhole(self, info: Message) -> Pinhole:
        """Return the intrinsics of the image: P of a rectified one if it is set, otherwise K (sensor_msgs/CameraInfo)."""
        P = np.asarray(info.p, dtype=float).reshape(3, 4)
        K, name = (P[:, :3], "p") if self.rectified and P.any() else (np.asarray(info.k, dtype=float).reshape(3, 3), "k")
        if name == "k" and not np.all(np.abs(np.asarray(info.d)) <= LARGEST_DISTORTION):  # also true for NaN
            raise CameraError(
                f"{self.info}: d = {np.asarray(info.d).tolist()}: expected an image without distortion: rectify it "
                f"(ros2 run image_proc rectify_node --ros-args -p interpolation:=0) and {self.distorted}"
            )
        width, height = int(info.width), int(info.height)
        parts = max(info.binning_x, info.binning_y) > 1 or (info.roi.width, info.roi.height) not in ((0, 0), (width, height))
        if parts:
            raise CameraError(f"{self.info}: binning or a region of interest: expected the intrinsics of the image as it is sent")
        fx, fy, cx, cy = map(float, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
        where = f"{self.info}: {name} = {K.ravel().tolist()}"
        if not (np.isfinite(K).all() and fx > 0 and fy > 0):
            raise CameraError(f"{where}: all must be finite, and the focal lengths positive")
        if not np.array_equal(K, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])):
            raise CameraError(f"{where}: expected fx, 0, cx, 0, fy, cy, 0, 0, 1")
        sides = fx / width, fy / height
        if not (FOCAL[0] < min(sides) and max(sides) < FOCAL[1] and ASPECT[0] < fx / fy < ASPECT[1]):
            raise CameraError(f"{where}: focal lengths of {fx:g} and {fy:g} px are not of an image of {width} x {height} px")
        if any(abs(centre - size / 2) > OFF_CENTRE * size + 0.5 for centre, size in ((cx, width), (cy, height))):
            raise CameraError(f"{where}: the principal point ({cx:g}, {cy:g}) is not in the middle of {width} x {height} px")
        return Pinhole(width, height, fx, fy, cx, cy)

    def check_seen(self, frames: Iterable[Frame]) -> None:
        """Raise CameraError if no image measures anything, or their depth is not that of a camera."""
        depth = np.concatenate([frame.depth[np.isfinite(frame.depth)] for frame in frames])
        if not len(depth):
            raise CameraError(f"{self.image}: no pixel has a depth of 0 to {MAX_DEPTH_M:g} m: expected 32FC1 in m or 16UC1 in mm")
        low, high = USUAL_DEPTH_M
        if not low < (usual := float(np.median(depth))) < high:
            raise CameraError(
                f"{self.image}: median depth is {usual:.3g} m, expected {low:g} to {high:g} m: see encoding, unit, is_bigendian"
            )


class StaticTransforms:
    """The transforms of `tf_static`. Invalid ones are left out and named, as tf2 does; the newest valid one of a frame counts."""

    def __init__(self) -> None:
        self._links: dict[str, tuple[str, Transform]] = {}
        self.left_out: dict[str, str] = {}
        """Defects of the transforms that were left out, by frame."""

    def add(self, transforms: Iterable[Any]) -> None:
        """Take transforms."""
        for item in transforms:
            parent, child = item.header.frame_id.lstrip("/"), item.child_frame_id.lstrip("/")
            if problem := _problem(parent, child, item.transform):
                self.left_out[child] = problem
            else:
                self._links[child] = parent, item.transform

    def pose(self, root: str, leaf: str) -> Transform | None:
        """Return the pose of a frame in another one; None while a link of the chain is missing."""
        X, frame, chain = np.eye(4), leaf, list[Transform]()
        while frame != root:
            if frame not in self._links or len(chain) > len(self._links):  # or a circle
                return None
            frame, transform = self._links[frame]
            chain.append(transform)
            X = transform_matrix(transform) @ X
        return chain[0] if len(chain) == 1 else transform_message(X)

    def need(self, root: str, leaf: str) -> Transform:
        """Return the pose of a frame in another one; log what is left out. Raises CameraError naming a bad or missing link."""
        if (pose := self.pose(root, leaf)) is not None:
            for child, problem in self.left_out.items():
                log.warning("tf_static: the transform of %r is not needed and left out: %s", child, problem)
            return pose
        frame, seen = leaf, set[str]()
        while frame in self._links and frame not in seen:
            seen.add(frame)
            frame = self._links[frame][0]
        if frame in self.left_out:
            raise CameraError(f"tf_static: the pose of {leaf!r} in {root!r} needs that of {frame!r}: {self.left_out[frame]}")
        tree = ", ".join(f"{parent} -> {child}" for child, (parent, _) in sorted(self._links.items())) or "nothing"
        raise CameraError(f"tf_static has no way from {root!r} to {leaf!r}: it has {tree}. Calibrate and publish it")


def _problem(parent: str, child: str, transform: Transform) -> str:
    """Describe what is wrong with a transform; empty if it is valid."""
    if not parent or not child or parent == child:
        return f"it is from {parent!r} to {child!r}, expected two frames"
    p = transform.translation
    if not all(map(isfinite, (p.x, p.y, p.z))):
        return f"translation = ({p.x}, {p.y}, {p.z}): must be finite"
    try:
        transform_matrix(transform)
    except ValueError as error:
        return str(error)
    return ""
