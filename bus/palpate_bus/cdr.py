"""Generates a fast CDR encoder and decoder for one message type, from the fields that `rosbags` parsed.

The 1 kHz loop pays about ten codec calls a tick. rosbags packs and unpacks field by field; here neighbouring numbers, across
nested messages, become one `struct` call. The bytes are the same, which the contract tests compare for every type.

CDR aligns each number to its own size, counted from the end of the four-byte encapsulation header. Behind a string the
alignment is known only at run time, so a run of numbers has eight Structs, one a phase of the position modulo 8.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import lru_cache
from itertools import count
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Nodetype

HEADER = b"\x00\x01\x00\x00"
"""Encapsulation header of little-endian CDR."""


class Codec(NamedTuple):
    """The generated functions of a message type."""

    encode: Callable[..., bytes]
    """`encode(message, position, head)` gives `head` and the bytes that follow `position`, which counts without the header."""
    decode: Callable[[bytes, int], tuple[Any, int]]
    """`decode(data, position)` gives (message, next position); here the header counts in."""
    least_size: int
    """Bytes that a message takes at least, padding left out."""


Fast = Callable[[str], Codec]

_FORMAT = {
    "bool": "?", "byte": "b", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I",
    "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
_DTYPE = {name: np.dtype({"bool": "?", "byte": "i1", "char": "u1"}.get(name, name)) for name in _FORMAT}


def _run(formats: str, offset: int, align: int = 1) -> tuple[struct.Struct, ...]:
    """Structs of a run of numbers, one for each (position + offset) modulo 8, with the padding between them.

    What follows is aligned to `align` bytes.
    """
    structs = []
    for index in range(8):
        position = phase = (index + offset) % 8
        text = "<"
        for code in formats:
            size = struct.calcsize("<" + code)
            pad = -position % size
            text += "x" * pad + code
            position += pad + size
        text += "x" * (-position % align)
        position += -position % align
        structs.append(struct.Struct(text))
        assert structs[-1].size == position - phase
    return tuple(structs)


def _array(value: Any, dtype: np.dtype[Any], length: int, where: str) -> Any:
    """`value` as a contiguous array of `dtype`, its number of items checked when `length` is not negative."""
    array = np.asarray(value)
    if not (np.can_cast(array.dtype, dtype, "same_kind") or array.size == 0):
        raise ValueError(f"{where}: has {array.dtype}, wants {dtype}")
    if array.ndim != 1 or (length >= 0 and array.size != length):
        raise ValueError(f"{where}: has shape {array.shape}, wants ({'n' if length < 0 else length},)")
    return np.ascontiguousarray(array, dtype)


@lru_cache(maxsize=512)
def _pack_strings(values: tuple[str, ...], phase: int) -> bytes:
    """Strings one after the other, each with its length; `phase` is the position of the first modulo 4."""
    out = bytearray(phase)
    for value in values:
        data = value.encode() + b"\0"
        out += bytes(-len(out) % 4) + struct.pack("<I", len(data)) + data
    return bytes(out[phase:])


def _unpack_strings(data: bytes, position: int, number: int) -> tuple[list[str], int]:
    """`number` strings from `position` (counted with the encapsulation header, whose four bytes keep the alignment)."""
    if number * 5 > len(data) - position:
        raise ValueError(f"{number} strings cannot fit into {len(data) - position} bytes")
    values = []
    for _ in range(number):
        position += -position % 4
        (size,) = struct.unpack_from("<I", data, position)
        end = position + 4 + size
        if size < 1 or end > len(data) or data[end - 1]:
            raise ValueError(f"invalid string of length {size} at {position}")
        values.append(data[position + 4 : end - 1].decode())
        position = end
    return values, position


class _StringsReader:
    """Unpacks strings; the same ones as the last time, like joint names, are recognised by their bytes."""

    def __init__(self) -> None:
        self._last: tuple[int, int, bytes, list[str]] = (-1, 0, b"", [])

    def __call__(self, data: bytes, position: int, number: int) -> tuple[list[str], int]:
        last_number, phase, block, values = self._last
        if number == last_number and position & 3 == phase and data.startswith(block, position):
            return values.copy(), position + len(block)
        values, end = _unpack_strings(data, position, number)
        self._last = (number, position & 3, data[position:end], values.copy())
        return values, end


class _Writer:
    """Collects the lines and constants of a function under construction.

    In the generated code `p` is the position, `s` a Struct and `d` one item of a sequence of messages.
    """

    def __init__(self, store: Any, fast: Fast) -> None:
        self.store = store
        self.fast = fast
        self.lines: list[str] = []
        self.formats: list[str] = []
        """The run of numbers that is being collected, and where they come from or go to."""
        self.numbers: list[str] = []
        self.names: dict[str, Any] = {"frombuffer": np.frombuffer, "ndarray": np.ndarray, "array": _array}
        self.names |= {"pack_strings": _pack_strings, "new": object.__new__, "join": b"".join}
        self._counter = count()

    def name(self, value: Any) -> str:
        """A name for a constant in the generated function."""
        name = f"c{next(self._counter)}"
        self.names[name] = value
        return name

    def variable(self) -> str:
        return f"v{next(self._counter)}"

    def number(self, code: str, variable: str) -> str:
        """Appends a number to the run."""
        self.formats.append(code)
        self.numbers.append(variable)
        return variable

    def take_run(self, offset: int, align: int = 1) -> tuple[str, str]:
        """The name of the run's Structs and its variables; the next run begins empty."""
        structs, variables = self.name(_run("".join(self.formats), offset, align)), ", ".join(self.numbers)
        self.formats.clear()
        self.numbers.clear()
        return structs, variables

    def function(self, head: str, name: str) -> Any:
        exec("\n".join([head, *("  " + line for line in self.lines)]), self.names)
        return self.names[name]


