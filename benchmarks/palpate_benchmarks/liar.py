"""A service that lies: it wraps the default one of a role and changes one field of one topic from a moment on.

    PALPATE_LIE="ft/wrench wrench.force gain 0.3 12.5" palpate run clean --service robot=benchmarks/palpate_benchmarks/liar.py

`palpate_benchmarks.lies` has the cases. The field `message` is the whole message; `displacement,forecast` are two fields.
A sensor lies in all its topics.

| lie | what is sent |
|---|---|
| `frozen`, `zero`, `nan`, `infinite` | the value at the moment; 0; NaN; infinity |
| `gain`, `sign` | times the amount; minus the value |
| `bias`, `drift`, `spike` | plus the amount; plus the amount per second; plus the amount in the first message of each second |
| `noise`, `dead`, `stuck` | plus white noise with the amount as its deviation; this noise alone; it around the present value |
| `permuted` | the values of neighbouring joints |
| `swapped`, `unnormalised` | a quaternion as w x y z; times the amount |
| `late`, `delayed` | the message of the amount [ms] earlier, with its stamp; its field in a message with a new stamp |
| `repeated`, `disordered`, `stale` | the message of the moment; every second one an older one; the stamp is the amount [s] old |
"""

import logging
import os
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass, replace
from itertools import islice
from math import floor
from typing import Any, Final, NamedTuple

import numpy as np

from palpate_bus.contract import contract
from palpate_bus.implementations import create as create_service
from palpate_bus.messages import MS, NS, Message, nanoseconds, time_message
from palpate_bus.messages.codec import numbers
from palpate_bus.service import Inbox, Outbox, Service
from palpate_errors import UserError
from palpate_models.scenario.schema import Services

VARIABLE: Final = "PALPATE_LIE"
INJECTED: Final = "fault_injected: %s"
"""Log message of a service once it has sent a message with its fault, or kept one back."""
WHOLE: Final = "message"
TWINS: Final = {"ft/wrench": "robot/status", "joint_states": "robot/status"}
"""Topics whose fields another one repeats: a lie of the sensor is in both."""
Array = np.ndarray[Any, Any]
_RANDOM: Final = np.random.default_rng(48)
CHANGES: Final[Mapping[str, Callable[[Array, Array, float, float], Array]]] = {
    "frozen": lambda x, first, amount, s: first if first.shape == x.shape else x,
    "zero": lambda x, first, amount, s: 0 * x,
    "nan": lambda x, first, amount, s: np.full_like(x, np.nan),
    "infinite": lambda x, first, amount, s: np.full_like(x, np.inf),
    "gain": lambda x, first, amount, s: amount * x,
    "sign": lambda x, first, amount, s: -x,
    "bias": lambda x, first, amount, s: x + amount,
    "drift": lambda x, first, amount, s: x + amount * s,
    "spike": lambda x, first, amount, s: x + amount,
    "noise": lambda x, first, amount, s: np.asarray(x + amount * _RANDOM.standard_normal(x.shape)),
    "dead": lambda x, first, amount, s: np.asarray(amount * _RANDOM.standard_normal(x.shape)),
    "stuck": lambda x, first, amount, s: np.asarray(first + amount * _RANDOM.standard_normal(x.shape)),
    "permuted": lambda x, first, amount, s: np.roll(x, 1),
    "swapped": lambda x, first, amount, s: np.roll(x.reshape(-1, 4), 1, axis=1).ravel(),
    "unnormalised": lambda x, first, amount, s: amount * x,
}
"""Changed values from: the true ones, those at the moment, the amount, and the time since the moment [s]."""
NOISES: Final = ("noise", "dead", "stuck")
OLDER_KINDS: Final = ("delayed", "late", "disordered")
"""Kinds that send older messages."""
KINDS: Final = (*CHANGES, "delayed", "late", "repeated", "disordered", "stale")


