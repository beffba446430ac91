"""Messages of the tool and a service that moves a point, for tests of the tissue and of FMUs."""

from collections.abc import Callable, Sequence
from typing import Any

from palpate_bus.messages import Point, Pose, PoseStamped, Quaternion, ToolState, Twist, Vector3, header
from palpate_bus.service import Inbox, Outbox, Service

ZERO = (0.0, 0.0, 0.0)


def pose(p: Sequence[float]) -> Any:
    return Pose(Point(*map(float, p)), Quaternion(0.0, 0.0, 0.0, 1.0))


def tool_state(t: int, p: Sequence[float], v: Sequence[float] = ZERO, w: Sequence[float] = ZERO, radius: float = 0.015) -> Any:
    return ToolState(header(t, "world"), pose(p), Twist(Vector3(*map(float, v)), Vector3(*map(float, w))), radius)


class Source(Service):
    """Sends the place of a point at each time, and keeps what it receives from the other service."""

    role = "source"

    def __init__(self, topic: str, place: Callable[[int], Sequence[float]]) -> None:
        self.topic, self.place = topic, place
        self.seen: list[Any] = []

    def step(self, t: int, inbox: Inbox) -> Outbox:
        self.seen += inbox.new(self.topic)
        return {"place": PoseStamped(header(t, "world"), pose(self.place(t)))}