class _Encoder(_Writer):
    """Writes `encode(m, p, h)`: each field adds a variable to `parts`, which are joined at the end."""

    def __init__(self, store: Any, fast: Fast) -> None:
        super().__init__(store, fast)
        self.parts = ["h"]

    def flush(self) -> None:
        if self.formats:
            self._pack(*self.take_run(0))

    def _pack(self, structs: str, values: str) -> None:
        part = self.variable()
        self.lines.append(f"s = {structs}[p & 7]; {part} = s.pack({values}); p += s.size")
        self.parts.append(part)

    def string(self, path: str) -> None:
        part = self.variable()
        self.lines.append(f"{part} = {path}.encode() + b'\\0'")
        self.number("I", f"len({part})")
        self.flush()
        self.lines.append(f"p += len({part})")
        self.parts.append(part)

    def array(self, path: str, dtype: np.dtype[Any], length: int) -> None:
        part, c, size = self.variable(), self.name(dtype), dtype.itemsize
        wrong = f"{part}.__class__ is not ndarray or {part}.dtype is not {c} or {part}.ndim != 1"
        self.lines.append(f"{part} = {path}")
        self.lines.append(f"if {wrong}{f' or len({part}) != {length}' if length >= 0 else ''}:")
        self.lines.append(f"  {part} = array({part}, {c}, {length}, {path[2:]!r})")
        if length >= 0:
            n = str(length)
            self._pack(*self.take_run(0, size if length else 1))
        else:  # padding stands only where items follow
            n = self.number("I", self.variable())
            self.lines.append(f"{n} = len({part})")
            plain = self.name(_run("".join(self.formats), 0))
            structs, values = self.take_run(0, size)
            self._pack(f"({structs} if {n} else {plain})", values)
        self.lines.append(f"p += {n} * {size}")
        # Small arrays are copied, which is quicker than a look at whether they are contiguous.
        self.lines.append(f"if {n} < {512 // size} or not {part}.flags.c_contiguous: {part} = {part}.tobytes()")
        self.parts.append(part)

    def items(self, path: str, item: Any, length: int) -> None:
        part = self.variable()
        if length >= 0:
            self.lines.append(f"if len({path}) != {length}: raise ValueError('{path[2:]}: wants {length} items')")
        else:
            self.number("I", f"len({path})")
        self.flush()
        if item[0] == Nodetype.BASE:
            self.lines.append(f"{part} = pack_strings(tuple({path}), p & 3); p += len({part})")
        else:
            encode = self.name(self.fast(item[1]).encode)
            self.lines += [f"{part} = []", f"for d in {path}: d = {encode}(d, p); p += len(d); {part}.append(d)"]
            part = f"*{part}"
        self.parts.append(part)

    def finish(self) -> Callable[..., bytes]:
        self.flush()
        self.lines.append(f"return join(({', '.join(self.parts)},))")
        return self.function("def encode(m, p, h=b''):", "encode")  # type: ignore[no-any-return]


