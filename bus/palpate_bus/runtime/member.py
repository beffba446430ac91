"""A role's membership of the bus: its session, its liveliness tokens, and how it publishes and subscribes by the contract.

What it declares shows in the ROS graph (`ros2 node list`, `ros2 topic info`). A peer that publishes or wants a topic of the
contract with another type or hash never connects with ours. ROS 2 is silent about that, so `complaints` reports it.
"""

from __future__ import annotations

from collections.abc import Collection
from time import monotonic

import zenoh

from palpate_bus.contract import Contract, Topic
from palpate_bus.messages import codec
from palpate_bus.wire.liveliness import GraphWatch, NodeTokens, mismatches
from palpate_bus.wire.rmw import message_key, topic_key
from palpate_bus.wire.transport import Sender, Subscription, Transport

CHECK_S = 0.5
"""How often the graph is looked at."""


class Member:
    """One role on the bus."""

    def __init__(
        self, session: zenoh.Session, role: str, rules: Contract, domain: int, transport: Transport | None = None
    ) -> None:
        """`transport` carries its messages; by default zenoh does, as the contract says."""
        self.session = session
        self.transport = transport or Transport(session)
        self.role = role
        self.rules = rules
        self.domain = domain
        self.graph = GraphWatch(session, domain)
        self._tokens = NodeTokens(session, role, domain, self.transport.ids)
        self._heard: list[tuple[str, Subscription]] = []
        self._said: set[str] = set()
        self._routed = bool(list(session.info.routers_zid()))
        self._checked = 0.0
        self._changed = False

    def publisher(self, topic: Topic) -> Sender:
        """A publisher of a topic of the contract."""
        qos = self.rules.qos[topic.qos]
        return self.transport.publisher(topic.name, topic_key(topic, self.domain), qos, self._tokens.publisher(topic, qos))

    def subscription(self, topic: Topic, history: bool = False) -> Subscription:
        """A subscription to a topic of the contract; with `history`, of what a latched topic sent before."""
        self._tokens.subscription(topic, self.rules.qos[topic.qos])
        decode = codec.decoder(topic.type) if topic.open else None
        return self._listen(topic.name, self.transport.subscription(topic_key(topic, self.domain), history, decode))

    def observed(self, topic: Topic) -> str:
        """Declares a subscription that the caller makes; returns the key."""
        self._tokens.subscription(topic, self.rules.qos[topic.qos])
        return topic_key(topic, self.domain)

    def internal_publisher(self, name: str, type_name: str, qos: str) -> Sender:
        """A publisher of the runtime's own messages."""
        key = message_key(name, type_name, self.domain)
        return self.transport.publisher(name, key, self.rules.qos[qos], self._tokens.node.gid)

    def internal_subscription(self, name: str, type_name: str) -> Subscription:
        """A subscription to the runtime's own messages."""
        return self._listen(name, self.transport.subscription(message_key(name, type_name, self.domain)))

    def _listen(self, name: str, subscription: Subscription) -> Subscription:
        self._heard.append((name, subscription))
        return subscription

    def suspicions(self) -> list[str]:
        """What is new and wrong with who sends what this role hears, a sentence each, said once."""
        found = (f"{name}: {why}" for name, subscription in self._heard if (why := subscription.suspicion))
        new = [sentence for sentence in found if sentence not in self._said]
        self._said.update(new)
        return new

    def transport_lost(self) -> bool:
        """Whether all went through a router that is there no more: then nobody's silence says anything of himself."""
        info = self.session.info
        return self._routed and not list(info.routers_zid()) and not list(info.peers_zid())

    def complaints(self) -> list[str]:
        """New mismatches of message types on the bus, each said once; looks at most every `CHECK_S`."""
        now = monotonic()
        if now - self._checked < CHECK_S:
            return []
        self._checked = now
        self._catch_up()
        if not self._changed:
            return []
        self._changed = False
        new = [sentence for sentence in mismatches(self.graph.alive.values()) if sentence not in self._said]
        self._said.update(new)
        return new

    def gone(self) -> frozenset[str]:
        """Roles that were on the bus and are no more."""
        self._catch_up()
        return self.graph.gone()

    def alive(self, roles: Collection[str]) -> frozenset[str]:
        """Those of `roles` that are on the bus now."""
        self._catch_up()
        return self.graph.roles() & frozenset(roles)

    def _catch_up(self) -> None:
        self._changed = bool(self.graph.changes()) or self._changed

    def leave(self) -> None:
        """Withdraws the tokens."""
        self._tokens.undeclare()
        self.graph.close()
