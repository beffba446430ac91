"""The fields of a message type, and the numbers in a message, by their path: `wrench.force.x`."""

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Nodetype

from palpate_bus.messages.codec import CodecError, Message, message_type, store


class LeafField(NamedTuple):
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