class _Decoder(_Writer):
    """Writes `decode(b, p)`: each field puts a variable into `values`, of which the messages are made at the end."""

    def __init__(self, store: Any, fast: Fast) -> None:
        super().__init__(store, fast)
        self.values: dict[str, str] = {}

    def flush(self) -> None:
        if self.formats:
            structs, targets = self.take_run(4)
            self.lines.append(f"s = {structs}[p & 7]; {targets}, = s.unpack_from(b, p); p += s.size")

    def string(self, path: str) -> None:
        value, n = self.variable(), self.number("I", self.variable())
        self.flush()
        self.lines.append(f"e = p + {n}")
        self.lines.append(f"if {n} < 1 or e > len(b) or b[e - 1]:")
        self.lines.append(f"  raise ValueError(f'{path[2:]}: invalid string of length {{{n}}} at {{p}}')")
        self.lines.append(f"{value} = b[p:e - 1].decode() if {n} > 1 else ''; p = e")
        self.values[path] = value

    def array(self, path: str, dtype: np.dtype[Any], length: int) -> None:
        n = str(length) if length >= 0 else self.number("I", self.variable())
        self.flush()
        if dtype.itemsize > 1:  # alignment counts from the end of the encapsulation header
            align = f"p += -(p - 4) & {dtype.itemsize - 1}"
            self.lines.append(align if length >= 0 else f"if {n}: {align}")
        value = self.values[path] = self.variable()
        self.lines.append(f"{value} = frombuffer(b, {self.name(dtype)}, {n}, p); p += {n} * {dtype.itemsize}")

    def items(self, path: str, item: Any, length: int) -> None:
        n = str(length) if length >= 0 else self.number("I", self.variable())
        self.flush()
        value = self.values[path] = self.variable()
        if item[0] == Nodetype.BASE:
            self.lines.append(f"{value}, p = {self.name(_StringsReader())}(b, p, {n})")
            return
        nested = self.fast(item[1])
        self.lines.append(f"if {n} * {nested.least_size} > len(b) - p:")
        self.lines.append(f"  raise ValueError(f'{path[2:]}: {{{n}}} items cannot fit into {{len(b) - p}} bytes')")
        self.lines.append(f"{value} = []")
        self.lines.append(f"for _ in range({n}): d, p = {self.name(nested.decode)}(b, p); {value}.append(d)")

    def finish(self, name: str) -> Callable[[bytes, int], tuple[Any, int]]:
        self.flush()
        self.lines.append(f"return {self.build(name, 'm')}, p")
        return self.function("def decode(b, p):", "decode")  # type: ignore[no-any-return]

    def build(self, name: str, path: str) -> str:
        """Makes the message at `path` of its values; returns its variable.

        Attributes are set directly: a dataclass's `__init__` would take twice as long.
        """
        parts = [
            (field, self.build(desc[1], f"{path}.{field}") if desc[0] == Nodetype.NAME else self.values[f"{path}.{field}"])
            for field, desc in self.store.get_msgdef(name).fields
        ]
        message = self.variable()
        self.lines.append(f"{message} = new({self.name(self.store.types[name])})")
        self.lines.append("; ".join(f"{message}.{field} = {value}" for field, value in parts))
        return message


def _flat(store: Any, name: str, path: str) -> list[tuple[str, Any]]:
    """The fields of a message with nested messages opened up, as (path, description)."""
    out: list[tuple[str, Any]] = []
    for field, desc in store.get_msgdef(name).fields:
        out += _flat(store, desc[1], f"{path}.{field}") if desc[0] == Nodetype.NAME else [(f"{path}.{field}", desc)]
    return out


def _least_size(desc: Any, fast: Fast) -> int:
    """The least number of bytes that a field takes, padding left out."""
    kind, detail = desc
    if kind == Nodetype.BASE:
        return 5 if detail[0] == "string" else struct.calcsize("<" + _FORMAT[detail[0]])
    if kind == Nodetype.NAME:
        return fast(detail).least_size
    if kind == Nodetype.ARRAY:
        return int(detail[1]) * _least_size(detail[0], fast)
    return 4


def generate(store: Any, name: str, fast: Fast) -> Codec:
    """The codec of a message type of a rosbags typestore; `fast` gives the codec of a nested type.

    Raises KeyError for a type that has a field we have no fast way for.
    """
    encoder, decoder = _Encoder(store, fast), _Decoder(store, fast)
    for path, (kind, detail) in _flat(store, name, "m"):
        if kind == Nodetype.BASE and detail[0] != "string":
            encoder.number(_FORMAT[detail[0]], path)
            decoder.values[path] = decoder.number(_FORMAT[detail[0]], decoder.variable())
        elif kind == Nodetype.BASE:
            encoder.string(path)
            decoder.string(path)
        else:
            item, length = detail if kind == Nodetype.ARRAY else (detail[0], -1)
            numeric = item[0] == Nodetype.BASE and item[1][0] != "string"
            for writer in (encoder, decoder):
                if numeric:
                    writer.array(path, _DTYPE[item[1][0]], length)
                else:
                    writer.items(path, item, length)
    least_size = sum(_least_size(desc, fast) for _, desc in store.get_msgdef(name).fields)
    return Codec(encoder.finish(), decoder.finish(name), least_size)
