"""A service with a fault: a transport that loses, delays, doubles or changes what the service sends.

    python -m palpate_benchmarks.faulty ROLE planning/setpoint nan 0

runs the service of a role as usual, but from SIGUSR1 on its transport does to this topic what the kind says; the last word is how
many messages it hits, 0 for all from then on. `palpate faults` starts its processes like this.

| kind | what happens |
|---|---|
| `drop` | the message is not sent |
| `delay` | it is sent half a second late, and those after it with it |
| `duplicate` | it is sent twice |
| `corrupt` | sixteen bytes in its middle are inverted |
| `truncate` | it lacks its second half |
| `nan` | every float field in it is NaN |
| `stamp` | its header is stamped an hour ago |
| `jump` | the wall clock of this process is an hour ahead; the topic is `clock` |
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from time import sleep
from typing import Any, Final

import numpy as np
import zenoh

from palpate_benchmarks.fault_kinds import MESSAGE_KINDS
from palpate_bus.contract import Qos, Topic, contract
from palpate_bus.messages import codec
from palpate_bus.messages.stamps import NS
from palpate_bus.run import chosen, run_service
from palpate_bus.wire.transport import Sender, Transport
from palpate_models.scenario.load import load_scenario

DELAY_S: Final = 0.5
PAST_S: Final = 3600
JUMP_NS: Final = 3600 * NS
CORRUPTED_BYTES: Final = 16


@dataclass(frozen=True)
class InjectedFault:
    """What happens to which topic, and when. Raises ValueError for a kind or topic that there is not."""

    topic: str
    kind: str
    count: int = 1
    """How many messages it hits; 0: all from then on."""
    at: int | None = None
    """From this simulated time [ns] on (periodic topics only); None: from SIGUSR1 on."""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"fault {self.kind!r}: want one of {', '.join(KINDS)}")
        if self.kind == "jump":
            known = {"clock"}
        else:
            known = {name for name, row in contract().topics.items() if self.at is None or row.periodic}
        if self.topic not in known:
            raise ValueError(f"fault {self.kind} of topic {self.topic!r}: want one of {', '.join(sorted(known))}")


class FaultyTransport(Transport):
    """A transport that does something wrong once its time has come."""

    def __init__(self, session: zenoh.Session, fault: InjectedFault) -> None:
        super().__init__(session)
        self._fault = fault
        self.struck = False
        """Whether SIGUSR1 has come."""
        if fault.at is None:
            signal.signal(signal.SIGUSR1, self._strike)

    def _strike(self, *_: object) -> None:
        self.struck = True

    def now(self) -> int:
        """The wall time [ns], an hour ahead after a jump."""
        return super().now() + (JUMP_NS if self.struck and self._fault.kind == "jump" else 0)

    def publisher(self, topic: str, key: str, qos: Qos, gid: bytes) -> Sender:
        """The sending end of a topic, faulty if the fault is in that topic."""
        sender = super().publisher(topic, key, qos, gid)
        if topic != self._fault.topic:
            return sender
        return FaultySender(sender, contract().topics[topic], self._fault, lambda: self.struck)


class FaultySender:
    """The sending end of a topic that does something wrong once its time has come."""

    def __init__(self, sender: Sender, topic: Topic, fault: InjectedFault, struck: Callable[[], bool]) -> None:
        self._sender, self._topic, self._fault, self._struck = sender, topic, fault, struck
        self._left = fault.count

    def _due(self, sequence: int) -> bool:
        if self._left == 0 and self._fault.count:
            return False
        at = self._fault.at
        due = self._struck() if at is None else (sequence - 1) * self._topic.period >= at
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
        """Sends the empty message that tests the edge; it is never at fault."""
        self._sender.hello()

    def close(self) -> None:
        """Undeclares it."""
        self._sender.close()


def _corrupt(payload: bytes, topic: Topic) -> bytes:
    begin = len(payload) // 2
    end = begin + CORRUPTED_BYTES
    return payload[:begin] + bytes(byte ^ 0xFF for byte in payload[begin:end]) + payload[end:]


def _truncate(payload: bytes, topic: Topic) -> bytes:
    return payload[: len(payload) // 2]


def _nan(payload: bytes, topic: Topic) -> bytes:
    return codec.encode(_with_nan(codec.decode(payload, topic.type)), topic.type)


def _with_nan(value: Any) -> Any:
    """A copy of the value in which every float is NaN."""
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
KINDS: Final = (*MESSAGE_KINDS, "jump")


def command(role: str, fault: InjectedFault) -> tuple[str, ...]:
    """The command that starts the service of `role` with a fault that SIGUSR1 starts."""
    return ("python", "-m", "palpate_benchmarks.faulty", role, fault.topic, fault.kind, str(fault.count))


def serve(arguments: Sequence[str]) -> None:
    """Runs a service with a fault; see the module's description."""
    role, topic, kind, count = arguments
    fault = InjectedFault(topic, kind, int(count))
    run_service(role, lambda: chosen(role, load_scenario), lambda session: FaultyTransport(session, fault))


if __name__ == "__main__":
    serve(sys.argv[1:])
