"""Writes the stubs of the messages, which declare the fields of their classes and the members of their enumerations.

python bus/tests/message_stubs.py     after a change of a .msg file or of typestore.py; a test says if it is out of date
"""

from pathlib import Path
from typing import Any

from rosbags.interfaces import Nodetype

from palpate_bus import messages
from palpate_bus.messages import codes
from palpate_bus.messages.typestore import TYPE_NAMES, array_dtype, store

STUB, CODES_STUB = (Path(str(module.__file__)).with_suffix(".pyi") for module in (messages, codes))

_HEAD = '''\
"""Written by `python bus/tests/message_stubs.py`; change the .msg files or typestore.py instead."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from palpate_bus.messages.codec import CodecError as CodecError, Message as Message
from palpate_bus.messages.stamps import (
    MS as MS,
    NS as NS,
    UNIX_NS as UNIX_NS,
    blank as blank,
    duration_message as duration_message,
    header as header,
    nanoseconds as nanoseconds,
    time_message as time_message,
)
'''
_SHORT_NAMES = {name: short for short, name in TYPE_NAMES.items()}


def stub() -> str:
    """Return the text of `__init__.pyi`: a dataclass per message class. Raises KeyError for a nested type without a class."""
    return "\n\n".join([_HEAD.rstrip(), *(_class_lines(short, name) for short, name in TYPE_NAMES.items())]) + "\n"


def codes_stub() -> str:
    """Return the text of `codes.pyi`: a class per enumeration."""
    classes = []
    for name in codes.ENUMERATIONS:
        members = [f"    {member.name} = {member.value}" for member in getattr(codes, name)]
        classes.append("\n".join((f"class {name}(IntEnum):", *members)))
    return "\n\n".join((_HEAD.partition("\n")[0], "from enum import IntEnum", *classes)) + "\n"


def _class_lines(short: str, name: str) -> str:
    definition = store.get_msgdef(name)
    fields = [f"    {field}: {_type_of(description)}" for field, description in definition.fields]
    constants = [
        f"    {constant}: ClassVar[{type(getattr(definition.cls, constant)).__name__}]"
        for constant, annotation in definition.cls.__annotations__.items()
        if "ClassVar" in str(annotation) and constant != "__msgtype__"
    ]
    return "\n".join(["@dataclass", f"class {short}:", "    __msgtype__: ClassVar[str]", *constants, *fields])


def _type_of(description: Any) -> str:
    """Return the Python type of a field from its rosbags description."""
    kind, detail = description
    if kind == Nodetype.NAME:
        return _SHORT_NAMES[detail]
    if kind == Nodetype.BASE:
        base = detail[0]
        return {"string": "str", "bool": "bool", "float32": "float", "float64": "float"}.get(base, "int")
    item_kind, item = detail[0]
    if item_kind == Nodetype.NAME or item[0] == "string":
        return f"list[{_type_of(detail[0])}]"
    return f"NDArray[np.{array_dtype(item[0]).name}]"


if __name__ == "__main__":
    STUB.write_text(stub(), encoding="utf-8")
    CODES_STUB.write_text(codes_stub(), encoding="utf-8")
