"""Headers, strings and alignment in little-endian CDR, for the codecs written with `struct`.

CDR aligns each number to its own size, counted from the end of the four-byte encapsulation.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from struct import Struct
from typing import Any, NamedTuple

from palpate_bus.messages import Header, Time

ENCAPSULATION = b"\x00\x01\x00\x00"
"""The first four bytes of little-endian CDR."""
LENGTH = Struct("<I")
"""Length of a sequence, or of a string in bytes with its NUL."""
_STAMP = Struct("<4siI")  # encapsulation, seconds, nanoseconds
_HEADER = Struct("<4siII")  # the same and the length of frame_id with its NUL


class StructCodec(NamedTuple):
    """Encoder and decoder of one message type."""

    encode: Callable[[Any], bytes]
    decode: Callable[[bytes], tuple[Any, int]]


def padding(position: int, size: int) -> int:
    """Return the padding from `position`, encapsulation included, to the alignment of a number of `size` bytes."""
    return (4 - position) % size


def pack_header(header: Header, align: int) -> bytes:
    """Return encapsulation and header, padded for a number of `align` bytes."""
    return _STAMP.pack(ENCAPSULATION, header.stamp.sec, header.stamp.nanosec) + _pack_frame(header.frame_id, align)


@lru_cache(maxsize=64)
def _pack_frame(frame_id: str, align: int) -> bytes:
    """Return the header after its stamp, padded for a number of `align` bytes. Cached: there are few frames."""
    frame = frame_id.encode() + b"\0"
    return LENGTH.pack(len(frame)) + frame + bytes(padding(_HEADER.size + len(frame), align))


def read_header(data: bytes, align: int) -> tuple[Header, int]:
    """Return the header and the position of the next number of `align` bytes."""
    _, sec, nanosec, length = _HEADER.unpack_from(data)
    frame, start = _read_frame(data[_STAMP.size : _HEADER.size + length], align)
    return Header(Time(sec, nanosec), frame), start


@lru_cache(maxsize=64)
def _read_frame(block: bytes, align: int) -> tuple[str, int]:
    """Return the frame in `block` (length and text) and the position of the next number of `align` bytes."""
    (length,) = LENGTH.unpack_from(block)
    frame, end = read_characters(block, LENGTH.size, length)
    end += _STAMP.size
    return frame, end + padding(end, align)


def read_text(data: bytes, place: int) -> tuple[str, int]:
    """Return the string at the next four-byte boundary from `place`, and its end."""
    start = place + padding(place, 4)
    (length,) = LENGTH.unpack_from(data, start)
    return read_characters(data, start + LENGTH.size, length)


def read_characters(data: bytes, start: int, length: int) -> tuple[str, int]:
    """Return the string of `length` bytes, NUL included, at `start`, and its end."""
    end = start + length
    if length < 1 or end > len(data) or data[end - 1]:
        raise ValueError(f"invalid string of length {length} at {start}")
    return data[start : end - 1].decode(), end


def pack_text(text: str) -> bytes:
    """Return a string as CDR; it must start at a four-byte boundary."""
    data = text.encode() + b"\0"
    return LENGTH.pack(len(data)) + data
