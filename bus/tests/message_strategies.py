"""Hypothesis strategies for messages: any valid message of any type, from its definition. Needs `hypothesis`."""

from functools import cache
from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rosbags.interfaces import Nodetype

from palpate_bus.messages.codec import message_type, store
from palpate_bus.messages.typestore import array_dtype

MAX_ITEMS = 3

_INTEGER = {"byte": "int8", "char": "uint8"}


def messages(name: str) -> st.SearchStrategy[Any]:
    """Return valid messages of a type: full ranges of numbers (NaN and infinities too), any text, short sequences."""
    message_type(name)
    return _message(name)


@cache
def _message(name: str) -> st.SearchStrategy[Any]:
    definition = store.get_msgdef(name)
    return st.builds(definition.cls, **{field: _field(description) for field, description in definition.fields})


def _field(description: Any) -> st.SearchStrategy[Any]:
    kind, detail = description
    if kind == Nodetype.NAME:
        return _message(detail)
    if kind == Nodetype.BASE:
        return _scalar(detail[0])
    least, most = (detail[1], detail[1]) if kind == Nodetype.ARRAY else (0, MAX_ITEMS)
    item_kind, item = detail[0]
    if item_kind == Nodetype.BASE and item[0] != "string":
        return _array(item[0], least, most)
    return st.lists(_field(detail[0]), min_size=least, max_size=most)


def _scalar(base: str) -> st.SearchStrategy[Any]:
    if base == "string":
        # No surrogates: they have no UTF-8. No NUL: it ends a string in CDR.
        return st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=12)
    if base == "bool":
        return st.booleans()
    if base in ("float32", "float64"):
        return st.floats(width=32 if base == "float32" else 64)
    limits = np.iinfo(_INTEGER.get(base, base))
    return st.integers(int(limits.min), int(limits.max))


def _array(base: str, least: int, most: int) -> st.SearchStrategy[Any]:
    return arrays(array_dtype(base), st.integers(least, most))
