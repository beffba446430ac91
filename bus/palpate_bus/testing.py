"""An inbox filled by hand, for tests and benches of a service's step."""

from collections.abc import Mapping
from typing import Any

from palpate_bus.contract import contract
from palpate_bus.messages import codec


class HandInbox:
    """The input of a step: `put` messages into it, or fill its dictionaries by topic."""

    def __init__(self) -> None:
        self.messages: dict[str, Any] = {}
        """Newest message of each topic, see `latest`."""
        self.events: dict[str, list[Any]] = {}
        """New messages, returned once by `new`."""
        self.stamps: dict[str, int] = {}
        """Times [ns], see `stamp`."""
        self.gone: set[str] = set()
        """Lost roles."""

    def put(self, topic: str, message: Any, stamp: int | None = None) -> "HandInbox":
        """Add a message, encoded and decoded, as newest and new. Raises CodecError if it does not fit its type."""
        kind = contract().topics[topic].type
        decoded = codec.decode(codec.encode(message, kind), kind)
        self.messages[topic] = decoded
        self.events.setdefault(topic, []).append(decoded)
        if stamp is not None:
            self.stamps[topic] = stamp
        return self

    def receive(self, messages: Mapping[str, Any]) -> "HandInbox":
        """Replace the new messages by those of one step, by topic. Raises CodecError."""
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
