"""Messages of a simulated arm from the arrays of its plant."""

from collections.abc import Sequence

from palpate_bus.messages import (
    Header,
    Point,
    Pose,
    Quaternion,
    TFMessage,
    ToolState,
    Transform,
    TransformStamped,
    Twist,
    Vector3,
)
from palpate_models.numerics.frames import Array


def tool_state(stamped: Header, motion: Sequence[float], radius: float) -> ToolState:
    """Return the message of a `Plant.tool_motion` and the radius of the indenter [m]."""
    pose = Pose(Point(*motion[:3]), Quaternion(*motion[3:7]))
    return ToolState(stamped, pose, Twist(Vector3(*motion[7:10]), Vector3(*motion[10:])), radius)


def link_poses(stamped: Header, links: Sequence[str], poses: Array) -> TFMessage:
    """Return the message of `Plant.link_poses`, by the names of the links."""
    transforms = [Transform(Vector3(*pose[:3]), Quaternion(*pose[3:])) for pose in poses.tolist()]
    return TFMessage([TransformStamped(stamped, *pair) for pair in zip(links, transforms, strict=True)])
