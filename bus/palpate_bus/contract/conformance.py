"""Whether a message is what its row of the contract says: stamp, frame, ranges, finite numbers.

Shared by the contract tests and `palpate check`, so that a real driver and a simulated one pass the same suite.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from palpate_bus.contract.rows import Topic
from palpate_bus.messages.codec import CodecError, Message, message_type, store
from palpate_bus.messages.stamps import nanoseconds


def leaves(type_name: str, path: str = "") -> list[tuple[str, str]]:
    """The fields at and under `path` in a type, as (path, base type): `wrench.force` gives its x, y and z.

    Sequences are looked through. Raises CodecError if the type has no such field.
    """
    message_type(type_name)
    description: Any = (Nodetype.NAME, type_name)
    for name in path.split(".") if path else []:
        fields_here = dict(store.get_msgdef(description[1]).fields) if description[0] == Nodetype.NAME else {}
        if name not in fields_here:
            raise CodecError(f"{type_name} has no field {path!r}: no {name!r} among {sorted(fields_here)}")
        description = _item(fields_here[name])
    return list(_leaves(description, path))


def _item(description: Any) -> Any:
    """A field's description with the sequences around it taken off."""
    while description[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        description = description[1][0]
    return description


def _leaves(description: Any, path: str) -> Iterator[tuple[str, str]]:
    if description[0] == Nodetype.BASE:
        yield path, description[1][0]
        return
    for name, inner in store.get_msgdef(description[1]).fields:
        yield from _leaves(_item(inner), f"{path}.{name}" if path else name)


def numbers(message: Message, path: str) -> np.ndarray[Any, Any]:
    """All numbers at and under a field of a message, flat, shape (n,)."""
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


def violations(topic: Topic, message: Message, t: int | None = None) -> list[str]:
    """What is wrong with a message by its topic's row, a sentence each; empty when nothing is.

    `t` is the time [ns] that its header must carry, if it has one; None leaves the stamp unchecked. NaN is taken as out of range.
    """
    found = []
    if type(message) is not message_type(topic.type):
        return [f"{topic.name}: is a {type(message).__name__}, wants {topic.type}"]
    for header in _headers(message):
        if topic.frame is not None and header.frame_id != topic.frame:
            found.append(f"{topic.name}: frame_id is {header.frame_id!r}, wants {topic.frame!r}")
        if t is not None and nanoseconds(header.stamp) != t:
            found.append(f"{topic.name}: stamp is {nanoseconds(header.stamp)} ns, wants {t} ns")
    for path, (least, most) in topic.ranges.items():
        values = numbers(message, path)
        wrong = values[~((values >= least) & (values <= most))]
        if wrong.size:
            unit = topic.units.get(path, "1")
            found.append(f"{topic.name}: {path} is {wrong[0]:g}, allowed are {least:g}..{most:g} [{unit}]")
    return found


def _headers(message: Message) -> list[Any]:
    """The headers that stand for the whole message: its own, or those of the transforms of a TFMessage."""
    if hasattr(message, "header"):
        return [message.header]
    return [transform.header for transform in getattr(message, "transforms", [])]
