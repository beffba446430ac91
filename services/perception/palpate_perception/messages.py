"""Camera messages as arrays; the wall's motion and the surface's correction as messages."""

from typing import Final

import numpy as np

from palpate_bus.contract import contract
from palpate_bus.messages import SurfaceCorrection, SurfaceMotion
from palpate_bus.messages.codec import Message
from palpate_bus.messages.geometry import transform_matrix, vector_message
from palpate_bus.messages.stamps import header
from palpate_bus.service import Inbox
from palpate_models.numerics.frames import Array
from palpate_perception.cloud import Intrinsics
from palpate_perception.tracker import Followed

FRAME: Final = contract().topics["perception/targets"].frame or ""
"""Frame of the surface and the targets."""
MOTION_FRAME: Final = contract().topics["perception/motion"].frame or ""


def intrinsics(inbox: Inbox, topic: str, image: Message) -> Intrinsics | None:
    """Return intrinsics and pose for an image, from the newest camera_info on `topic` and tf_static; None until both arrived."""
    info, pose = inbox.latest(topic), inbox.latest("tf_static")
    X_WC = None if pose is None else camera_pose(pose, image.header.frame_id)
    if info is None or X_WC is None:
        return None
    return Intrinsics(np.array(info.k, np.float64).reshape(3, 3), X_WC, (int(info.height), int(info.width)))


def camera_pose(message: Message, frame: str) -> Array | None:
    """Return X_WC, shape (4, 4), of the optical frame `frame` from tf_static; None if tf_static lacks it.

    Raises ValueError for a quaternion that is not of unit length.
    """
    for item in message.transforms:
        if item.child_frame_id == frame and item.header.frame_id == FRAME:
            return transform_matrix(item.transform)
    return None


def motion(stamp: int, followed: Followed) -> Message:
    """Return the `palpation_msgs/SurfaceMotion` of an image exposed at the time `stamp` [ns]."""
    state, shift = getattr(SurfaceMotion, followed.state.name), vector_message(followed.shift)
    return SurfaceMotion(header(stamp, MOTION_FRAME), state, followed.displacement, followed.forecast, followed.sigma, shift)


def correction(t: int, outward: Array) -> Message:
    """Return the `palpation_msgs/SurfaceCorrection` at `t` [ns]: outward offset of the wall [m] at each vertex, shape (n,)."""
    return SurfaceCorrection(header(t, MOTION_FRAME), outward.astype(np.float32), np.empty(0, np.float32))
