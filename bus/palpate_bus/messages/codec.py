"""Encodes and decodes ROS 2 messages as little-endian CDR with its four-byte encapsulation header.

`cdr` generates an encoder and a decoder for each type. Their bytes are those of rosbags, which reads big-endian messages.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from palpate_bus.messages.cdr import ENCAPSULATION, compile_decoder, compile_encoder
from palpate_bus.messages.typestore import CodecError, array_dtype, definition, message_type, store, type_hash

__all__ = ["CodecError", "Message", "decode", "decoder", "definition", "encode", "encoder", "message_type", "store", "type_hash"]

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
