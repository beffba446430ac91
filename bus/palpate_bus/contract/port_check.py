"""The check of every message at a port, generated from the topic's row of the contract.

A message is checked by itself (type, frame, ranges, finite numbers, unit quaternions) and against those before it at the
same port (order and age of stamps, rates of change, values that repeat). The runtimes hold one `PortCheck` per port: where a
service sends, and where it receives (in lockstep when the service first reads the message; unread ones are not checked). In
lockstep a refused message ends the run. In wall-clock mode it is dropped and reported, so readers act as on silence. No service
needs a check of its own.

Each rule is written twice: `_Source` generates the fast test; `Checker` and `check_order` run after it has refused a message, to
name the violation.

`Checker` names what is wrong with a message by itself; `violations` does the same as text. A value that is out of range but
plausible in a related unit (degrees for radians, millimetres for metres) is reported as a unit error.
"""

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from math import acos, dist, hypot, inf
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Nodetype

from palpate_bus.contract import Topic
from palpate_bus.messages import Message, nanoseconds
from palpate_bus.messages.codec import LeafField, leaves, message_type, numbers, store
from palpate_errors import RunError


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


class MessageViolation(NamedTuple):
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
SHOWN = 16
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
    cosine = abs(a.x * b.x + a.y * b.y + a.z * b.z + a.w * b.w) / (hypot(a.x, a.y, a.z, a.w) * hypot(b.x, b.y, b.z, b.w))
    return 2 * acos(min(cosine, 1.0))


def check_order(topic: Topic, past: PastMessages, message: Message, t: int) -> Iterator[MessageViolation]:
    """Yield how a message that is sent or received at `t` [ns] breaks the contract after those before it."""
    stamp, age = nanoseconds(message.header.stamp), topic.max_age_ms or inf
    got = f"{stamp / 1e6:g} ms at {t / 1e6:g} ms"
    if stamp < past.stamp:
        expected = f"at least {past.stamp / 1e6:g} ms, that of the message before"
        yield MessageViolation(ViolationKind.STAMP, "header.stamp", expected, got)
    if t - stamp > age * 1e6:
        yield MessageViolation(ViolationKind.AGE, "header.stamp", f"at most {age:g} ms old", got)
    if stamp - t > AHEAD_NS:
        yield MessageViolation(ViolationKind.STAMP, "header.stamp", f"at most {AHEAD_NS / 1e6:g} ms ahead", got)
    before, conditions = past.message, topic.compared_while.items()
    compared = before is not None and all(getattr(one, key) == value for key, value in conditions for one in (message, before))
    for path, rate in topic.rates.items() if compared else ():
        max_change = rate * (stamp - past.stamp) / 1e9
        if text := _too_fast(message, before, path, max_change):
            allowed = f"a change of {rate:g} {topic.units.get(path, 'rad')} per second"
            got = f"{text}, {(stamp - past.stamp) / 1e6:g} ms apart"
            yield MessageViolation(ViolationKind.CHANGE, path, allowed, got)
    for count, (path, limit) in zip(past.repeats, topic.varies.items(), strict=True):
        if count >= limit and repeats(message, before, path):
            values = numbers(message, path)
            text = f"{values.tolist() if values.size <= SHOWN else 'the same values'} in {count + 2} messages in a row"
            yield MessageViolation(ViolationKind.FROZEN, path, f"at most {limit + 1} equal ones: a live sensor has noise", text)


def _too_fast(message: Message, before: Message, path: str, max_change: float) -> str:
    """Return the values of a field that changes by more than `max_change`, and those before; empty if it does not."""
    if leaves(message.__msgtype__, path)[0].message == QUATERNION:
        turned = turn(attrgetter(path)(message), attrgetter(path)(before))
        return "" if turned <= max_change else f"{turned:g} rad from the one before"
    now, then = numbers(message, path), numbers(before, path)
    if not now.size or not then.size:
        return ""
    worst = int(np.argmax(np.abs(now - then)))
    return "" if abs(now[worst] - then[worst]) <= max_change else f"{now[worst]:g} after {then[worst]:g}"


FEW = 32
"""Up to this number of values a loop in Python is faster than numpy."""
_NO_PAST = PastMessages([])


