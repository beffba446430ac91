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
    px, py, pz, x, y, z, w, vx, vy, vz, wx, wy, wz = motion
    pose = Pose(Point(px, py, pz), Quaternion(x, y, z, w))
    return ToolState(stamped, pose, Twist(Vector3(vx, vy, vz), Vector3(wx, wy, wz)), radius)


def link_poses(stamped: Header, links: Sequence[str], poses: Array) -> TFMessage:
    """Return the message of `Plant.link_poses`, by the names of the links."""
    transforms = [Transform(Vector3(*pose[:3]), Quaternion(*pose[3:])) for pose in poses.tolist()]
    return TFMessage([TransformStamped(stamped, *pair) for pair in zip(links, transforms, strict=True)])
