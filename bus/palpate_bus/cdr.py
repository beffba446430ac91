"""Generates a fast CDR encoder and decoder for one message type, from the fields that `rosbags` parsed.

The 1 kHz loop pays about ten codec calls a tick. rosbags packs and unpacks field by field; here neighbouring numbers, across
nested messages, become one `struct` call. The bytes are the same, which the contract tests compare for every type.

CDR aligns each number to its own size, counted from the end of the four-byte encapsulation header. Up to the first string or
sequence every position is known when the code is written. Behind it a run of numbers has eight Structs, one a phase of the
position modulo 8.
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


class CodecError(ValueError):
    """Bytes that are not a message of the expected type, or a message that does not fit its type."""


class Codec(NamedTuple):
    """The generated functions of a type that stands in sequences of other messages."""

    encode: Callable[[Any, int], bytes]
    """`encode(message, position)` gives the bytes that follow `position`, which counts without the header."""
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


class _Field(NamedTuple):
    """A field that is no message: an expression for it where code is written, its path in the message, rosbags' description."""

    value: str
    path: str
    kind: Any


class _Writer:
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
        self.names: dict[str, Any] = {"frombuffer": np.frombuffer, "ndarray": np.ndarray, "array": _array}
        self.names |= {"pack_strings": _pack_strings, "new": object.__new__, "join": b"".join, "CodecError": CodecError}
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
        exec("\n".join([head, *("  " + line for line in self.lines)]), self.names)
        return self.names[name]

    def guarded(self, what: str) -> None:
        """Turns everything so far that may go wrong into a CodecError; `what` is the code of an f-string."""
        body = ["  " + line for line in self.lines]
        self.lines = ["try:", *body, "except Exception as error:", f"  raise CodecError(f{what!r}) from error"]


class _Encoder(_Writer):
    """Writes the bytes of a message `m`: each field adds a variable to `parts`, which are joined at the end."""

    counted = 0

    def __init__(self, store: Any, fast: Fast, *, whole: bool) -> None:
        """`whole`: with the encapsulation header in front."""
        super().__init__(store, fast, -len(HEADER) if whole else None)
        self.parts: list[str] = []
        if whole:
            self.number(f"{len(HEADER)}s", self.name(HEADER))

    def flush(self) -> None:
        if self.formats:
            self._pack(*self.take_run())

    def _pack(self, structs: str, values: str) -> None:
        part = self.variable()
        self.lines.append(f"{part} = {structs}.pack({values})")
        self.parts.append(part)

    def scalar(self, field: _Field, code: str) -> None:
        self.number(code, field.value)

    def string(self, field: _Field) -> None:
        part = self.variable()
        self.lines.append(f"{part} = {field.value}.encode() + b'\\0'")
        self.number("I", f"len({part})")
        self.flush()
        self.advance(f"len({part})")
        self.parts.append(part)

    def array(self, field: _Field, dtype: np.dtype[Any], length: int) -> None:
        part, c, size = self.variable(), self.name(dtype), dtype.itemsize
        wrong = f"{part}.__class__ is not ndarray or {part}.dtype is not {c} or {part}.ndim != 1"
        self.lines.append(f"{part} = {field.value}")
        self.lines.append(f"if {wrong}{f' or len({part}) != {length}' if length >= 0 else ''}:")
        self.lines.append(f"  {part} = array({part}, {c}, {length}, {field.path!r})")
        if length >= 0:
            n = str(length)
            self._pack(*self.take_run(size if length else 1))
            self.advance(length * size)
        else:  # padding stands only where items follow
            n = self.number("I", self.variable())
            self.lines.append(f"{n} = len({part})")
            self._pack(*self.take_run(size, align_if=n))
            self.advance(f"{n} * {size}")
        # Small arrays are copied, which is quicker than a look at whether they are contiguous.
        self.lines.append(f"if {n} < {512 // size} or not {part}.flags.c_contiguous: {part} = {part}.tobytes()")
        self.parts.append(part)

    def items(self, field: _Field, item: Any, length: int) -> None:
        part = self.variable()
        if length >= 0:
            wrong = f"{field.path}: wants {length} items"
            self.lines.append(f"if len({field.value}) != {length}: raise ValueError({wrong!r})")
        else:
            self.number("I", f"len({field.value})")
        self.flush()
        self.hold()
        if item[0] == Nodetype.BASE:
            self.lines.append(f"{part} = pack_strings(tuple({field.value}), p & 3); p += len({part})")
        else:
            encode = self.name(self.fast(item[1]).encode)
            self.lines += [f"{part} = []", f"for d in {field.value}: d = {encode}(d, p); p += len(d); {part}.append(d)"]
            part = f"*{part}"
        self.parts.append(part)

    def give(self) -> None:
        """Writes the return."""
        self.flush()
        alone = len(self.parts) == 1 and not self.parts[0].startswith("*")
        self.lines.append(f"return {self.parts[0]}" if alone else f"return join(({', '.join(self.parts)},))")


