"""Checks messages against their row of the contract: class, stamp, frame, ranges, finite numbers.

`Checker` is fast enough for every message of a live run; `violations` returns the same as text, for tests. A value that is out of
range but plausible in a related unit (degrees for radians, millimetres for metres) is reported as a unit error.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, is_dataclass
from enum import StrEnum
from math import hypot, inf, isfinite
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
    for path, rate in topic.rates.items() if past.message is not None else ():
        now, before = numbers(message, path), numbers(past.message, path)
        most, k = rate * (stamp - past.stamp) / 1e9, int(np.argmax(np.abs(now - before)))
        if not abs(now[k] - before[k]) <= most:
            text = f"{now[k]:g} after {before[k]:g}, {(stamp - past.stamp) / 1e6:g} ms apart"
            yield MessageViolation(ViolationKind.CHANGE, path, f"a change of {rate:g} {topic.units[path]} per second", text)
    for count, (path, most) in zip(past.repeats, topic.varies.items(), strict=True):
        if count >= most and repeats(message, past.message, path):
            values = numbers(message, path)
            text = f"{values.tolist() if values.size <= _FEW else 'the same values'} in {count + 2} messages in a row"
            yield MessageViolation(ViolationKind.FROZEN, path, f"at most {most + 1} equal ones: a live sensor has noise", text)


_FEW = 16
"""Up to this size a loop in Python is faster than numpy."""
_CONFUSED: dict[str, tuple[tuple[str, float], ...]] = {
    "rad": (("deg", np.pi / 180),),
    "rad/s": (("deg/s", np.pi / 180),),
    "m": (("mm", 1e-3),),
    "m/s": (("mm/s", 1e-3),),
}
"""Units that are often confused with the key, with their conversion factor."""


class Checker:
    """Checks the messages of one topic."""

    def __init__(self, topic: Topic) -> None:
        self._frame = topic.frame
        self._type = message_type(topic.type)
        names = store.get_msgdef(topic.type).fields
        self._headers: Callable[[Message], list[Any]] = _no_headers
        if any(name == "header" for name, _ in names):
            self._headers = _own_header
        elif any(name == "transforms" for name, _ in names):
            self._headers = _headers_of_transforms
        self._quaternions = [
            leaf.path[:-2] for leaf in leaves(topic.type) if leaf.message == QUATERNION and leaf.path.endswith(".w")
        ]
        self._ranges: list[tuple[str, _Reader, float, float, str]] = []
        seen: set[str] = set()
        for path, (least, most) in topic.ranges.items():
            under = [leaf for leaf in leaves(topic.type, path) if leaf.base != "string"]
            seen.update(leaf.path for leaf in under)
            self._ranges.append((path, _Reader(under), least, most, topic.units.get(path, "1")))
        rest = [leaf for leaf in leaves(topic.type) if leaf.base.startswith("float") and leaf.path not in seen]
        self._finite = [(leaf.path, _Reader([leaf])) for leaf in rest]

    def __call__(self, message: Message, t: int | None = None) -> list[MessageViolation]:
        """Return the violations of a message. `t`: expected stamp of its headers [ns]; None: not checked."""
        if message.__class__ is not self._type:
            got = getattr(message, "__msgtype__", message.__class__.__name__)
            return [MessageViolation(ViolationKind.TYPE, "", self._type.__msgtype__, got)]
        found = []
        if self._frame is not None:
            for header in self._headers(message):
                if header.frame_id != self._frame:
                    found.append(
                        MessageViolation(ViolationKind.FRAME, "header.frame_id", repr(self._frame), repr(header.frame_id))
                    )
                    break
        if t is not None:
            for header in self._headers(message):
                if nanoseconds(header.stamp) != t:
                    got = f"{nanoseconds(header.stamp)} ns"
                    found.append(MessageViolation(ViolationKind.STAMP, "header.stamp", f"{t} ns", got))
                    break
        for path, reader, least, most, unit in self._ranges:
            if not reader.within(message, least, most):
                found.append(_out_of_range(path, reader.values(message), least, most, unit))
        for path, reader in self._finite:
            if not reader.finite(message):
                values = reader.values(message)
                found.append(MessageViolation(ViolationKind.NAN, path, "finite numbers", f"{values[~np.isfinite(values)][0]:g}"))
        return found + list(self._forms(message))

    def _forms(self, message: Message) -> Iterator[MessageViolation]:
        """Yield what is wrong with quaternions."""
        for path in self._quaternions:
            values = numbers(message, path).reshape(-1, 4)
            norm = [hypot(*one) for one in values.tolist()]
            wrong = [k for k, one in enumerate(norm) if not NORM[0] <= one * one <= NORM[1]]
            if wrong:
                got = f"{values[wrong[0]].tolist()} with norm {norm[wrong[0]]:g}"
                yield MessageViolation(ViolationKind.NORM, path, "a norm of 1", got)

    def stamp(self, message: Message) -> int | None:
        """Return the stamp [ns] of the message's header or of its first transform; None without a header."""
        for header in self._headers(message):
            return nanoseconds(header.stamp)
        return None