class RefusedMessage(RunError):
    """A message that breaks its row of the contract. Names topic, sender, field, value and what is allowed."""

    def __init__(self, topic: Topic, violation: MessageViolation, message: Message) -> None:
        self.topic, self.role = topic.name, topic.producer
        self.violation = violation
        self.message = message
        what = f"{violation.field or 'message'} = {violation.got}; allowed: {violation.expected}"
        super().__init__(f"{topic.name} from {topic.producer} refused: {what}")


class PortCheck:
    """Check of the messages of one topic at one port."""

    __slots__ = ("_topic", "conforms", "past")

    def __init__(self, topic: Topic, sends: bool = False) -> None:
        """`sends`: stamps must be of the sender's present."""
        self._topic = topic
        self.conforms = compile_check(topic.model_dump_json(), sends)
        self.past = PastMessages([0] * len(topic.varies))

    def __call__(self, message: Message, t: int) -> None:
        """Raise RefusedMessage if the message breaks the contract. `t`: time at the port [ns]."""
        if not self.conforms(message, self.past, t):
            raise RefusedMessage(self._topic, self._violation(message, t), message)

    def _violation(self, message: Message, t: int) -> MessageViolation:
        try:
            alone = Checker(self._topic)(message)
            return alone[0] if alone else next(check_order(self._topic, self.past, message, t))
        except Exception as error:  # a field has a value of another type
            return MessageViolation(ViolationKind.TYPE, "", self._topic.type, str(error) or "a field of another type")


_CONFUSED = {"rad": ("deg", np.pi / 180), "rad/s": ("deg/s", np.pi / 180), "m": ("mm", 1e-3), "m/s": ("mm/s", 1e-3)}
"""The unit that is often confused with the key, with its conversion factor."""


class Checker:
    """Names the violations of the messages of one topic, each by itself. Fast for messages that conform."""

    def __init__(self, topic: Topic) -> None:
        self._topic, self._conforms = topic, compile_check(topic.model_dump_json(), sends=False, alone=True)
        self._all = leaves(topic.type)
        self._ranges = {path: _paths(leaves(topic.type, path)) for path in topic.ranges}
        ranged = {path for paths in self._ranges.values() for path in paths}
        self._finite = [leaf.path for leaf in self._all if leaf.base.startswith("float") and leaf.path not in ranged]

    def __call__(self, message: Message) -> list[MessageViolation]:
        """Return the violations of a message."""
        return [] if self._conforms(message, _NO_PAST, 0) else list(self._violations(message))

    def _violations(self, message: Message) -> Iterator[MessageViolation]:
        topic, kind = self._topic, message_type(self._topic.type)
        if message.__class__ is not kind:
            got = getattr(message, "__msgtype__", message.__class__.__name__)
            yield MessageViolation(ViolationKind.TYPE, "", kind.__msgtype__, got)
            return
        frames = [header.frame_id for header in _headers(message)] if topic.frame is not None else []
        if wrong := [frame for frame in frames if frame != topic.frame]:
            yield MessageViolation(ViolationKind.FRAME, "header.frame_id", repr(topic.frame), repr(wrong[0]))
        for path, paths in self._ranges.items():
            values = np.concatenate([numbers(message, one) for one in paths])
            if not np.all((values >= topic.ranges[path][0]) & (values <= topic.ranges[path][1])):
                yield _out_of_range(path, values, *topic.ranges[path], topic.units.get(path, "1"))
        for path in self._finite:
            values = numbers(message, path)
            if not np.isfinite(values).all():
                yield MessageViolation(ViolationKind.NAN, path, "finite numbers", f"{values[~np.isfinite(values)][0]:g}")
        for path in (leaf.path[:-2] for leaf in self._all if leaf.message == QUATERNION and leaf.path.endswith(".w")):
            values = numbers(message, path).reshape(-1, 4)
            norm = [hypot(*one) for one in values.tolist()]
            if off := [k for k, one in enumerate(norm) if not NORM[0] <= one * one <= NORM[1]]:
                got = f"{values[off[0]].tolist()} with norm {norm[off[0]]:g}"
                yield MessageViolation(ViolationKind.NORM, path, "a norm of 1", got)

    def stamp(self, message: Message) -> int | None:
        """Return the stamp [ns] of the message's header or of its first transform; None without a header."""
        return next((nanoseconds(header.stamp) for header in _headers(message)), None)