class _Decoder(_Writer):
    """Reads a message out of bytes `b`: each field puts a variable into `values`, of which the messages are made at the end."""

    counted = len(HEADER)

    def __init__(self, store: Any, fast: Fast, *, whole: bool) -> None:
        """`whole`: the bytes begin with the encapsulation header."""
        super().__init__(store, fast, len(HEADER) if whole else None)
        self.values: dict[str, str] = {}

    def flush(self) -> None:
        if self.formats:
            place = self.position()
            structs, targets = self.take_run()
            self.lines.append(f"{targets}, = {structs}.unpack_from(b, {place})")

    def scalar(self, field: _Field, code: str) -> None:
        self.values[field.path] = self.number(code, self.variable())

    def string(self, field: _Field) -> None:
        value, n = self.variable(), self.number("I", self.variable())
        self.flush()
        place = self.position()
        self.lines.append(f"e = {place} + {n}")
        self.lines.append(f"if {n} < 1 or e > len(b) or b[e - 1]:")
        self.lines.append(f"  raise ValueError(f'{field.path}: invalid string of length {{{n}}} at {{{place}}}')")
        self.lines.append(f"{value} = b[{place}:e - 1].decode() if {n} > 1 else ''; p = e")
        self.held()
        self.values[field.path] = value

    def array(self, field: _Field, dtype: np.dtype[Any], length: int) -> None:
        n = str(length) if length >= 0 else self.number("I", self.variable())
        self.flush()
        if dtype.itemsize > 1:  # alignment counts from the end of the encapsulation header
            pad = f"(-({self.position()} - {self.counted}) & {dtype.itemsize - 1})"
            self.advance(pad if length >= 0 else f"({pad} if {n} else 0)")
        value = self.values[field.path] = self.variable()
        self.lines.append(f"{value} = frombuffer(b, {self.name(dtype)}, {n}, {self.position()})")
        self.advance(f"{n} * {dtype.itemsize}")

    def items(self, field: _Field, item: Any, length: int) -> None:
        n = str(length) if length >= 0 else self.number("I", self.variable())
        self.flush()
        self.hold()
        value = self.values[field.path] = self.variable()
        if item[0] == Nodetype.BASE:
            self.lines.append(f"{value}, p = {self.name(_StringsReader())}(b, p, {n})")
            return
        nested = self.fast(item[1])
        self.lines.append(f"if {n} * {nested.least_size} > len(b) - p:")
        self.lines.append(f"  raise ValueError(f'{field.path}: {{{n}}} items cannot fit into {{len(b) - p}} bytes')")
        self.lines.append(f"{value} = []")
        self.lines.append(f"for _ in range({n}): d, p = {self.name(nested.decode)}(b, p); {value}.append(d)")

    def build(self, name: str, path: str) -> str:
        """Makes the message at `path` of its values; returns its variable.

        Attributes are set directly: a dataclass's `__init__` would take twice as long.
        """
        parts = [
            (field, self.build(desc[1], f"{path}{field}.") if desc[0] == Nodetype.NAME else self.values[path + field])
            for field, desc in self.store.get_msgdef(name).fields
        ]
        message = self.variable()
        self.lines.append(f"{message} = new({self.name(self.store.types[name])})")
        self.lines.append("; ".join(f"{message}.{field} = {value}" for field, value in parts))
        return message


