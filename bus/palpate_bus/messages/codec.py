"""ROS 2 messages in CDR, by `rosbags`, with the interfaces of ROS 2 Jazzy and of `palpation_msgs`.

A message type is named as in ROS (`sensor_msgs/msg/JointState`). `message_type(name)` is its dataclass; `encode` and `decode`
convert to and from little-endian CDR with its four-byte encapsulation header; `type_hash` is the RIHS01 hash that rmw_zenoh
puts into the key.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from palpate_bus.messages import cdr
from palpate_bus.messages.cdr_parts import CodecError
from palpate_bus.messages.cdr_writer import Codec

__all__ = [
    "CodecError",
    "Message",
    "decode",
    "decoder",
    "encode",
    "encoder",
    "message_type",
    "palpation_definitions",
    "store",
    "type_hash",
]

Message = Any
"""A message instance. Message classes are generated at run time from .msg files, so they have no static type."""


def _interface_package() -> Path:
    """The folder of the ROS 2 interface package `palpation_msgs`, in a wheel or in a checkout."""
    package = Path(__file__).resolve().parents[1]
    packaged = package / "palpation_msgs"
    return packaged if packaged.is_dir() else package.parent / "palpation_msgs"


def palpation_definitions() -> dict[str, str]:
    """The .msg text of every message of `palpation_msgs`, by type name."""
    return {
        f"palpation_msgs/msg/{path.stem}": path.read_text(encoding="utf-8")
        for path in sorted((_interface_package() / "msg").glob("*.msg"))
    }


def _load_store() -> Any:
    store = get_typestore(Stores.ROS2_JAZZY)
    types: dict[str, Any] = {}
    for name, text in palpation_definitions().items():
        types.update(get_types_from_msg(text, name))
    store.register(types)
    return store


store: Any = _load_store()
"""The rosbags typestore: ROS 2 Jazzy's interfaces and ours."""


@cache
def message_type(name: str) -> Any:
    """The dataclass of a message type, e.g. `message_type("std_msgs/msg/Header")`.

    Raises CodecError if neither ROS 2 Jazzy nor `palpation_msgs` has it.
    """
    try:
        return store.types[name]
    except KeyError:
        raise CodecError(f"no such message type: {name!r} (ROS 2 Jazzy and palpation_msgs are known)") from None


@cache
def type_hash(name: str) -> str:
    """The RIHS01 hash of a message type, `RIHS01_<64 hex digits>`."""
    message_type(name)
    return str(store.hash_rihs01(name))


@cache
def _fast(name: str) -> Codec:
    """The generated codec of a type inside others. Raises KeyError if it has a field that only rosbags knows how to encode."""
    return cdr.nested(store, name, _fast)


def encode(message: Message, name: str) -> bytes:
    """A message as little-endian CDR. Raises CodecError if a field does not fit its type."""
    return encoder(name)(message)


def decode(payload: bytes | memoryview, name: str) -> Message:
    """The message in CDR bytes. Arrays may be read-only views of `payload`. Raises CodecError on anything malformed."""
    return decoder(name)(payload)


@cache
def encoder(name: str) -> Callable[[Message], bytes]:
    """`encode` for one type, for hot paths."""
    message_type(name)
    try:
        return cdr.encoder(store, name, _fast)
    except KeyError:
        return partial(_rosbags_encode, name)


@cache
def decoder(name: str) -> Callable[[bytes | memoryview], Message]:
    """`decode` for one type, for hot paths."""
    message_type(name)
    other = partial(_rosbags_decode, name)
    try:
        return cdr.decoder(store, name, _fast, other)
    except KeyError:
        return other


def _rosbags_encode(name: str, message: Message) -> bytes:
    try:
        return bytes(store.serialize_cdr(message, name))
    except Exception as error:
        raise CodecError(f"{name}: cannot encode: {error}") from error


def _rosbags_decode(name: str, payload: bytes | memoryview) -> Message:
    try:
        return store.deserialize_cdr(payload, name)
    except Exception as error:
        raise CodecError(f"{name}: cannot decode {len(payload)} bytes: {error!r}") from error
