"""Who commands the arm: the stack's command topic, of which every message is told with its sender."""

from __future__ import annotations

import zenoh
from palpate_bus.contract import Topic
from palpate_bus.ros_node import QOS, RosNode, RosSubscription
from palpate_bus.wire import topic_key

from palpate_robot_lbr.idl import TORQUE_COMMAND


class CommandSubscription(RosSubscription):
    """Torque commands of all processes. `take` gives pairs: the publisher's GID, and the LBRTorqueCommand."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        super().__init__(session, key, TORQUE_COMMAND)
        decode = self._decode
        self._decode = lambda payload: (self.sender, decode(payload))

    def others(self, own: bytes) -> list[bytes]:
        """GIDs of those who commanded since last time, oldest first, without `own`."""
        return [sender for sender, _ in self.take() if sender != own]


class LbrNode(RosNode):
    """A node that also hears who commands."""

    def commands(self, topic: str) -> CommandSubscription:
        """Declares a subscription to the stack's command topic."""
        row = Topic(name=topic, type=TORQUE_COMMAND, producer="robot", readers={}, qos=QOS.name, doc="of the ROS side")
        self._tokens.subscription(row, QOS)
        return CommandSubscription(self._session, topic_key(row, self._domain))