class Lie(NamedTuple):
    """A lie in the messages of a topic."""

    topic: str
    field: str
    kind: str
    amount: float
    at_s: float
    """Simulated time from which on it is sent."""

    @classmethod
    def parse(cls, text: str) -> "Lie":
        """Return the lie of a text with the values of the fields. Raises UserError."""
        with suppress(ValueError):
            topic, path, kind, amount, at_s = text.split()
            if topic in contract().topics and kind in KINDS:
                return cls(topic, path, kind, float(amount), float(at_s))
        raise UserError(f"{VARIABLE} = {text!r}: expected TOPIC FIELD KIND AMOUNT SECONDS; kinds are {', '.join(KINDS)}")

    def __str__(self) -> str:
        return f"{self.topic} {self.field} {self.kind} {self.amount:g} {self.at_s:g}"

    @property
    def role(self) -> str:
        """Role of the liar."""
        return contract().topics[self.topic].producer

    @property
    def topics(self) -> tuple[str, ...]:
        """Topics in which the lie is sent."""
        twin = TWINS.get(self.topic) if self.field not in (WHOLE, "effort") else None
        return (self.topic,) if twin is None else (self.topic, twin)


class LyingTopic:
    """The lie in one topic."""

    def __init__(self, lie: Lie) -> None:
        self._lie, self._at = lie, round(lie.at_s * NS)
        self._past: deque[tuple[int, Message]] = deque()
        """Times [ns] and messages, oldest first, as far back as the lie needs them."""
        self._first: Message | None = None
        self._spikes, self._odd = 0, False
        self.sent = False
        """True once a message was changed or kept back."""

    def messages(self, t: int, sent: list[Message], event: bool) -> list[Message]:
        """Return the messages to send at `t` [ns] instead of `sent`; call it in every step for an event topic."""
        if self._lie.kind == "late" and event:
            return sent if t < self._at else self._late(t, sent)
        return [self._message(t, message) for message in sent]

    def _late(self, t: int, sent: list[Message]) -> list[Message]:
        """Keep the messages of an event topic back; return those that are due, each once."""
        self.sent = self.sent or bool(sent)
        self._past.extend((t, message) for message in sent)
        due = []
        while self._past and self._past[0][0] <= t - self._lie.amount * MS:
            due.append(self._past.popleft()[1])
        return due

    def _message(self, t: int, message: Message) -> Message:
        if self._lie.kind in OLDER_KINDS:
            self._past.append((t, message))
            while len(self._past) > 3 and self._past[1][0] <= t - self._lie.amount * MS:
                self._past.popleft()
        if t < self._at:
            return message
        lied = self._lied(t, message)
        self.sent = self.sent or not _equal(lied, message)
        return lied

    def _lied(self, t: int, message: Message) -> Message:
        lie, past = self._lie, self._past
        self._first = self._first or message
        if lie.kind in CHANGES:
            return self._changed(message, self._first, (t - self._at) / NS)
        if lie.kind == "repeated":
            return self._first
        if lie.kind == "stale":
            return shift_stamp(message, -lie.amount)
        if lie.kind == "disordered":
            self._odd = not self._odd
            return past[-3][1] if self._odd and len(past) > 2 else message
        old = next((one for stamp, one in reversed(past) if stamp <= t - lie.amount * MS), past[0][1])
        return old if lie.kind == "late" else fill(message, lie.field, numbers(old, lie.field))

    def _changed(self, message: Message, first: Message, seconds: float) -> Message:
        """Return the message changed `seconds` after the moment."""
        lie = self._lie
        if lie.kind == "spike":
            spikes = floor(seconds) + 1
            if spikes == self._spikes:
                return message
            self._spikes = spikes
        if lie.field == "data":  # the pixels of an image
            pixels = CHANGES[lie.kind](message.data.view(np.float32), first.data.view(np.float32), lie.amount, seconds)
            return replace(message, data=np.asarray(pixels, np.float32).view(np.uint8))
        changed = message
        for path in lie.field.split(","):
            changed = fill(changed, path, CHANGES[lie.kind](numbers(message, path), numbers(first, path), lie.amount, seconds))
        return changed


