"""Faults on purpose: what a service sends is delayed, dropped, duplicated, corrupted or changed before it leaves its process.

| variable | example | meaning |
|---|---|---|
| `PALPATE_FAULT` | `planning/setpoint:nan` | topic and kind; nothing is ever wrapped without it |
| `PALPATE_FAULT_AT` | `signal` (default) or `7.5` | from SIGUSR1 on, or from that simulated second on (periodic topics) |
| `PALPATE_FAULT_COUNT` | 1 | how many messages it hits; 0 for all from then on |

| kind | what happens |
|---|---|
| `drop` | the message is not sent |
| `delay` | it is sent half a second late, and those after it with it |
| `duplicate` | it is sent twice |
| `corrupt` | bytes in its middle are turned over |
| `truncate` | it lacks its second half |
| `nan` | every float field in it is NaN |
| `stamp` | its header is stamped an hour ago |
| `jump` | topic `clock`: this process's wall clock is an hour ahead |

Used by `palpate faults`, which says what came of each.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from time import sleep, time_ns
from types import FrameType
from typing import Any, Final, Protocol

import numpy as np

from palpate_bus.contract import Topic, contract
from palpate_bus.messages import codec

DELAY_S: Final = 0.5
PAST_S: Final = 3600
JUMP_NS: Final = 3600 * 1_000_000_000
NS: Final = 1_000_000_000


class Sender(Protocol):
    """What is wrapped: `transport.Publisher`."""

    def put(self, payload: bytes, sequence: int) -> None:
        """Sends a message."""

    def hello(self) -> None:
        """Tests the edge."""

    def close(self) -> None:
        """Undeclares it."""


class FaultError(ValueError):
    """PALPATE_FAULT that cannot be used. Names it and what is allowed."""


@dataclass(frozen=True)
class Fault:
    """What is to happen to which topic, and when."""

    topic: str
    kind: str
    at: int | None = None
    """From this simulated time [ns] on; None: from SIGUSR1 on."""
    count: int = 1

    @classmethod
    def from_env(cls, environ: Mapping[str, str] = os.environ) -> Fault | None:
        """The fault that the environment asks for, None without one. Raises FaultError."""
        text = environ.get("PALPATE_FAULT")
        if not text:
            return None
        topic, _, kind = text.rpartition(":")
        if not topic or kind not in (*CHANGES, "drop", "delay", "duplicate", "jump"):
            raise FaultError(f"PALPATE_FAULT is {text!r}; want TOPIC:KIND with a kind out of {', '.join(KINDS)}")
        if topic not in contract().topics and (topic, kind) != ("clock", "jump"):
            raise FaultError(f"PALPATE_FAULT is {text!r}: there is no topic {topic}; want one of {', '.join(contract().topics)}")
        when = environ.get("PALPATE_FAULT_AT", "signal")
        if when != "signal" and (kind == "jump" or not contract().topics[topic].periodic):
            raise FaultError(f"PALPATE_FAULT_AT is {when!r}: {text} begins by signal only, its messages tell no time")
        try:
            at = None if when == "signal" else round(float(when) * NS)
            count = int(environ.get("PALPATE_FAULT_COUNT", "1"))
        except ValueError as error:
            raise FaultError(f"PALPATE_FAULT_AT or PALPATE_FAULT_COUNT: {error}") from error
        return cls(topic, kind, at, count)


class _Trigger:
    """SIGUSR1, which only sets a flag."""

    def __init__(self) -> None:
        self.pulled = False
        self._then: list[Callable[[], None]] = []
        signal.signal(signal.SIGUSR1, self._pull)

    def _pull(self, number: int, frame: FrameType | None) -> None:
        self.pulled = True
        for action in self._then:
            action()

    def then(self, action: Callable[[], None]) -> None:
        self._then.append(action)


class FaultySender:
    """A publisher that does something wrong once its time has come."""

    def __init__(self, sender: Sender, topic: Topic, fault: Fault, trigger: _Trigger | None) -> None:
        self._sender, self._topic, self._fault, self._trigger = sender, topic, fault, trigger
        self._left = fault.count

    def _due(self, sequence: int) -> bool:
        if self._left == 0 and self._fault.count:
            return False
        reached = (sequence - 1) * self._topic.period >= (self._fault.at or 0)
        due = reached if self._trigger is None else self._trigger.pulled
        if due and self._fault.count:
            self._left -= 1
        return due

    def put(self, payload: bytes, sequence: int) -> None:
        """Sends a message, or what the fault makes of it."""
        if not self._due(sequence):
            self._sender.put(payload, sequence)
            return
        kind = self._fault.kind
        if kind == "drop":
            return
        if kind == "delay":
            sleep(DELAY_S)
        if kind in CHANGES:
            payload = CHANGES[kind](payload, self._topic)
        self._sender.put(payload, sequence)
        if kind == "duplicate":
            self._sender.put(payload, sequence)

    def hello(self) -> None:
        """Tests the edge."""
        self._sender.hello()

    def close(self) -> None:
        """Undeclares it."""
        self._sender.close()


def _corrupt(payload: bytes, topic: Topic) -> bytes:
    """Turns over sixteen bytes from the middle on."""
    middle = len(payload) // 2
    return payload[:middle] + bytes(b ^ 0xFF for b in payload[middle : middle + 16]) + payload[middle + 16 :]


def _truncate(payload: bytes, topic: Topic) -> bytes:
    return payload[: len(payload) // 2]


def _nan(payload: bytes, topic: Topic) -> bytes:
    return codec.encode(_with_nan(codec.decode(payload, topic.type)), topic.type)


def _with_nan(value: Any) -> Any:
    """The value with every float in it replaced, copied where need be."""
    if isinstance(value, float):
        return float("nan")
    if isinstance(value, np.ndarray):
        return np.full_like(value, np.nan) if value.dtype.kind == "f" else value
    if isinstance(value, list):
        return [_with_nan(item) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in fields(value) if not field.name.startswith("__")]
        return type(value)(**{name: _with_nan(getattr(value, name)) for name in names})
    return value


def _stamp(payload: bytes, topic: Topic) -> bytes:
    message = codec.decode(payload, topic.type)
    if not hasattr(message, "header"):
        return payload
    message.header.stamp.sec -= PAST_S
    return codec.encode(message, topic.type)


CHANGES: Final[dict[str, Callable[[bytes, Topic], bytes]]] = {
    "corrupt": _corrupt,
    "truncate": _truncate,
    "nan": _nan,
    "stamp": _stamp,
}
KINDS: Final = ("delay", "drop", "duplicate", *CHANGES, "jump")
_trigger: _Trigger | None = None


def _pulled_by_signal(fault: Fault) -> _Trigger | None:
    global _trigger  # noqa: PLW0603  # one signal, one handler a process
    if fault.at is not None:
        return None
    if _trigger is None:
        _trigger = _Trigger()
        if fault.kind == "jump":
            _trigger.then(_jump)
    return _trigger


def _jump() -> None:
    """Sets this process's wall clock ahead, where the bus reads it."""
    from palpate_bus.runtime import distributed, wallclock  # noqa: PLC0415 - only a faulty process needs them
    from palpate_bus.wire import transport  # noqa: PLC0415

    def ahead() -> int:
        return time_ns() + JUMP_NS

    for module in (transport, wallclock, distributed):
        if hasattr(module, "time_ns"):
            setattr(module, "time_ns", ahead)  # noqa: B010  # mypy knows no such attribute to assign


def faulty(sender: Any, topic: Topic) -> Any:
    """The sender itself, or wrapped when PALPATE_FAULT is for its topic."""
    fault = Fault.from_env()
    if fault is None:
        return sender
    trigger = _pulled_by_signal(fault)
    return FaultySender(sender, topic, fault, trigger) if fault.topic == topic.name else sender
