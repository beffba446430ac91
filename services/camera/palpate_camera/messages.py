"""Messages of every camera: full-size and small depth images with their intrinsics.

The small image has every k-th pixel of the full-size one. Perception tracks the wall with it.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from palpate_bus.messages import CameraInfo, RegionOfInterest
from palpate_bus.messages import Image as ImageMessage
from palpate_bus.messages.codec import Message
from palpate_bus.messages.stamps import header
from palpate_camera.pinhole import Pinhole

FRAME: Final = "camera_depth_optical_frame"
IMAGE: Final = "camera/depth/image_raw"
INFO: Final = "camera/depth/camera_info"
SMALL_IMAGE: Final = "camera/follow/depth"
SMALL_INFO: Final = "camera/follow/camera_info"
SMALL_WIDTH_PX: Final = 96
"""About how wide the small image is."""


def apart(width: int) -> int:
    """Return the pixel spacing k of the small image for a full-size image of that width [px]."""
    return max(round(width / SMALL_WIDTH_PX), 1)


def whole(t: int, depth: NDArray[np.float32], pinhole: Pinhole) -> dict[str, Message]:
    """The messages of a whole image, [m], shape (height, width), NaN where invalid."""
    return {IMAGE: depth_image(t, depth), INFO: camera_info(t, pinhole)}


def small(t: int, depth: NDArray[np.float32], pinhole: Pinhole) -> dict[str, Message]:
    """The messages of a small image, likewise; `pinhole` is its own."""
    return {SMALL_IMAGE: depth_image(t, depth), SMALL_INFO: camera_info(t, pinhole)}


def every_few(t: int, depth: NDArray[np.float32], pinhole: Pinhole) -> dict[str, Message]:
    """The messages of the small image of a whole one, [m], shape (height, width), of the camera `pinhole`."""
    k = apart(pinhole.width)
    return small(t, depth[k // 2 :: k, k // 2 :: k], pinhole.every(k))


def pinhole_of(info: Message) -> Pinhole:
    """Return the camera of a `sensor_msgs/CameraInfo` without distortion."""
    K = np.asarray(info.k, np.float64).reshape(3, 3)
    return Pinhole(int(info.width), int(info.height), *(float(x) for x in (K[0, 0], K[1, 1], K[0, 2], K[1, 2])))


def depth_image(t: int, image: NDArray[np.float32]) -> Message:
    """`sensor_msgs/Image` of encoding 32FC1 [m], little-endian, NaN where invalid."""
    height, width = image.shape
    data = np.ascontiguousarray(image, "<f4").view(np.uint8).reshape(-1)
    return ImageMessage(header(t, FRAME), height, width, "32FC1", 0, 4 * width, data)


def camera_info(t: int, pinhole: Pinhole) -> Message:
    """`sensor_msgs/CameraInfo` without distortion."""
    K = pinhole.matrix
    P = np.hstack((K, np.zeros((3, 1)))).ravel()
    size, whole = (pinhole.height, pinhole.width), RegionOfInterest(0, 0, 0, 0, False)
    return CameraInfo(header(t, FRAME), *size, "plumb_bob", np.zeros(5), K.ravel(), np.eye(3).ravel(), P, 0, 0, whole)
