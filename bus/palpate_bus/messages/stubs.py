"""Writes `__init__.pyi`, which declares the fields of the message classes for type checkers.

python -m palpate_bus.messages.stubs --write     after a change of a .msg file or of typestore.py
python -m palpate_bus.messages.stubs --check     exits with 1 if the file is out of date; a test runs it
"""

import argparse
import sys
from pathlib import Path
from typing import Any

from rosbags.interfaces import Nodetype

from palpate_bus.messages.typestore import TYPE_NAMES, array_dtype, store

STUB = Path(__file__).with_name("__init__.pyi")

_HEAD = '''\
"""Written by `python -m palpate_bus.messages.stubs --write`; change the .msg files or typestore.py instead."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
'''
_SHORT_NAMES = {name: short for short, name in TYPE_NAMES.items()}


def stub() -> str:
    """Return the text of `__init__.pyi`: a dataclass per message class. Raises KeyError for a nested type without a class."""
    return "\n\n".join([_HEAD.rstrip(), *(_class_lines(short, name) for short, name in TYPE_NAMES.items())]) + "\n"


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


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m palpate_bus.messages.stubs")
    choice = parser.add_mutually_exclusive_group(required=True)
    choice.add_argument("--write", action="store_true")
    choice.add_argument("--check", action="store_true")
    if parser.parse_args(arguments).write:
        STUB.write_text(stub(), encoding="utf-8")
        return 0
    if STUB.read_text(encoding="utf-8") == stub():
        return 0
    print(f"{STUB} is out of date: run python -m palpate_bus.messages.stubs --write", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
