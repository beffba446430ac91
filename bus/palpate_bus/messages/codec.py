"""Encodes and decodes ROS 2 messages as little-endian CDR with its four-byte encapsulation header.

An encoder and a decoder are generated for each type from its definition. CDR aligns each number to its own size, counted from the
end of the encapsulation. Numbers that follow one another are packed by one `struct` call. Its padding depends on where the first
number starts, modulo 8, so there are eight layouts of each such run. The bytes are those of rosbags, which reads big-endian
messages. `leaves` are the fields of a message type, and `numbers` the numbers in a message, by their path: `wrench.force.x`.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, is_dataclass
from functools import cache, cached_property, lru_cache
from struct import Struct, calcsize
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype

from palpate_bus.messages.typestore import CodecError, array_dtype, definition, message_type, store, type_hash

__all__ = ["CodecError", "Message", "decode", "decoder", "definition", "encode", "encoder", "message_type", "store", "type_hash"]

ENCAPSULATION = b"\x00\x01\x00\x00"
"""The first four bytes of little-endian CDR."""
_CODES = {
    "bool": "?", "byte": "b", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I",
    "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
"""Code of `struct` for each ROS base type of numbers."""
_SHORT = 256
"""Strings up to this length are cached as bytes: frames and names repeat."""


def padding(position: int, size: int) -> int:
    """Return the padding from `position`, encapsulation included, to the alignment of a number of `size` bytes."""
    return (4 - position) % size


def layouts(codes: str, before: int = 1) -> tuple[Struct, ...]:
    """Return the layout of a run of numbers for each position modulo 8 at which it can start.

    It ends with the padding to a number of `before` bytes.
    """
    found = []
    for start in range(8):
        text, position = "<", start
        for code in codes:
            size = calcsize(f"<{code}")
            gap = padding(position, size)
            text += f"{gap}x{code}"
            position += gap + size
        found.append(Struct(f"{text}{padding(position, before)}x"))
    return tuple(found)


_LENGTHS = layouts("I")
"""Length of a sequence, or of a string in bytes with its NUL."""


def pack_text(text: str, position: int) -> bytes:
    """Return a string that starts at `position`, padding included."""
    characters = text.encode() + b"\0"
    return _LENGTHS[position & 7].pack(len(characters)) + characters


pack_short = lru_cache(maxsize=256)(pack_text)


@lru_cache(maxsize=64)
def pack_texts(texts: tuple[str, ...], position: int) -> bytes:
    """Return strings one after another, the first at `position`."""
    data = b""
    for text in texts:
        data += pack_text(text, position + len(data))
    return data


def read_text(data: bytes, position: int) -> tuple[str, int]:
    """Return the string at `position`, and its end."""
    length, start = read_length(data, position)
    end = start + length
    if length < 1 or end > len(data) or data[end - 1]:
        raise ValueError(f"invalid string of length {length} at {start}")
    return data[start : end - 1].decode(), end


def read_length(data: bytes, position: int) -> tuple[int, int]:
    """Return the length of the sequence at `position`, and where its items start."""
    layout = _LENGTHS[position & 7]
    (length,) = layout.unpack_from(data, position)
    return length, position + layout.size


def read_array(data: bytes, position: int, dtype: np.dtype[Any], length: int) -> tuple[NDArray[Any], int]:
    """Return the `length` numbers from `position` on as a read-only view of `data`, and their end."""
    start = position + (padding(position, dtype.itemsize) if length else 0)
    return np.frombuffer(data, dtype, length, start), start + length * dtype.itemsize


def fit(value: Any, dtype: np.dtype[Any], length: int | None, field: str) -> NDArray[Any]:
    """Return `value` as a contiguous array of `dtype`, shape (length,), or of any length if that is None.

    Raises ValueError that names the field for another shape, or for an unsafe conversion (text, complex numbers, fractions for an
    integer field).
    """
    array: NDArray[Any] = np.asarray(value)
    if not (np.can_cast(array.dtype, dtype, "same_kind") or array.size == 0):
        raise ValueError(f"{field}: has {array.dtype}, expected {dtype}")
    array = np.ascontiguousarray(array, dtype) if array.ndim else array
    if array.ndim != 1 or (length is not None and array.size != length):
        raise ValueError(f"{field}: has shape {array.shape}, expected ({'n' if length is None else length},)")
    return array


def check_length(items: Sequence[Any], length: int, field: str) -> None:
    """Raise ValueError that names the field unless it has `length` items."""
    if len(items) != length:
        raise ValueError(f"{field}: has {len(items)} items, expected {length}")


def compile_encoder(name: str) -> Callable[[Any], bytes]:
    """Return a function that encodes a message of a type."""
    source = _Source()
    body = [f"data = bytearray({ENCAPSULATION!r})", *source.encode(name, "m", ""), *source.pack(), "return bytes(data)"]
    return source.compile("m", body, f"encoder of {name}")


def compile_decoder(name: str) -> Callable[[bytes], tuple[Any, int]]:
    """Return a function that decodes bytes to a message of a type, and its end. Arrays are read-only views of the bytes."""
    source = _Source()
    lines, message = source.decode(name)
    return source.compile("data", ["at = 4", *lines, *source.unpack(), f"return {message}, at"], f"decoder of {name}")


class _Source:
    """Writes the lines of one encoder or decoder."""

    def __init__(self) -> None:
        self._names: dict[str, Any] = {
            one.__name__: one for one in (fit, check_length, pack_text, pack_texts, read_text, read_length, read_array)
        }
        self._names |= {"pack_short": pack_short, "Array": np.ndarray}
        """Functions and constants that the lines use."""
        self._run: list[tuple[str, str]] = []
        """Numbers that are not packed or unpacked yet: expression and code of `struct`."""
        self._count = 0

    def compile(self, argument: str, body: list[str], what: str) -> Callable[..., Any]:
        """Return the function of one `argument` with the lines `body`; tracebacks name it `what`."""
        text = "\n".join((f"def function({argument}):", *(f" {line}" for line in body)))
        exec(compile(text, f"<{what}>", "exec"), self._names)
        function: Callable[..., Any] = self._names["function"]
        return function

    def _new(self) -> str:
        self._count += 1
        return f"v{self._count}"

    def _constant(self, value: Any) -> str:
        name = self._new()
        self._names[name] = value
        return name

    def pack(self) -> Iterator[str]:
        """Yield the line that packs the run."""
        if self._run:
            packs = self._constant(tuple(layout.pack for layout in layouts("".join(code for _, code in self._run))))
            yield f"data += {packs}[len(data) & 7]({', '.join(number for number, _ in self._run)})"
            self._run.clear()

    def unpack(self) -> Iterator[str]:
        """Yield the lines that unpack the run."""
        if self._run:
            yield f"layout = {self._constant(layouts(''.join(code for _, code in self._run)))}[at & 7]"
            yield f"{', '.join(number for number, _ in self._run)}, = layout.unpack_from(data, at)"
            yield "at += layout.size"
            self._run.clear()

    def encode(self, name: str, expression: str, path: str) -> Iterator[str]:
        """Yield the lines that append a message of a type to `data`. `path`: that of the message, for errors."""
        for field, (kind, detail) in store.get_msgdef(name).fields:
            here, there = f"{expression}.{field}", f"{path}{field}"
            if kind == Nodetype.NAME:
                inner = self._new()
                yield f"{inner} = {here}"
                yield from self.encode(detail, inner, f"{there}.")
            elif kind == Nodetype.BASE and detail[0] != "string":
                self._run.append((here, _CODES[detail[0]]))
            else:
                yield from self.pack()
                if kind == Nodetype.BASE:
                    pack = f"pack_short if len({here}) < {_SHORT} else pack_text"
                    yield f"data += ({pack})({here}, len(data) & 3)"
                else:
                    yield from self._encode_items(detail[0], here, there, detail[1] if kind == Nodetype.ARRAY else None)

    def _encode_items(self, item: Any, here: str, path: str, length: int | None) -> Iterator[str]:
        """Yield the lines that append an array of `length` items, or a sequence of any length if that is None."""
        kind, detail = item
        items = self._new()
        if kind == Nodetype.BASE and detail[0] != "string":
            dtype = array_dtype(detail[0])
            wanted, shape = self._constant(dtype), "ndim == 1" if length is None else f"shape == ({length},)"
            fits = f"{items}.__class__ is Array and {items}.dtype == {wanted} and {items}.{shape} and {items}.flags.c_contiguous"
            yield f"{items} = {here}"
            yield f"if not ({fits}): {items} = fit({items}, {wanted}, {length}, {path!r})"
            if length is None:
                length_packs = f"({self._padded} if {items}.size else {self._lengths})" if dtype.itemsize == 8 else self._lengths
                yield f"data += {length_packs}[len(data) & 7]({items}.size)"
            else:
                pads = tuple(bytes(padding(position, dtype.itemsize)) for position in range(8))
                yield f"data += {self._constant(pads)}[len(data) & 7]"
            yield f"data += {items}.data"
            return
        yield f"{items} = {here}"
        if length is None:
            yield f"data += {self._lengths}[len(data) & 7](len({items}))"
        else:
            yield f"check_length({items}, {length}, {path!r})"
        if kind == Nodetype.BASE:
            yield f"data += pack_texts(tuple({items}), len(data) & 3)"
        else:
            one = self._new()
            yield f"for {one} in {items}:"
            yield from (f" {line}" for line in (*self.encode(detail, one, f"{path}."), *self.pack()))

    @cached_property
    def _lengths(self) -> str:
        return self._constant(tuple(layout.pack for layout in _LENGTHS))

    @cached_property
    def _padded(self) -> str:
        """The name of the functions that pack a length before items of eight bytes."""
        return self._constant(tuple(layout.pack for layout in layouts("I", before=8)))

    def decode(self, name: str) -> tuple[list[str], str]:
        """Return the lines that read a message of a type from `data` at `at`, and the expression that makes it."""
        lines: list[str] = []
        values = []
        for _, (kind, detail) in store.get_msgdef(name).fields:
            if kind == Nodetype.NAME:
                inner, value = self.decode(detail)
                lines += inner
            elif kind == Nodetype.BASE and detail[0] != "string":
                value = self._new()
                self._run.append((value, _CODES[detail[0]]))
            else:
                lines += self.unpack()
                value = self._new()
                if kind == Nodetype.BASE:
                    lines.append(f"{value}, at = read_text(data, at)")
                else:
                    lines += self._decode_items(detail[0], value, detail[1] if kind == Nodetype.ARRAY else None)
            values.append(value)
        return lines, f"{self._constant(message_type(name))}({', '.join(values)})"

    def _decode_items(self, item: Any, value: str, length: int | None) -> Iterator[str]:
        """Yield the lines that read an array of `length` items, or a sequence if that is None."""
        kind, detail = item
        yield "length, at = read_length(data, at)" if length is None else f"length = {length}"
        if kind == Nodetype.BASE and detail[0] != "string":
            yield f"{value}, at = read_array(data, at, {self._constant(array_dtype(detail[0]))}, length)"
            return
        lines, one = ([], self._new()) if kind == Nodetype.BASE else self.decode(detail)
        body = [f"{one}, at = read_text(data, at)"] if kind == Nodetype.BASE else [*lines, *self.unpack()]
        yield from (f"{value} = []", "for _ in range(length):", *(f" {line}" for line in body), f" {value}.append({one})")


_LITTLE_ENDIAN = ENCAPSULATION[:2]
Message = Any
"""A message of any class. Typed classes are in `palpate_bus.messages`."""


def encode(message: Message, name: str) -> bytes:
    """Return a message as little-endian CDR. Raises CodecError if a field does not fit its type."""
    return encoder(name)(message)


def decode(payload: bytes | memoryview, name: str) -> Message:
    """Return the message in CDR bytes. Arrays may be read-only views of `payload`. Raises CodecError for malformed bytes."""
    return decoder(name)(payload)


@cache
def encoder(name: str) -> Callable[[Message], bytes]:
    """Return `encode` for one type, for hot paths."""
    message_type(name)
    encode_message = compile_encoder(name)

    def encode(message: Message) -> bytes:
        try:
            return encode_message(message)
        except Exception as error:
            raise CodecError(f"{name}: cannot encode: {error}") from error

    return encode


@cache
def decoder(name: str) -> Callable[[bytes | memoryview], Message]:
    """Return `decode` for one type, for hot paths."""
    message_type(name)
    decode_message = compile_decoder(name)

    def decode(payload: bytes | memoryview) -> Message:
        try:
            if payload[:2] != _LITTLE_ENDIAN:  # rosbags reads big-endian messages
                return store.deserialize_cdr(memoryview(payload), name)
            message, end = decode_message(bytes(payload))
            if not 0 <= len(payload) - end < 4:  # some encoders pad the end to a multiple of four
                raise ValueError(f"the message ends at {end}")
        except Exception as error:
            raise CodecError(f"{name}: cannot decode {len(payload)} bytes: {error}") from error
        return message

    return decode


@cache
def passer(name: str) -> Callable[[Message], Message | None]:
    """Return a function that returns a message equal to a decoded one, or None if it has to be decoded.

    Arrays and lists are copied, since their owner may write to them later. Arrays are read-only, as decoded ones are.
    """
    lines, values = ["def passed(m):"], []
    names: dict[str, Any] = {"Type": message_type(name), "Array": np.ndarray}
    numbers = set()
    for k, (field, (kind, detail)) in enumerate(store.get_msgdef(name).fields):
        if kind not in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            values.append(f"m.{field}")
        elif detail[0][0] == Nodetype.NAME or detail[0][1][0] == "string":
            values.append(f"list(m.{field})")
        else:
            names[f"dtype{k}"] = array_dtype(detail[0][1][0])
            lines += (
                f" v{k} = m.{field}",
                f" if v{k}.__class__ is not Array or v{k}.dtype != dtype{k}: return None",
                f" v{k} = v{k}.copy()",
                f" v{k}.setflags(write=False)",
            )
            values.append(f"v{k}")
            numbers.add(field)
    if not _exact(name, but=frozenset(numbers)):
        return lambda _: None
    if not numbers:
        return lambda message: message
    exec(compile("\n".join((*lines, f" return Type({', '.join(values)})")), f"<passer of {name}>", "exec"), names)
    passed: Callable[[Message], Message | None] = names["passed"]
    return passed


def _exact(name: str, but: frozenset[str] = frozenset()) -> bool:
    """Return True if encoding and decoding gives equal fields: they have no arrays of numbers and no float32, except in `but`."""
    for field, (kind, detail) in store.get_msgdef(name).fields:
        item_kind, item = detail[0] if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) else (kind, detail)
        if item_kind == Nodetype.NAME:
            if not _exact(item):
                return False
        elif field not in but and (item[0] == "float32" or (kind != item_kind and item[0] != "string")):
            return False
    return True


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
