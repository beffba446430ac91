"""Camera messages as arrays, and the wall's motion as a message."""

from __future__ import annotations

from typing import Final

import numpy as np

from palpate_bus.contract import contract
from palpate_bus.messages import SurfaceMotion, Vector3
from palpate_bus.messages.codec import Message
from palpate_bus.messages.geometry import transform_matrix
from palpate_bus.messages.stamps import header
from palpate_bus.service import Inbox
from palpate_models.frames import Array
from palpate_perception.fusion import Image
from palpate_perception.tracker import Followed
from palpate_perception.views import Intrinsics

FRAME: Final = contract().topics["perception/targets"].frame or ""
"""Frame of the surface and the targets."""
MOTION_FRAME: Final = contract().topics["perception/motion"].frame or ""


def intrinsics(inbox: Inbox, topic: str, image: Message) -> Intrinsics | None:
    """The camera of an image, by the newest camera_info on `topic` and tf_static; None until both have come."""
    info, pose = inbox.latest(topic), inbox.latest("tf_static")
    X_WC = None if pose is None else camera_pose(pose, image.header.frame_id)
    if info is None or X_WC is None:
        return None
    return Intrinsics(np.array(info.k, np.float64).reshape(3, 3), X_WC, (int(info.height), int(info.width)))


def depth_in_metres(topic: str, message: Message) -> Image:
    """Depth [m], shape (height, width), NaN where invalid, of a sensor_msgs/Image of encoding 32FC1 [m] or 16UC1 [mm].

    Raises ValueError for another encoding, or data that does not fit the size.
    """
    kinds = {"32FC1": "f4", "16UC1": "u2"}
    if message.encoding not in kinds:
        raise ValueError(f"{topic}: encoding = {message.encoding!r}, want one of {sorted(kinds)}")
    kind = np.dtype((">" if message.is_bigendian else "<") + kinds[message.encoding])
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.frombuffer(message.data, np.uint8)
    if step < width * kind.itemsize or data.size != height * step:
        raise ValueError(f"{topic}: {data.size} bytes for {height} rows of {step}, {width} pixels each")
    raw = np.ascontiguousarray(data.reshape(height, step)[:, : width * kind.itemsize]).view(kind)
    depth = raw.astype(np.float32) * np.float32(1.0 if kind.kind == "f" else 1e-3)
    depth[~(depth > 0)] = np.nan
    return depth


def camera_pose(message: Message, frame: str) -> Array | None:
    """X_WC, shape (4, 4), of an optical frame from tf_static; None when it is not in there."""
    for item in message.transforms:
        if item.child_frame_id == frame and item.header.frame_id == FRAME:
            return transform_matrix(item.transform)
    return None


def motion(stamp: int, followed: Followed) -> Message:
    """`palpation_msgs/SurfaceMotion` of an image exposed at the time `stamp` [ns]."""
    state, shift = getattr(SurfaceMotion, followed.state.name), Vector3(*map(float, followed.shift))
    return SurfaceMotion(header(stamp, MOTION_FRAME), state, followed.displacement, followed.forecast, followed.sigma, shift)
