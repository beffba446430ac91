"""Fields of messages by dotted path: read into arrays, and whole messages made from arrays.

A path may end at numbers (`radius`), at an array (`vertices`), or at a message of nothing but numbers (`pose.position`,
a quaternion), whose values are taken in the order of its fields.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from palpate_bus.messages.codec import Message, message_type, store
from palpate_bus.messages.stamps import header
from palpate_tissue.backends.fmu.mapping import MapError

Values = Mapping[str, Any]
"""What a message is filled with, by path: an array, a number or a text."""
Make = Callable[[int, Values], Any]

_HEADER = "std_msgs/msg/Header"
_NAME, _ARRAY, _SEQUENCE = 2, 3, 4


def _fields(name: str) -> list[tuple[str, Any]]:
    return list(store.get_msgdef(name).fields)


def _triple(name: str) -> list[str] | None:
    """The fields of a message that is nothing but numbers."""
    fields = _fields(name)
    if fields and all(int(kind) == 1 and detail[0] not in ("string", "wstring") for _, (kind, detail) in fields):
        return [field for field, _ in fields]
    return None


def describe(name: str, path: str) -> Any:
    """The type of a field of a message type. Raises MapError if there is none."""
    here: Any = (_NAME, name)
    for part in path.split("."):
        found = dict(_fields(here[1])) if int(here[0]) == _NAME else {}
        if part not in found:
            raise MapError(f"{name} has no field {path!r}: at {part!r} there is {', '.join(found) or 'nothing more'}")
        here = found[part]
    return here


def size(name: str, path: str) -> int | None:
    """How many numbers a field holds; None for an array of any length. Raises MapError if it holds none."""
    kind, detail = describe(name, path)
    if int(kind) == _NAME:
        members = _triple(detail)
        if members is None:
            raise MapError(f"{name}: field {path!r} is of the type {detail}, which is more than numbers")
        return len(members)
    if int(kind) == _SEQUENCE:
        return None
    return int(detail[1]) if int(kind) == _ARRAY else 1


def reader(name: str, path: str) -> Callable[[Message], ArrayLike]:
    """A function that gives the numbers of a field of a message."""
    kind, detail = describe(name, path)
    get = attrgetter(path)
    members = _triple(detail) if int(kind) == _NAME else None
    if members is None:
        return get
    inner = attrgetter(*(f"{path}.{member}" for member in members))
    return lambda message: np.array(inner(message))


def _cast(base: str) -> Callable[[Any], Any]:
    if base == "string":
        return str
    if base == "bool":
        return bool
    return float if base.startswith("float") else int


def maker(name: str, frame: str, filled: frozenset[str], prefix: str = "") -> Make:
    """A function of (t [ns], values by path) that makes a message; fields that are not in `filled` are zero or empty.

    Headers are stamped t, in `frame`.
    """
    if name == _HEADER:
        return lambda t, _: header(t, frame)
    cls = message_type(name)
    members = _triple(name)
    if prefix and prefix[:-1] in filled and members is not None:
        path = prefix[:-1]
        return lambda _, values: cls(*np.asarray(values[path]).ravel().tolist())
    makes = tuple(_field_maker(kind, detail, frame, filled, prefix + field) for field, (kind, detail) in _fields(name))
    return lambda t, values: cls(*(make(t, values) for make in makes))


def _field_maker(kind: Any, detail: Any, frame: str, filled: frozenset[str], path: str) -> Make:
    if int(kind) == _NAME:
        return maker(detail, frame, filled, f"{path}.")
    if int(kind) in (_ARRAY, _SEQUENCE):
        return _array_maker(detail, path if path in filled else None, int(kind) == _ARRAY)
    cast = _cast(detail[0])
    if path not in filled:
        blank = cast(0) if cast is not str else ""
        return lambda _t, _values: blank
    if cast is str:
        return lambda _, values: str(values[path])
    return lambda _, values: cast(np.asarray(values[path]).ravel()[0])


def _array_maker(detail: Any, path: str | None, fixed: bool) -> Make:
    """Numbers in an array; empty or zero without a path. Arrays of messages stay empty."""
    (inner, item), extent = detail
    if int(inner) != 1 or item[0] == "string":
        return lambda _t, _values: []
    dtype = np.dtype(item[0])
    if path is None:
        empty = np.zeros(extent if fixed else 0, dtype=dtype)
        return lambda _t, _values: empty
    return lambda _, values: np.ascontiguousarray(np.asarray(values[path], dtype=dtype).ravel())
