"""An inbox filled by hand, for tests of a service's step."""

from __future__ import annotations

from typing import Any


class HandInbox:
    """What a step receives: put messages into its dictionaries, by topic."""

    def __init__(self) -> None:
        self.messages: dict[str, Any] = {}
        """The newest of each topic, which `latest` gives."""
        self.events: dict[str, list[Any]] = {}
        """New messages, which `new` gives once."""
        self.stamps: dict[str, int] = {}
        """Times [ns] that `stamp` gives."""
        self.gone: set[str] = set()
        """Roles that are lost."""

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
