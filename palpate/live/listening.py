"""Listening to one topic, and messages as plain values."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

import numpy as np
import zenoh

from palpate_bus.contract import Topic
from palpate_bus.runs.joining import NoBus
from palpate_bus.wire.rmw import WireError, topic_key, unpack

LONG = 12
"""Arrays of more items than this are shortened for people."""


class Heard(NamedTuple):
    """A message off the wire."""

    sequence: int
    sent: int
    """Source time [ns, wall]."""
    gid: bytes
    payload: bytes


class Listener:
    """Receives every message of a topic from any sender; of a latched topic also the last one before it began."""

    def __init__(self, session: zenoh.Session, topic: Topic, domain: int) -> None:
        self._queue: SimpleQueue[zenoh.Sample] = SimpleQueue()
        self.garbage = 0
        key = topic_key(topic, domain)
        handler = zenoh.handlers.Callback(self._queue.put, indirect=False)
        if topic.latched:
            self._subscriber: Any = zenoh.ext.declare_advanced_subscriber(
                session, key, handler, history=zenoh.ext.HistoryConfig(detect_late_publishers=True)
            )
        else:
            self._subscriber = session.declare_subscriber(key, handler)

    def get(self, timeout: float) -> Heard | None:
        """The next message, None after `timeout` [s]; 0 does not wait."""
        while True:
            try:
                sample = self._queue.get(timeout=timeout) if timeout else self._queue.get_nowait()
            except Empty:
                return None
            try:
                attachment: Any = sample.attachment
                sequence, sent, gid = unpack(attachment.to_bytes())
            except (WireError, AttributeError):
                self.garbage += 1
                continue
            return Heard(sequence, sent, gid, sample.payload.to_bytes())

    def take(self) -> Heard | None:
        """The next message, None when none waits."""
        return self.get(0)

    def close(self) -> None:
        """Stops listening."""
        self._subscriber.undeclare()


def plain(message: Any, *, full: bool, path: str | None = None) -> Any:
    """A message, or its field `path`, as values that YAML and JSON know. Without `full` long arrays are shortened.

    Raises NoBus naming the fields there are when it has no such field.
    """
    for name in (path or "").split(".") if path else []:
        names = [field.name for field in fields(message)] if is_dataclass(message) else []
        if name not in names:
            raise NoBus(f"no field {path!r}: no {name!r} among {', '.join(names) or 'nothing (it is a value)'}")
        message = getattr(message, name)
    return _plain(message, full)


def _plain(value: Any, full: bool) -> Any:
    if is_dataclass(value):
        # Constants of the type are fields of its dataclass too, in capitals.
        names = [field.name for field in fields(value) if not field.name.isupper() and field.name != "__msgtype__"]
        return {name: _plain(getattr(value, name), full) for name in names}
    if isinstance(value, np.ndarray | list | tuple):
        items = [_plain(item, full) for item in (value if full else value[:LONG])]
        return items if len(items) == len(value) else [*items, f"... {len(value)} items"]
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, float):
        return float(value)
    return value
