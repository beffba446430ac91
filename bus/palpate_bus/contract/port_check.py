"""The check of every message at a port, generated from the topic's row of the contract: type, frame, ranges, finite numbers.

The runtimes hold one `PortCheck` per port, where a service sends and where messages of other processes are received. In lockstep
a refused message ends the run. In wall-clock mode it is dropped and reported, so its readers act as on silence. No service needs
a check of its own.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from palpate_bus.contract.conformance import Checker, MessageViolation, ViolationKind
from palpate_bus.contract.rows import Topic
from palpate_bus.messages.codec import Message, message_type, store
from palpate_errors import RunError

FEW = 32
"""Up to this number of values a loop in Python is faster than numpy."""
LARGE = 1e9
"""Larger limits are not compared with a sum of squares, which could overflow."""


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

    __slots__ = ("_conforms", "_topic")

    def __init__(self, topic: Topic) -> None:
        self._topic = topic
        self._conforms = conforms(topic.model_dump_json())

    def __call__(self, message: Message) -> None:
        """Raise RefusedMessage if the message breaks the contract."""
        if not self._conforms(message):
            raise RefusedMessage(self._topic, self._violation(message), message)

    def _violation(self, message: Message) -> MessageViolation:
        try:
            return Checker(self._topic)(message)[0]
        except Exception as error:  # a field has a value of another type
            return MessageViolation(ViolationKind.TYPE, "", self._topic.type, str(error))


@cache
def conforms(row: str) -> Callable[[Message], bool]:
    """Return a function that is True for a message that conforms to its topic, a row as JSON: `Checker` without the findings."""
    topic = Topic.model_validate_json(row)
    body = list(_Source(topic).lines())
    text = "\n".join(
        ("def conforms(m):", " try:", *(f"  {line}" for line in body), " except Exception: return False", " return True")
    )
    names: dict[str, Any] = {
        "Type": message_type(topic.type),
        "Array": np.ndarray,
        "array": np.asarray,
        "frame": topic.frame,
    }
    exec(compile(text, f"<check of {topic.name}>", "exec"), names)
    check: Callable[[Message], bool] = names["conforms"]
    return check


class _Source:
    """Writes the lines of a check."""

    def __init__(self, topic: Topic) -> None:
        self._topic = topic
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
        if detail[0].startswith("float") and 0 < radius < LARGE:  # no number is larger than the root of the sum of squares
            yield f"elif not {inner}.dot({inner}) <= {radius * radius!r}:"
        else:
            yield "else:"
        yield f" for one in {inner}.tolist():"
        yield f"  if not {low!r} <= one <= {high!r}: return False"
