"""A ROS 2 node without ROS: topics over zenoh with rmw_zenoh's keys, attachments and liveliness tokens.

`ros2 node list` and `ros2 topic info` show it.
"""

from typing import Any

import zenoh

from palpate_bus.contract import Qos, Topic
from palpate_bus.messages import codec
from palpate_bus.wire.liveliness import NodeTokens
from palpate_bus.wire.rmw import WireError, topic_key, unpack
from palpate_bus.wire.transport import Publisher, subscribe
from palpate_bus.wire.zenoh_config import BusOptions, close_session, open_session

RING = 16
"""Messages kept per topic."""
QOS = Qos(
    name="ros", priority="REAL_TIME", congestion="DROP", express=True, reliability="RELIABLE", depth=1,
    reason="as ros2_control's controllers subscribe: reliable, the newest alone",
)  # fmt: skip
LATCHED = QOS.model_copy(update={"transient_local": True, "congestion": "BLOCK", "priority": "DATA"})


class RosPublisher:
    """Publishes on a ROS topic."""

    def __init__(self, publisher: Publisher, type_name: str, gid: bytes) -> None:
        self._publisher = publisher
        self.gid = gid
        self._encode = codec.encoder(type_name)
        self._sequence = 0

    def publish(self, message: Any) -> None:
        """Send a message."""
        self._sequence += 1
        self._publisher.put(self._encode(message), self._sequence)


class RosSubscription:
    """The newest messages of a ROS topic, from any publisher."""

    def __init__(self, session: zenoh.Session, key: str, type_name: str, *, latched: bool = False) -> None:
        self._decode = codec.decoder(type_name)
        channel: Any = zenoh.handlers.RingChannel(RING)
        self._subscriber = subscribe(session, key, channel, history=latched)
        self._try = self._subscriber.handler.try_recv
        self.garbage = 0
        """Messages that could not be decoded."""

    def receive(self) -> list[tuple[bytes, Any]]:
        """Return new messages with the GID of their publisher, oldest first; at most `RING`."""
        pairs = []
        while (sample := self._try()) is not None:
            try:
                attachment: Any = sample.attachment
                _, _, sender = unpack(attachment.to_bytes())
                pairs.append((sender, self._decode(sample.payload.to_bytes())))
            except (WireError, AttributeError, codec.CodecError):
                self.garbage += 1
        return pairs

    def take(self) -> list[Any]:
        """Return the messages of `receive`."""
        return [message for _, message in self.receive()]

    def others(self, own: bytes) -> list[bytes]:
        """Return the publishers' GIDs of `receive`, without `own`."""
        return [sender for sender, _ in self.receive() if sender != own]

    def newest(self) -> Any | None:
        """Return the newest message since the last call, or None."""
        messages = self.take()
        return messages[-1] if messages else None


class RosNode:
    """A named node; topics are absolute, without the leading slash."""

    def __init__(self, name: str, domain: int, options: BusOptions) -> None:
        """Raise BusConfigError if a session cannot be opened."""
        self._session = open_session(options)
        self._domain = domain
        self._tokens = NodeTokens(self._session, name, domain)

    def publisher(self, topic: str, type_name: str, *, latched: bool = False) -> RosPublisher:
        """Declare a publisher; `latched` (transient local) also serves late subscribers."""
        row = _row(topic, type_name)
        qos = LATCHED if latched else QOS
        gid = self._tokens.publisher(row, qos)
        return RosPublisher(Publisher(self._session, topic_key(row, self._domain), qos, gid), type_name, gid)

    def subscription(self, topic: str, type_name: str, *, latched: bool = False) -> RosSubscription:
        """Declare a subscription; `latched` (transient local) also delivers earlier messages."""
        row = _row(topic, type_name)
        self._tokens.subscription(row, QOS)
        return RosSubscription(self._session, topic_key(row, self._domain), type_name, latched=latched)

    def close(self) -> None:
        """Leave the bus."""
        self._tokens.undeclare()
        close_session(self._session)


def _row(topic: str, type_name: str) -> Topic:
    return Topic(name=topic, type=type_name, producer="robot", readers={}, qos=QOS.name, doc="a ROS topic")
