"""An inbox filled by hand, for tests and benches of a service's step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from palpate_bus.contract import contract
from palpate_bus.messages import codec


class HandInbox:
    """What a step receives: `put` messages into it, or fill its dictionaries by topic."""

    def __init__(self) -> None:
        self.messages: dict[str, Any] = {}
        """The newest of each topic, which `latest` gives."""
        self.events: dict[str, list[Any]] = {}
        """New messages, which `new` gives once."""
        self.stamps: dict[str, int] = {}
        """Times [ns] that `stamp` gives."""
        self.gone: set[str] = set()
        """Roles that are lost."""

    def put(self, topic: str, message: Any, stamp: int | None = None) -> HandInbox:
        """A message that has come over the wire: as decoded, newest and new. Raises CodecError if it does not fit its type."""
        kind = contract().topics[topic].type
        decoded = codec.decode(codec.encode(message, kind), kind)
        self.messages[topic] = decoded
        self.events.setdefault(topic, []).append(decoded)
        if stamp is not None:
            self.stamps[topic] = stamp
        return self

    def receive(self, messages: Mapping[str, Any]) -> HandInbox:
        """What has come for one step, by topic; what was new before is so no longer. Raises CodecError."""
        self.events.clear()
        for topic, message in messages.items():
            self.put(topic, message)
        return self

    def latest(self, topic: str) -> Any:
        """See `service.Inbox`."""
        return self.messages.get(topic)

    def new(self, topic: str) -> list[Any]:
        """See `service.Inbox`."""
        return self.events.pop(topic, [])

    def stamp(self, topic: str) -> int | None:
        """See `service.Inbox`."""
        return self.stamps.get(topic)

    def lost(self, role: str) -> bool:
        """See `service.Inbox`."""
        return role in self.gone