def _equal(one: Message, other: Message) -> bool:
    """Return True if all numbers in two messages are equal."""
    names = (field.name for field in fields(one))
    return all(np.array_equal(numbers(one, name), numbers(other, name), equal_nan=True) for name in names)


def shift_stamp(message: Message, seconds: float) -> Message:
    """Return a copy whose stamp is changed by `seconds`."""
    stamp = max(nanoseconds(message.header.stamp) + round(seconds * NS), 0)
    return replace(message, header=replace(message.header, stamp=time_message(stamp)))


def fill(message: Message, path: str, values: Array) -> Message:
    """Return a copy with other numbers at and below a field, in the order of `numbers`."""
    return _with(message, path.split("."), iter(values.tolist()))


def _with(value: Any, path: list[str], values: Iterator[float]) -> Any:
    if isinstance(value, list):
        return [_with(item, path, values) for item in value]
    if path:
        return replace(value, **{path[0]: _with(getattr(value, path[0]), path[1:], values)})
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{field.name: _with(getattr(value, field.name), [], values) for field in fields(value)})
    if isinstance(value, np.ndarray):
        return np.fromiter(islice(values, value.size), float, value.size).astype(value.dtype)
    return value if isinstance(value, str) else type(value)(next(values))


def _in(lie: Lie, topic: str) -> Lie:
    """Return the lie in a topic of the sensor; noise is averaged over the longer period of a twin."""
    periods = contract().topics[lie.topic].period_ms, contract().topics[topic].period_ms
    averaged = (periods[0] / periods[1]) ** 0.5 if lie.kind in NOISES else 1.0
    return lie._replace(topic=topic, amount=averaged * lie.amount)


class Liar(Service):
    """Wraps a service; see the module's description."""

    def __init__(self, service: Service, lie: Lie, on_sent: Callable[[], None]) -> None:
        """`on_sent` is called once, when the first message is changed or kept back."""
        self._service, self._on_sent, self._sent = service, on_sent, False
        self.role = service.role  # type: ignore[misc]  # that of the wrapped service
        self.catches_up = service.catches_up  # type: ignore[misc]
        self._lying = {topic: LyingTopic(_in(lie, topic)) for topic in lie.topics}

    def start(self) -> Outbox:
        """Return the latched messages; a lie in them begins at once."""
        return self._lied(round(1e18), self._service.start())

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Return the messages of the service's step, with the lie."""
        return {topic: message for part in self.parts(t, inbox) for topic, message in part.items()}

    def parts(self, t: int, inbox: Inbox) -> Iterator[Outbox]:
        """Yield the parts of the service's step, with the lie."""
        for outbox in self._service.parts(t, inbox):
            yield self._lied(t, outbox)

    def finish(self) -> Mapping[str, Any]:
        """Finish the service."""
        return self._service.finish()

    def _lied(self, t: int, outbox: Outbox) -> Outbox:
        lied = dict(outbox)
        for topic, lying in self._lying.items():
            event, sent = contract().topics[topic].event, outbox.get(topic, [])
            if messages := lying.messages(t, sent if isinstance(sent, list) else [sent], event):
                lied[topic] = messages if event else messages[0]
            else:
                lied.pop(topic, None)
        if not self._sent and any(lying.sent for lying in self._lying.values()):
            self._sent = True
            self._on_sent()
        return lied


def create(scenario: Any) -> Service:
    """Return the liar of the environment's lie."""
    lie = Lie.parse(os.environ.get(VARIABLE, ""))
    service = create_service(lie.role, getattr(Services(), lie.role, "default"), scenario)
    return Liar(service, lie, lambda: logging.getLogger(__name__).warning(INJECTED, lie))