def violations(topic: Topic, message: Message, t: int | None = None) -> list[str]:
    """Return the violations of a message as text. `t` as for `Checker`."""
    return [f"{topic.name}: {violation}" for violation in Checker(topic)(message, t)]


def _out_of_range(path: str, values: np.ndarray[Any, Any], least: float, most: float, unit: str) -> MessageViolation:
    wrong = values[~((values >= least) & (values <= most))]
    allowed = f"{least:g}..{most:g} [{unit}]"
    unfit = wrong[~np.isfinite(wrong)]
    if unfit.size:
        return MessageViolation(ViolationKind.NAN, path, allowed, f"{unfit[0]:g}")
    for name, factor in _CONFUSED.get(unit, ()):
        if np.all((values * factor >= least) & (values * factor <= most)):
            return MessageViolation(ViolationKind.UNIT, path, allowed, f"{wrong[0]:g}, plausible if it is in {name}")
    return MessageViolation(ViolationKind.RANGE, path, allowed, f"{wrong[0]:g}")


def _no_headers(_: Message) -> list[Any]:
    return []


def _own_header(message: Message) -> list[Any]:
    return [message.header]


def _headers_of_transforms(message: Message) -> list[Any]:
    return [transform.header for transform in message.transforms]


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


class _Reader:
    """Reads fields of base type: scalars and arrays directly, fields in sequences of messages one by one."""

    def __init__(self, chosen: list[LeafField]) -> None:
        self._paths = [leaf.path for leaf in chosen]
        scalars = [leaf.path for leaf in chosen if not leaf.array and not leaf.repeated]
        self._scalars: Any = attrgetter(*scalars) if scalars else None
        self._single = len(scalars) == 1
        self._arrays = [attrgetter(leaf.path) for leaf in chosen if leaf.array and not leaf.repeated]
        self._nested = [leaf.path for leaf in chosen if leaf.repeated]

    def within(self, message: Message, least: float, most: float) -> bool:
        """Return True if all numbers are in the closed range; NaN is outside."""
        if self._scalars is not None:
            values = self._scalars(message)
            for value in (values,) if self._single else values:
                if not least <= value <= most:
                    return False
        for array in self._each_array(message):
            if array.size <= _FEW:
                if not all(least <= value <= most for value in array.tolist()):
                    return False
            elif not (least <= array.min() and array.max() <= most):
                return False
        return True

    def finite(self, message: Message) -> bool:
        """Return True if all numbers are finite."""
        if self._scalars is not None:
            values = self._scalars(message)
            if not (isfinite(values) if self._single else all(map(isfinite, values))):
                return False
        for array in self._each_array(message):
            if not (all(map(isfinite, array.tolist())) if array.size <= _FEW else np.isfinite(array).all()):
                return False
        return True

    def values(self, message: Message) -> np.ndarray[Any, Any]:
        """Return all numbers, shape (n,)."""
        return np.concatenate([numbers(message, path) for path in self._paths])

    def _each_array(self, message: Message) -> Iterator[np.ndarray[Any, Any]]:
        for get in self._arrays:
            yield np.asarray(get(message))
        for path in self._nested:
            yield numbers(message, path)
