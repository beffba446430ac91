"""A row of the contract compiled into a check of messages, quick enough for every message of a live run.

The same rules as `conformance.violations`, and one more: every number is finite, also where the row has no range. A value that is
out of range but would be plausible in a neighbouring unit (degrees for radians, millimetres for metres) is named as that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from math import isfinite
from operator import attrgetter
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from palpate_bus.contract.conformance import numbers
from palpate_bus.contract.rows import Topic
from palpate_bus.messages.codec import Message, message_type, store


class Kind(StrEnum):
    """What can be wrong on a topic."""

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


@dataclass(frozen=True)
class Fault:
    """What is wrong with one message, by its topic's row."""

    kind: Kind
    field: str
    expected: str
    got: str


_FEW = 16
"""Up to so many numbers are quicker looked at one by one than by numpy."""
_CONFUSED: dict[str, tuple[tuple[str, float], ...]] = {
    "rad": (("deg", np.pi / 180),),
    "rad/s": (("deg/s", np.pi / 180),),
    "m": (("mm", 1e-3),),
    "m/s": (("mm/s", 1e-3),),
}
"""Units that are taken for each other, with the factor to ours."""


class Checker:
    """The check of one topic's messages."""

    def __init__(self, topic: Topic) -> None:
        self._frame = topic.frame
        self._type = message_type(topic.type)
        names = store.get_msgdef(topic.type).fields
        self._headers: Callable[[Message], list[Any]] = _no_headers
        if any(name == "header" for name, _ in names):
            self._headers = _own_header
        elif any(name == "transforms" for name, _ in names):
            self._headers = _headers_of_transforms
        self._ranges: list[tuple[str, _Reader, float, float, str]] = []
        seen: set[str] = set()
        for path, (least, most) in topic.ranges.items():
            leaves = [leaf for leaf in _leaves(topic.type) if leaf.path == path or leaf.path.startswith(path + ".")]
            seen.update(leaf.path for leaf in leaves)
            self._ranges.append((path, _Reader(leaves), least, most, topic.units.get(path, "1")))
        rest = [leaf for leaf in _leaves(topic.type) if leaf.base.startswith("float") and leaf.path not in seen]
        self._finite = [(leaf.path, _Reader([leaf])) for leaf in rest]

    def __call__(self, message: Message) -> list[Fault]:
        """What is wrong with a message; empty when nothing is."""
        if message.__class__ is not self._type:
            return [Fault(Kind.TYPE, "", self._type.__name__, message.__class__.__name__)]
        faults = []
        if self._frame is not None:
            for header in self._headers(message):
                if header.frame_id != self._frame:
                    faults.append(Fault(Kind.FRAME, "header.frame_id", repr(self._frame), repr(header.frame_id)))
                    break
        for path, reader, least, most, unit in self._ranges:
            if not reader.within(message, least, most):
                faults.append(_out_of_range(path, reader.values(message), least, most, unit))
        for path, reader in self._finite:
            if not reader.finite(message):
                values = reader.values(message)
                faults.append(Fault(Kind.NAN, path, "finite numbers", f"{values[~np.isfinite(values)][0]:g}"))
        return faults

    def stamp(self, message: Message) -> int | None:
        """The time [ns] in the message's header, or in that of its first transform; None where there is none."""
        for header in self._headers(message):
            return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
        return None


def _out_of_range(path: str, values: np.ndarray[Any, Any], least: float, most: float, unit: str) -> Fault:
    wrong = values[~((values >= least) & (values <= most))]
    allowed = f"{least:g}..{most:g} [{unit}]"
    unfit = wrong[~np.isfinite(wrong)]
    if unfit.size:
        return Fault(Kind.NAN, path, allowed, f"{unfit[0]:g}")
    for name, factor in _CONFUSED.get(unit, ()):
        if np.all((values * factor >= least) & (values * factor <= most)):
            return Fault(Kind.UNIT, path, allowed, f"{wrong[0]:g}, plausible if it is in {name}")
    return Fault(Kind.RANGE, path, allowed, f"{wrong[0]:g}")


def _no_headers(_: Message) -> list[Any]:
    return []


def _own_header(message: Message) -> list[Any]:
    return [message.header]


def _headers_of_transforms(message: Message) -> list[Any]:
    return [transform.header for transform in message.transforms]


@dataclass(frozen=True)
class _Leaf:
    """A field of base type: `through` a sequence of messages on the way, and whether it is an array itself."""

    path: str
    base: str
    array: bool
    through: bool


def _leaves(type_name: str, path: str = "", through: bool = False) -> Iterator[_Leaf]:
    for name, described in store.get_msgdef(type_name).fields:
        description: Any = described
        array = False
        while description[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            description, array = description[1][0], True
        here = f"{path}.{name}" if path else name
        if description[0] == Nodetype.NAME:
            yield from _leaves(description[1], here, through or array)
        elif description[1][0] != "string":
            yield _Leaf(here, description[1][0], array, through)


class _Reader:
    """Reads leaves out of messages: scalars and arrays directly, those within sequences of messages by looking at each."""

    def __init__(self, leaves: list[_Leaf]) -> None:
        self._paths = [leaf.path for leaf in leaves]
        scalars = [leaf.path for leaf in leaves if not leaf.array and not leaf.through]
        self._scalars: Any = attrgetter(*scalars) if scalars else None
        self._single = len(scalars) == 1
        self._arrays = [attrgetter(leaf.path) for leaf in leaves if leaf.array and not leaf.through]
        self._nested = [leaf.path for leaf in leaves if leaf.through]

    def within(self, message: Message, least: float, most: float) -> bool:
        """Whether all are in the closed range; NaN is not."""
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
        """Whether all are finite."""
        if self._scalars is not None:
            values = self._scalars(message)
            if not (isfinite(values) if self._single else all(map(isfinite, values))):
                return False
        for array in self._each_array(message):
            if not (all(map(isfinite, array.tolist())) if array.size <= _FEW else np.isfinite(array).all()):
                return False
        return True

    def values(self, message: Message) -> np.ndarray[Any, Any]:
        """All numbers, flat."""
        return np.concatenate([numbers(message, path) for path in self._paths])

    def _each_array(self, message: Message) -> Iterator[np.ndarray[Any, Any]]:
        for get in self._arrays:
            yield np.asarray(get(message))
        for path in self._nested:
            yield numbers(message, path)