def _paths(fields: list[LeafField]) -> list[str]:
    return [leaf.path for leaf in fields if leaf.base != "string"]


def _headers(message: Message) -> list[Any]:
    if hasattr(message, "header"):
        return [message.header]
    return [transform.header for transform in getattr(message, "transforms", ())]


def violations(topic: Topic, message: Message) -> list[str]:
    """Return the violations of a message as text."""
    return [f"{topic.name}: {violation}" for violation in Checker(topic)(message)]


def _out_of_range(path: str, values: np.ndarray[Any, Any], low: float, high: float, unit: str) -> MessageViolation:
    wrong = values[~((values >= low) & (values <= high))]
    allowed = f"{low:g}..{high:g} [{unit}]"
    unfit = wrong[~np.isfinite(wrong)]
    if unfit.size:
        return MessageViolation(ViolationKind.NAN, path, allowed, f"{unfit[0]:g}")
    name, factor = _CONFUSED.get(unit, ("", np.nan))
    if np.all((values * factor >= low) & (values * factor <= high)):
        return MessageViolation(ViolationKind.UNIT, path, allowed, f"{wrong[0]:g}, plausible if it is in {name}")
    return MessageViolation(ViolationKind.RANGE, path, allowed, f"{wrong[0]:g}")


def _none(path: str) -> str:
    """Return the source of a test for an array that has no numbers, as those of what an arm does not measure."""
    return f"not m.{path}.size or not before.{path}.size"


@cache
def compile_check(row: str, sends: bool, alone: bool = False) -> Callable[[Message, PastMessages, int], bool]:
    """Return a function that is True for a message that conforms to its topic, a row as JSON, and keeps it for comparison.

    `alone`: without the past.
    """
    topic = Topic.model_validate_json(row)
    body = list(_Source(topic, sends, alone).lines())
    text = "\n".join(
        ("def conforms(m, past, t):", " try:", *(f"  {line}" for line in body), " except Exception: return False", " return True")
    )
    functions = {"array": np.asarray, "equal": np.array_equal, "repeats": repeats, "turn": turn, "hypot": hypot, "dist": dist}
    names: dict[str, Any] = {**functions, "Array": np.ndarray, "Type": message_type(topic.type), "frame": topic.frame}
    exec(compile(text, f"<check of {topic.name}>", "exec"), names)
    check: Callable[[Message, PastMessages, int], bool] = names["conforms"]
    return check


