"""Writes the source of an encoder or decoder: its lines, its constants, and what is known of the position in the bytes."""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import lru_cache
from itertools import count
from typing import Any, NamedTuple

import numpy as np

from palpate_bus.messages.cdr_parts import CodecError, checked_array, pack_strings


class Codec(NamedTuple):
    """The generated functions of a type that stands in sequences of other messages."""

    encode: Callable[[Any, int], bytes]
    """`encode(message, position)` gives the bytes that follow `position`, which counts without the header."""
    decode: Callable[[bytes, int], tuple[Any, int]]
    """`decode(data, position)` gives (message, next position); here the header counts in."""
    least_size: int
    """Bytes that a message takes at least, padding left out."""


Fast = Callable[[str], Codec]


@lru_cache(maxsize=4096)
def _struct(formats: tuple[str, ...], phase: int, align: int) -> struct.Struct:
    """The Struct of a run of numbers that begins at a position of this phase (modulo 8), with the padding between them.

    What follows is aligned to `align` bytes.
    """
    text = "<"
    position = phase
    for code in formats:
        size = struct.calcsize("<" + code)
        pad = -position % size
        text += "x" * pad + code
        position += pad + size
    return struct.Struct(text + "x" * (-position % align))


class Field(NamedTuple):
    """A field that is no message: an expression for it where code is written, its path in the message, rosbags' description."""

    value: str
    path: str
    kind: Any


class Writer:
    """Collects the lines and constants of a function under construction.

    In the generated code `p` is the position, once it is no longer known beforehand, `s` a Struct and `d` one item of a sequence
    of messages.
    """

    counted: int
    """Bytes of the encapsulation header that the position counts in."""

    def __init__(self, store: Any, fast: Fast, at: int | None) -> None:
        """`at`: the position at the start; None when the function gets it as its argument `p`."""
        self.store = store
        self.fast = fast
        self.lines: list[str] = []
        self.formats: list[str] = []
        """The run of numbers that is being collected, and where they come from or go to."""
        self.numbers: list[str] = []
        self.names: dict[str, Any] = {"frombuffer": np.frombuffer, "ndarray": np.ndarray, "array": checked_array}
        self.names |= {"pack_strings": pack_strings, "new": object.__new__, "join": b"".join, "CodecError": CodecError}
        self._counter = count()
        self._at = at
        self._ahead: list[str] = []
        """Sizes that `p` has still to be advanced by."""
        self._held = at is None
        """Whether `p` is set."""

    def name(self, value: Any) -> str:
        """A name for a constant in the generated function."""
        name = f"c{next(self._counter)}"
        self.names[name] = value
        return name

    def variable(self) -> str:
        """A fresh name for a variable."""
        return f"v{next(self._counter)}"

    def position(self) -> str:
        """An expression for the position, which `p` is brought up to where it has to be."""
        if self._at is not None:
            return str(self._at)
        if self._ahead:
            self.lines.append(f"p {'+=' if self._held else '='} {' + '.join(self._ahead)}")
            self.held()
        return "p"

    def advance(self, size: int | str) -> None:
        """The position moves on by `size` [bytes], or by what this expression gives."""
        if self._at is not None:
            if isinstance(size, int):
                self._at += size
                return
            self._ahead, self._at = [str(self._at)], None
        self._ahead.append(str(size))

    def number(self, code: str, variable: str) -> str:
        """Appends a number to the run."""
        self.formats.append(code)
        self.numbers.append(variable)
        return variable

    def take_run(self, align: int = 1, align_if: str = "") -> tuple[str, str]:
        """An expression for the run's Struct, and its variables; the next run begins empty.

        What follows is aligned to `align` bytes: always, or if the variable `align_if` is not zero. Advances.
        """
        formats, values = tuple(self.formats), ", ".join(self.numbers)
        self.formats.clear()
        self.numbers.clear()
        offset, at = -self.counted, self._at

        def structs(align: int) -> str:
            if at is not None:
                return self.name(_struct(formats, (at + offset) % 8, align))
            phases = tuple(_struct(formats, (index + offset) % 8, align) for index in range(8))
            return f"{self.name(phases)}[{self.position()} & 7]"

        if align_if:
            chosen = f"({structs(align)} if {align_if} else {structs(1)})"
        elif at is not None:
            chosen = structs(align)
            self.advance(self.names[chosen].size)
            return chosen, values
        else:
            chosen = structs(align)
        self.lines.append(f"s = {chosen}")
        self.advance("s.size")  # taken up before `s` becomes another: that one's phase needs the position
        return "s", values

    def hold(self) -> None:
        """From here on the position is in `p`."""
        place = self.position()
        if place != "p":
            self.lines.append(f"p = {place}")
        self.held()

    def held(self) -> None:
        """What was written last has set `p`."""
        self._at, self._ahead, self._held = None, [], True

    def function(self, head: str, name: str) -> Any:
        """The function that the lines make under `head`."""
        exec("\n".join([head, *("  " + line for line in self.lines)]), self.names)
        return self.names[name]

    def guarded(self, what: str) -> None:
        """Turns everything so far that may go wrong into a CodecError; `what` is the code of an f-string."""
        body = ["  " + line for line in self.lines]
        self.lines = ["try:", *body, "except Exception as error:", f"  raise CodecError(f{what!r}) from error"]