def _flat(store: Any, name: str, value: str, path: str = "") -> list[_Field]:
    """The fields of a message with nested messages opened up; those stand as their paths below `value`."""
    out: list[_Field] = []
    for field, kind in store.get_msgdef(name).fields:
        inner = f"{value}.{field}"
        out += (
            _flat(store, kind[1], inner, f"{path}{field}.") if kind[0] == Nodetype.NAME else [_Field(inner, path + field, kind)]
        )
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


def _write(writer: _Encoder | _Decoder, fields: list[_Field]) -> None:
    """Code for all fields. Raises KeyError for one that we have no fast way for."""
    for field in fields:
        kind, detail = field.kind
        if kind == Nodetype.BASE and detail[0] != "string":
            writer.scalar(field, _FORMAT[detail[0]])
        elif kind == Nodetype.BASE:
            writer.string(field)
        else:
            item, length = detail if kind == Nodetype.ARRAY else (detail[0], -1)
            if item[0] == Nodetype.BASE and item[1][0] != "string":
                writer.array(field, _DTYPE[item[1][0]], length)
            else:
                writer.items(field, item, length)
    writer.flush()


def _encoder(store: Any, name: str, fast: Fast, *, whole: bool) -> _Encoder:
    """The code of an encoder, up to its return. A message inside others is looked up once."""
    writer = _Encoder(store, fast, whole=whole)
    fields = []
    inner: dict[str, str] = {}
    for field in _flat(store, name, "m"):
        *steps, last = field.value.split(".")
        owner = steps[0]
        for step in steps[1:]:
            owner = inner.setdefault(f"{owner}.{step}", f"m{len(inner)}")
        fields.append(field._replace(value=f"{owner}.{last}"))
    writer.lines += [f"{variable} = {value}" for value, variable in inner.items()]
    _write(writer, fields)
    return writer


def _decoder(store: Any, name: str, fast: Fast, *, whole: bool) -> _Decoder:
    """The code of a decoder, up to its return."""
    writer = _Decoder(store, fast, whole=whole)
    _write(writer, _flat(store, name, "m"))
    return writer


def nested(store: Any, name: str, fast: Fast) -> Codec:
    """The codec of a message type of a rosbags typestore, inside others; `fast` gives the codec of what is inside it.

    Raises KeyError for a type that has a field we have no fast way for; so do `encoder` and `decoder`.
    """
    encode, decode = _encoder(store, name, fast, whole=False), _decoder(store, name, fast, whole=False)
    encode.give()
    decode.lines.append(f"return {decode.build(name, '')}, {decode.position()}")
    least_size = sum(_least_size(desc, fast) for _, desc in store.get_msgdef(name).fields)
    return Codec(encode.function("def encode(m, p):", "encode"), decode.function("def decode(b, p):", "decode"), least_size)


def encoder(store: Any, name: str, fast: Fast) -> Callable[[Any], bytes]:
    """The encoder of a whole message, which raises CodecError if a field does not fit."""
    writer = _encoder(store, name, fast, whole=True)
    writer.give()
    writer.guarded(f"{name}: cannot encode: {{error}}")
    return writer.function("def encode(m):", "encode")  # type: ignore[no-any-return]


def decoder(store: Any, name: str, fast: Fast, other: Callable[[bytes], Any]) -> Callable[[bytes | memoryview], Any]:
    """The decoder of a whole message, which raises CodecError on anything malformed.

    `other` decodes what does not begin as little-endian CDR: big-endian messages, or none at all.
    """
    writer = _decoder(store, name, fast, whole=True)
    writer.lines.append(f"m, p = {writer.build(name, '')}, {writer.position()}")
    writer.guarded(f"{name}: cannot decode {{len(b)}} bytes: {{error}}")
    head = [
        "if b.__class__ is not bytes: b = bytes(b)",
        f"if b[:2] != {HEADER[:2]!r}: return {writer.name(other)}(b)",
    ]
    end = [  # some encoders pad the end to a multiple of four
        "if 0 <= len(b) - p < 4: return m",
        f"raise CodecError(f'{name}: {{len(b)}} bytes, but the message ends at {{p}}')",
    ]
    writer.lines = head + writer.lines + end
    return writer.function("def decode(b):", "decode")  # type: ignore[no-any-return]