class _Source:
    """Writes the lines of a check."""

    def __init__(self, topic: Topic, sends: bool, alone: bool) -> None:
        self._topic = topic
        self._sends, self._alone = sends, alone
        self._count = 0

    def lines(self) -> Iterator[str]:
        yield "if m.__class__ is not Type: return False"
        names = [name for name, _ in store.get_msgdef(self._topic.type).fields]
        if self._topic.frame is not None and "header" in names:
            yield "if m.header.frame_id != frame: return False"
        elif self._topic.frame is not None and "transforms" in names:
            yield "for one in m.transforms:"
            yield " if one.header.frame_id != frame: return False"
        yield from self._message(self._topic.type, "m", "")
        if not self._alone and "header" in names and (self._topic.periodic or self._topic.max_age_ms):
            yield from self._past()

    def _past(self) -> Iterator[str]:
        """Yield the lines that compare a message with those before it."""
        topic = self._topic
        yield "stamp = m.header.stamp"
        yield "stamp = stamp.sec * 1000000000 + stamp.nanosec"
        old = f"t - stamp > {topic.max_age}" if topic.max_age_ms else "False"
        yield f"if stamp <= past.stamp and (stamp < past.stamp or {old}): return False"
        if self._sends:
            yield f"if stamp != t and (stamp > t + {AHEAD_NS} or {old}): return False"
        lines = [*self._rates(), *self._varies()]
        if lines:
            same = "".join(f" and m.{field} == before.{field} == {value!r}" for field, value in topic.compared_while.items())
            yield from ("before = past.message", f"if before is not None{same}:", *(f" {line}" for line in lines))
            if same:
                yield from ("else:", f" past.repeats = {[0] * len(topic.varies)}")
            yield "past.message = m"
        yield "past.stamp = stamp"

    def _rates(self) -> Iterator[str]:
        """Yield the lines that compare fields with those of the message before."""
        for path, rate in self._topic.rates.items():
            yield f"max_change = {rate * 1e-9!r} * (stamp - past.stamp)"
            if leaves(self._topic.type, path)[0].message == QUATERNION:
                yield f"if not turn(m.{path}, before.{path}) <= max_change: return False"
                continue
            for leaf in leaves(self._topic.type, path):
                if leaf.array:
                    yield f"if {_none(leaf.path)}: pass"
                    yield f"elif not dist(m.{leaf.path}.tolist(), before.{leaf.path}.tolist()) <= max_change:"
                    yield f" for one in (m.{leaf.path} - before.{leaf.path}).tolist():"
                    yield "  if not -max_change <= one <= max_change: return False"
                else:
                    yield f"if not -max_change <= m.{leaf.path} - before.{leaf.path} <= max_change: return False"

    def _varies(self) -> Iterator[str]:
        """Yield the lines that count the messages in a row in which a field repeats. Mostly the first number shows a change."""
        for k, (path, limit) in enumerate(self._topic.varies.items()):
            leaf = leaves(self._topic.type, path)[0]
            first = f"{leaf.path}.item(0)" if leaf.array else leaf.path
            same = f"equal(m.{leaf.path}, before.{leaf.path})" if leaf.path == path else f"repeats(m, before, {path!r})"
            none = f"{_none(leaf.path)} or " if leaf.array else ""
            yield f"if {none}m.{first} != before.{first} or not {same}: past.repeats[{k}] = 0"
            yield f"elif past.repeats[{k}] < {limit}: past.repeats[{k}] += 1"
            yield "else: return False"

    def _new(self) -> str:
        self._count += 1
        return f"v{self._count}"

    def _limits(self, path: str, base: str) -> tuple[float, float] | None:
        """Return what a field of base type must be within, None if any value is allowed."""
        found = [limits for row, limits in self._topic.ranges.items() if f"{path}.".startswith(f"{row}.")]
        if base == "string" or not (found or base.startswith("float")):
            return None
        largest = float(np.finfo(np.float32).max) if base == "float32" else sys.float_info.max
        lows, highs = zip(*(found or [(-largest, largest)]), strict=True)
        return max(lows), min(highs)

    def _message(self, type_name: str, expression: str, prefix: str) -> Iterator[str]:
        """Yield the lines that check a message of a type."""
        for name, described in store.get_msgdef(type_name).fields:
            kind, detail = described
            here = f"{expression}.{name}"
            if kind == Nodetype.NAME:
                inner = self._new()
                checks = list(self._message(detail, inner, f"{prefix}{name}."))
                if detail == QUATERNION:
                    square = " + ".join(f"{inner}.{k} * {inner}.{k}" for k in "xyzw")
                    checks.append(f"if not {NORM[0]} <= {square} <= {NORM[1]}: return False")
                yield from (f"{inner} = {here}", *checks) if checks else ()
            elif kind == Nodetype.BASE:
                limits = self._limits(prefix + name, detail[0])
                if limits:
                    yield f"if not {limits[0]!r} <= {here} <= {limits[1]!r}: return False"
            else:
                yield from self._array(detail[0], here, prefix + name)

    def _array(self, item: Any, here: str, path: str) -> Iterator[str]:
        kind, detail = item
        inner = self._new()
        if kind == Nodetype.NAME:
            checks = list(self._message(detail, inner, f"{path}."))
            yield from (f"for {inner} in {here}:", *(f" {line}" for line in checks)) if checks else ()
            return
        limits = self._limits(path, detail[0])
        if not limits:
            return
        low, high = limits
        yield f"{inner} = {here} if {here}.__class__ is Array else array({here})"
        yield f"if {inner}.size > {FEW}:"
        yield f" if not ({low!r} <= {inner}.min() and {inner}.max() <= {high!r}): return False"
        radius = min(-low, high)
        if detail[0].startswith("float") and radius > 0:  # no number is larger than the root of the sum of squares
            yield f"elif not hypot(*{inner}.tolist()) <= {radius!r}:"
        else:
            yield "else:"
        yield f" for one in {inner}.tolist():"
        yield f"  if not {low!r} <= one <= {high!r}: return False"
