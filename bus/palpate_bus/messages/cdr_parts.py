"""What the generated code of `cdr` calls at run time: arrays and strings, and the error that everything wrong becomes."""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import Any

import numpy as np


class CodecError(ValueError):
    """Bytes that are not a message of the expected type, or a message that does not fit its type."""


def checked_array(value: Any, dtype: np.dtype[Any], length: int, where: str) -> Any:
    """`value` as a contiguous array of `dtype`, its number of items checked when `length` is not negative."""
    array = np.asarray(value)
    if not (np.can_cast(array.dtype, dtype, "same_kind") or array.size == 0):
        raise ValueError(f"{where}: has {array.dtype}, wants {dtype}")
    if array.ndim != 1 or (length >= 0 and array.size != length):
        raise ValueError(f"{where}: has shape {array.shape}, wants ({'n' if length < 0 else length},)")
    return np.ascontiguousarray(array, dtype)


@lru_cache(maxsize=512)
def pack_strings(values: tuple[str, ...], phase: int) -> bytes:
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


class StringsReader:
    """Unpacks strings; the same ones as the last time, like joint names, are recognised by their bytes."""

    def __init__(self) -> None:
        self._last: tuple[int, int, bytes, list[str]] = (-1, 0, b"", [])

    def __call__(self, data: bytes, position: int, number: int) -> tuple[list[str], int]:
        """As `_unpack_strings`; the list is the caller's own."""
        last_number, phase, block, values = self._last
        if number == last_number and position & 3 == phase and data.startswith(block, position):
            return values.copy(), position + len(block)
        values, end = _unpack_strings(data, position, number)
        self._last = (number, position & 3, data[position:end], values.copy())
        return values, end
