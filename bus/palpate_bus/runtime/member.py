"""A role on the bus: its session, its liveliness tokens, and its publishers and subscriptions by the contract.

Its declarations show in the ROS graph (`ros2 node list`, `ros2 topic info`). A peer with another type or hash of a topic never
connects. ROS 2 does not report that, so `complaints` does.
"""

from collections.abc import Collection
from time import monotonic

import zenoh

from palpate_bus.contract import Contract, Topic
from palpate_bus.contract.port_check import RefusedMessage
from palpate_bus.messages import codec
from palpate_bus.wire.liveliness import GraphWatch, NodeTokens, mismatches
from palpate_bus.wire.rmw import message_key, topic_key
from palpate_bus.wire.transport import Sender, Subscription, Transport

CHECK_S = 0.5
"""Period at which the graph is checked for mismatches."""


class Member:
    """One role on the bus."""

    def __init__(
        self, session: zenoh.Session, role: str, contract: Contract, domain: int, transport: Transport | None = None
    ) -> None:
        """`transport` carries its messages; by default zenoh does, as the contract says."""
        self.session = session
        self.transport = transport or Transport(session)
        self.role = role
        self.contract = contract
        self.domain = domain
        self.graph = GraphWatch(session, domain)
        self._tokens = NodeTokens(session, role, domain, self.transport.ids)
        self._subscriptions: list[tuple[str, Subscription]] = []
        self._noted: list[str] = []
        self.refused_topics: set[str] = set()
        """Topics of which a message was refused."""
        self._reported: set[str] = set()
        self._routed = bool(list(session.info.routers_zid()))
        self._checked_at = 0.0
        self._changed = False

    def publisher(self, topic: Topic) -> Sender:
        """Return a publisher of a topic of the contract."""
        qos = self.contract.qos[topic.qos]
        return self.transport.publisher(topic.name, topic_key(topic, self.domain), qos, self._tokens.publisher(topic, qos))

    def subscription(self, topic: Topic, history: bool = False) -> Subscription:
        """Return a subscription to a topic of the contract; with `history`, including earlier messages of a latched topic."""
        self._tokens.subscription(topic, self.contract.qos[topic.qos])
        decode = codec.decoder(topic.type) if topic.open else None
        return self._keep(topic.name, self.transport.subscription(topic_key(topic, self.domain), history, decode))

    def declare_observed(self, topic: Topic) -> str:
        """Declare a subscription that the caller makes; return its key."""
        self._tokens.subscription(topic, self.contract.qos[topic.qos])
        return topic_key(topic, self.domain)

    def internal_publisher(self, name: str, type_name: str, qos: str) -> Sender:
        """Return a publisher of the runtime's own messages."""
        key = message_key(name, type_name, self.domain)
        return self.transport.publisher(name, key, self.contract.qos[qos], self._tokens.node.gid)

    def internal_subscription(self, name: str, type_name: str) -> Subscription:
        """Return a subscription to the runtime's own messages."""
        return self._keep(name, self.transport.subscription(message_key(name, type_name, self.domain)))

    def _keep(self, name: str, subscription: Subscription) -> Subscription:
        self._subscriptions.append((name, subscription))
        return subscription

    def note_refused(self, refused: RefusedMessage) -> None:
        """Note a message that was refused, the first of its topic."""
        if refused.topic not in self.refused_topics:
            self.refused_topics.add(refused.topic)
            self._noted.append(f"{refused}; such messages are dropped")

    def suspicions(self) -> list[str]:
        """Return new suspicions about the senders of this role's inputs, and its new notes, each once."""
        found = [f"{name}: {suspicion}" for name, subscription in self._subscriptions if (suspicion := subscription.suspicion)]
        new = [text for text in (*found, *self._noted) if text not in self._reported]
        self._noted.clear()
        self._reported.update(new)
        return new

    def transport_lost(self) -> bool:
        """Return True if all traffic went through a router that has closed, so that no silent role is at fault."""
        info = self.session.info
        return self._routed and not list(info.routers_zid()) and not list(info.peers_zid())

    def complaints(self) -> list[str]:
        """Return new mismatches of message types on the bus, each once; checks at most every `CHECK_S`."""
        now = monotonic()
        if now - self._checked_at < CHECK_S:
            return []
        self._checked_at = now
        self._update()
        if not self._changed:
            return []
        self._changed = False
        new = [text for text in mismatches(self.graph.alive.values()) if text not in self._reported]
        self._reported.update(new)
        return new

    def gone(self) -> frozenset[str]:
        """Return the roles that were on the bus and have left."""
        self._update()
        return self.graph.gone()

    def alive(self, roles: Collection[str]) -> frozenset[str]:
        """Return those of `roles` that are on the bus now."""
        self._update()
        return self.graph.roles() & frozenset(roles)

    def _update(self) -> None:
        self._changed = bool(self.graph.changes()) or self._changed

    def close(self) -> None:
        """Leave the bus: withdraw the tokens."""
        self._tokens.undeclare()
        self.graph.close()
