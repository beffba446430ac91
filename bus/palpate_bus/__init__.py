"""The bus of Palpate: contract, codec, runtimes. All that a third-party service needs."""

from palpate_bus.service import Inbox, Outbox, Service

__all__ = ["Inbox", "Outbox", "Service"]
