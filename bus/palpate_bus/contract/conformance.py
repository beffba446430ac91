"""Violations of a topic's row by its messages, and the fields and numbers of messages. `port_check` finds violations."""

from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from enum import StrEnum
from math import acos, inf, sqrt
from operator import attrgetter
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from palpate_bus.contract.rows import Topic
from palpate_bus.messages.codec import CodecError, Message, message_type, store
from palpate_bus.messages.stamps import nanoseconds


class ViolationKind(StrEnum):
    """Kinds of violations of a topic's row."""

    TYPE = "type hash"
    SENDER = "sender"
    SILENT = "silent"
    RATE = "rate"
    AGE = "age"
    GAP = "gap"
    STAMP = "stamp"
    FRAME = "frame"
    NAN = "not finite"
    RANGE = "range"
    UNIT = "unit"
    GARBAGE = "garbage"
    NORM = "norm of a quaternion"
    CHANGE = "rate of change"
    FROZEN = "frozen"


@dataclass(frozen=True)
class MessageViolation:
    """A violation by one message of its topic's row."""

    kind: ViolationKind
    field: str
    expected: str
    got: str

    def __str__(self) -> str:
        return f"{self.field or 'message'}: expected {self.expected}, got {self.got}"


QUATERNION = "geometry_msgs/msg/Quaternion"
NORM = (0.98, 1.02)
"""Squared norm of a quaternion."""
FEW = 16
"""Up to this size the values of a field are printed."""
AHEAD_NS = 500_000_000
"""Time [ns] by which a sender's stamp may be ahead of its own time."""


@dataclass(slots=True)
class PastMessages:
    """The messages of one topic that passed at one port."""

    repeats: list[int]
    """Messages in a row in which each field of `varies` repeated."""
    stamp: int = -(2**63)
    message: Message | None = None


def repeats(message: Message, before: Message, path: str) -> bool:
    """Return True if all numbers of a field are as before."""
    return bool(np.array_equal(numbers(message, path), numbers(before, path)))


def turn(now: Message, before: Message) -> float:
    """Return the angle between two orientations, `geometry_msgs/Quaternion` [rad]."""
    a, b = now, before
    cosine = abs(a.x * b.x + a.y * b.y + a.z * b.z + a.w * b.w)
    lengths = sqrt(a.x * a.x + a.y * a.y + a.z * a.z + a.w * a.w) * sqrt(b.x * b.x + b.y * b.y + b.z * b.z + b.w * b.w)
    return 2 * acos(min(cosine / lengths, 1.0))


def broken_past(topic: Topic, past: PastMessages, message: Message, t: int) -> Iterator[MessageViolation]:
    """Yield how a message that is sent or received at `t` [ns] breaks the contract after those before it."""
    stamp, age = nanoseconds(message.header.stamp), topic.max_age_ms or inf
    got = f"{stamp / 1e6:g} ms at {t / 1e6:g} ms"
    if stamp < past.stamp:
        yield MessageViolation(
            ViolationKind.STAMP, "header.stamp", f"at least {past.stamp / 1e6:g} ms, that of the message before", got
        )
    if t - stamp > age * 1e6:
        yield MessageViolation(ViolationKind.AGE, "header.stamp", f"at most {age:g} ms old", got)
    if stamp - t > AHEAD_NS:
        yield MessageViolation(ViolationKind.STAMP, "header.stamp", f"at most {AHEAD_NS / 1e6:g} ms ahead", got)
    compared = all(getattr(message, field) == value for field, value in topic.compared_while.items())
    for path, rate in topic.rates.items() if past.message is not None and compared else ():
        most = rate * (stamp - past.stamp) / 1e9
        if text := _too_fast(message, past.message, path, most):
            allowed = f"a change of {rate:g} {topic.units.get(path, 'rad')} per second"
            got = f"{text}, {(stamp - past.stamp) / 1e6:g} ms apart"
            yield MessageViolation(ViolationKind.CHANGE, path, allowed, got)
    for count, (path, most) in zip(past.repeats, topic.varies.items(), strict=True):
        if count >= most and repeats(message, past.message, path):
            values = numbers(message, path)
            text = f"{values.tolist() if values.size <= FEW else 'the same values'} in {count + 2} messages in a row"
            yield MessageViolation(ViolationKind.FROZEN, path, f"at most {most + 1} equal ones: a live sensor has noise", text)


def _too_fast(message: Message, before: Message, path: str, most: float) -> str:
    """Return the values of a field that changes by more than `most`, and those before; empty if it does not."""
    if leaves(message.__msgtype__, path)[0].message == QUATERNION:
        turned = turn(attrgetter(path)(message), attrgetter(path)(before))
        return "" if turned <= most else f"{turned:g} rad from the one before"
    now, then = numbers(message, path), numbers(before, path)
    worst = int(np.argmax(np.abs(now - then))) if now.size else 0
    return "" if not now.size or abs(now[worst] - then[worst]) <= most else f"{now[worst]:g} after {then[worst]:g}"


@dataclass(frozen=True)
class LeafField:
    """A field of a base type, at any depth of a message type."""

    path: str
    base: str
    """Type of the field or of its items: `float64`, `string`."""
    array: bool
    """The field is an array."""
    repeated: bool
    """The path contains a sequence of messages."""
    message: str = ""
    """Type of the message that has the field."""


def leaves(type_name: str, path: str = "") -> list[LeafField]:
    """Return the fields of base type at and below `path` in a message type: `wrench.force` gives x, y and z.

    Raises CodecError if the type has no such field.
    """
    message_type(type_name)
    found = [leaf for leaf in _leaves(type_name) if not path or f"{leaf.path}.".startswith(f"{path}.")]
    if path and not found:
        raise CodecError(f"{type_name} has no field {path!r}: its fields are {sorted(leaf.path for leaf in _leaves(type_name))}")
    return found


def _leaves(type_name: str, path: str = "", repeated: bool = False) -> Iterator[LeafField]:
    for name, described in store.get_msgdef(type_name).fields:
        description: Any = described
        array = False
        while description[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            description, array = description[1][0], True
        here = f"{path}.{name}" if path else name
        if description[0] == Nodetype.NAME:
            yield from _leaves(description[1], here, repeated or array)
        else:
            yield LeafField(here, description[1][0], array, repeated, type_name)


def numbers(message: Message, path: str) -> np.ndarray[Any, Any]:
    """Return all numbers at and below a field of a message, shape (n,)."""
    found: list[np.ndarray[Any, Any]] = []
    _collect(message, path.split("."), found)
    return np.concatenate(found) if found else np.zeros(0)


def _collect(value: Any, path: list[str], found: list[np.ndarray[Any, Any]]) -> None:
    if isinstance(value, list):
        for item in value:
            _collect(item, path, found)
    elif path:
        _collect(getattr(value, path[0]), path[1:], found)
    elif is_dataclass(value):
        for field in fields(value):
            _collect(getattr(value, field.name), [], found)
    elif not isinstance(value, str):
        found.append(np.atleast_1d(np.asarray(value, dtype=float)))
