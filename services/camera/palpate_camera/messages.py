"""Intrinsics and messages of all backends.

Pixel (u, v) looks along ((u - cx)/fx, (v - cy)/fy, 1) of the optical frame C (x right, y down). Pixel centres have integer
coordinates, as in ROS, so the principal point of a w x h image is ((w - 1)/2, (h - 1)/2).
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_bus.messages import Message, header
from palpate_bus.messages.geometry import camera_info, depth_message
from palpate_models.numerics.frames import Array
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


def whole_image(t: int, depth: NDArray[np.float32], pinhole: Pinhole) -> dict[str, Message]:
    """Return the messages by topic of a whole image at `t` [ns]; `depth` [m], shape (height, width), NaN where invalid."""
    return {IMAGE: depth_message(header(t, FRAME), depth), INFO: camera_info_message(t, pinhole)}


def small(t: int, depth: NDArray[np.float32], pinhole: Pinhole) -> dict[str, Message]:
    """Return the messages by topic of a small image, as `whole_image`; `pinhole` is that of the small image."""
    return {SMALL_IMAGE: depth_message(header(t, FRAME), depth), SMALL_INFO: camera_info_message(t, pinhole)}


def small_of(t: int, depth: NDArray[np.float32], pinhole: Pinhole) -> dict[str, Message]:
    """Return the messages by topic of the small image of a whole one; arguments as of `whole_image`."""
    k = small_spacing(pinhole.width)
    return small(t, depth[k // 2 :: k, k // 2 :: k], pinhole.every(k))


def camera_info_message(t: int, pinhole: Pinhole) -> Message:
    """Return the `sensor_msgs/CameraInfo` at `t` [ns]."""
    return camera_info(header(t, FRAME), (pinhole.height, pinhole.width), pinhole.matrix)
