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
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from palpate_bus.messages.cdr_parts import StringsReader
from palpate_bus.messages.cdr_writer import Codec, Fast, Field, Writer

HEADER = b"\x00\x01\x00\x00"
"""Encapsulation header of little-endian CDR."""

_FORMAT = {
    "bool": "?", "byte": "b", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I",
    "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
_DTYPE = {name: np.dtype({"bool": "?", "byte": "i1", "char": "u1"}.get(name, name)) for name in _FORMAT}


class _Encoder(Writer):
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

    def scalar(self, field: Field, code: str) -> None:
        self.number(code, field.value)

    def string(self, field: Field) -> None:
        part = self.variable()
        self.lines.append(f"{part} = {field.value}.encode() + b'\\0'")
        self.number("I", f"len({part})")
        self.flush()
        self.advance(f"len({part})")
        self.parts.append(part)

    def array(self, field: Field, dtype: np.dtype[Any], length: int) -> None:
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

    def items(self, field: Field, item: Any, length: int) -> None:
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


class _Decoder(Writer):
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

    def scalar(self, field: Field, code: str) -> None:
        self.values[field.path] = self.number(code, self.variable())

    def string(self, field: Field) -> None:
        value, n = self.variable(), self.number("I", self.variable())
        self.flush()
        place = self.position()
        self.lines.append(f"e = {place} + {n}")
        self.lines.append(f"if {n} < 1 or e > len(b) or b[e - 1]:")
        self.lines.append(f"  raise ValueError(f'{field.path}: invalid string of length {{{n}}} at {{{place}}}')")
        self.lines.append(f"{value} = b[{place}:e - 1].decode() if {n} > 1 else ''; p = e")
        self.held()
        self.values[field.path] = value

    def array(self, field: Field, dtype: np.dtype[Any], length: int) -> None:
        n = str(length) if length >= 0 else self.number("I", self.variable())
        self.flush()
        if dtype.itemsize > 1:  # alignment counts from the end of the encapsulation header
            pad = f"(-({self.position()} - {self.counted}) & {dtype.itemsize - 1})"
            self.advance(pad if length >= 0 else f"({pad} if {n} else 0)")
        value = self.values[field.path] = self.variable()
        self.lines.append(f"{value} = frombuffer(b, {self.name(dtype)}, {n}, {self.position()})")
        self.advance(f"{n} * {dtype.itemsize}")

    def items(self, field: Field, item: Any, length: int) -> None:
        n = str(length) if length >= 0 else self.number("I", self.variable())
        self.flush()
        self.hold()
        value = self.values[field.path] = self.variable()
        if item[0] == Nodetype.BASE:
            self.lines.append(f"{value}, p = {self.name(StringsReader())}(b, p, {n})")
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


def _flat(store: Any, name: str, value: str, path: str = "") -> list[Field]:
    """The fields of a message with nested messages opened up; those stand as their paths below `value`."""
    out: list[Field] = []
    for field, kind in store.get_msgdef(name).fields:
        inner = f"{value}.{field}"
        out += _flat(store, kind[1], inner, f"{path}{field}.") if kind[0] == Nodetype.NAME else [Field(inner, path + field, kind)]
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


def _write(writer: _Encoder | _Decoder, fields: list[Field]) -> None:
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
