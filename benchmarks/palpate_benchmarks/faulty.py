"""Service with a fault: its transport drops, delays, duplicates or changes messages.

    python -m palpate_benchmarks.faulty ROLE planning/setpoint nan 0

runs the service of a role. From SIGUSR1 on the fault affects messages of the topic; the last argument is the number of affected
messages, 0 for all. `palpate faults` starts its processes in this way.

| kind | effect |
|---|---|
| `drop` | the message is not sent |
| `delay` | the message and those after it are sent half a second late |
| `duplicate` | the message is sent twice |
| `corrupt` | sixteen bytes in the middle are inverted |
| `truncate` | the second half is missing |
| `nan` | every float field is NaN |
| `stamp` | the header is stamped an hour ago |
| `jump` | the wall clock of this process is an hour ahead; the topic is `clock` |
"""

import logging
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import sleep

import numpy as np
import zenoh

from palpate_benchmarks.liar import INJECTED, fill, shift_stamp
from palpate_bus.contract import Qos, Topic, contract
from palpate_bus.messages import NS, codec
from palpate_bus.messages.codec import leaves, numbers
from palpate_bus.run import load_service, run_service
from palpate_bus.wire.transport import Sender, Transport
from palpate_models.scenario.load import load_scenario

PAST_S = 3600
JUMP_NS = 3600 * NS


@dataclass(frozen=True)
class InjectedFault:
    """Fault in the messages of one topic."""

    topic: str
    kind: str
    count: int = 1
    """Number of affected messages; 0: all."""
    at: int | None = None
    """Simulated time [ns] of the first affected message (periodic topics only); None: from SIGUSR1 on."""


class FaultyTransport(Transport):
    """Transport with a fault."""

    def __init__(self, session: zenoh.Session, fault: InjectedFault) -> None:
        super().__init__(session)
        self._fault = fault
        self.triggered = False
        """True after SIGUSR1."""
        if fault.at is None:
            signal.signal(signal.SIGUSR1, self._trigger)

    def _trigger(self, *_: object) -> None:
        self.triggered = True

    def now(self) -> int:
        """Return the wall time [ns], an hour ahead after a jump."""
        return super().now() + (JUMP_NS if self.triggered and self._fault.kind == "jump" else 0)

    def publisher(self, topic: str, key: str, qos: Qos, gid: bytes) -> Sender:
        """Return the sender of a topic, a faulty one if the fault is in that topic."""
        sender = super().publisher(topic, key, qos, gid)
        if topic != self._fault.topic:
            return sender
        return FaultySender(sender, contract().topics[topic], self._fault, lambda: self.triggered)


class FaultySender:
    """Sender of a topic with a fault."""

    def __init__(self, sender: Sender, topic: Topic, fault: InjectedFault, triggered: Callable[[], bool]) -> None:
        self._sender, self._topic, self._fault, self._triggered = sender, topic, fault, triggered
        self._left = fault.count
        self._injected = False

    def put(self, payload: bytes, sequence: int) -> None:
        """Send a message, with the fault if it is due."""
        at = self._fault.at
        due = self._triggered() if at is None else (sequence - 1) * self._topic.period >= at
        if not due or (self._left == 0 and self._fault.count):
            self._sender.put(payload, sequence)
            return
        self._left -= 1
        kind = self._fault.kind
        sent = CHANGES[kind](payload, self._topic) if kind in CHANGES else payload
        if not self._injected and (kind not in CHANGES or sent != payload):
            self._injected = True
            logging.getLogger(__name__).warning(INJECTED, f"{kind} {self._topic.name}")
        if kind == "drop":
            return
        if kind == "delay":
            sleep(0.5)
        self._sender.put(sent, sequence)
        if kind == "duplicate":
            self._sender.put(sent, sequence)

    def hello(self) -> None:
        """Send the empty message that tests the edge; the fault does not affect it."""
        self._sender.hello()


def _corrupt(payload: bytes, topic: Topic) -> bytes:
    begin = len(payload) // 2
    end = begin + 16
    return payload[:begin] + bytes(byte ^ 0xFF for byte in payload[begin:end]) + payload[end:]


def _nan(payload: bytes, topic: Topic) -> bytes:
    message = codec.decode(payload, topic.type)
    for leaf in leaves(topic.type):
        if leaf.base.startswith("float"):
            message = fill(message, leaf.path, np.full_like(numbers(message, leaf.path), np.nan))
    return codec.encode(message, topic.type)


def _stamp(payload: bytes, topic: Topic) -> bytes:
    message = codec.decode(payload, topic.type)
    return codec.encode(shift_stamp(message, -PAST_S), topic.type) if hasattr(message, "header") else payload


CHANGES = {"corrupt": _corrupt, "truncate": lambda payload, _: payload[: len(payload) // 2], "nan": _nan, "stamp": _stamp}


def command(role: str, fault: InjectedFault) -> tuple[str, ...]:
    """Return the command that starts the service of `role` with a fault that SIGUSR1 triggers."""
    return ("python", "-m", "palpate_benchmarks.faulty", role, fault.topic, fault.kind, str(fault.count))


def serve(arguments: Sequence[str]) -> None:
    """Run a service with a fault; see the module's description."""
    role, topic, kind, count = arguments
    fault = InjectedFault(topic, kind, int(count))
    run_service(role, lambda: load_service(role, load_scenario), lambda session: FaultyTransport(session, fault))


if __name__ == "__main__":
    serve(sys.argv[1:])
