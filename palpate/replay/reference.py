"""References: a cut of a recording that one service is held to, small enough for a repository.

A reference is an MCAP file like any recording, with the service's inputs, its outputs and, as an attachment, its scenario. Times
are shifted so that it begins at zero, and floats keep 24 bits (relative 3e-8), which is what makes it small. The outputs are what
the service gives on the rounded inputs, so on one platform a reference differs from a replay by that rounding alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer

from palpate_bus.contract import Contract, Topic
from palpate_bus.messages import codec
from palpate_bus.messages.stamps import nanoseconds, time_message
from palpate_bus.recordings import SCENARIO, RecordedMessage, Recording

DROPPED_BITS = np.int64(~((1 << 29) - 1))
"""Keeps 23 of the 52 fraction bits of a double, and so 24 significant ones."""


def cut(recording: Recording, rules: Contract, topics: Iterable[str], begin: int, end: int) -> Iterator[RecordedMessage]:
    """The messages of `topics` from `begin` to `end` [ns], rounded, shifted to zero and numbered anew.

    What each topic carried last before `begin` comes first, as a late joiner would find it.
    """
    names = tuple(topics)
    numbers = dict.fromkeys(names, 0)
    before: dict[str, RecordedMessage] = {}
    if begin > 0:
        for message in recording.messages(names, None, begin - 1):
            before[message.topic] = message
    kept = [replace_stamp(m, begin) for m in before.values() if not rules.topics[m.topic].periodic]
    for message in [*kept, *recording.messages(names, begin, end)]:
        topic = rules.topics[message.topic]
        numbers[topic.name] += 1
        stamp = message.stamp - begin
        sequence = stamp // topic.period + 1 if topic.periodic else numbers[topic.name]
        yield RecordedMessage(stamp, topic.name, rounded(topic, message.payload, begin), sequence)


def replace_stamp(message: RecordedMessage, stamp: int) -> RecordedMessage:
    """The message as if it had been sent at `stamp` [ns]."""
    return message._replace(stamp=stamp)


def rounded(topic: Topic, payload: bytes, shift: int = 0) -> bytes:
    """A message with its doubles rounded and its time stamps `shift` [ns] earlier (not before zero)."""
    return codec.encode(_rounded(codec.decode(payload, topic.type), shift), topic.type)


def _rounded(value: Any, shift: int) -> Any:
    if getattr(value, "__msgtype__", "") == "builtin_interfaces/msg/Time":
        return time_message(max(nanoseconds(value) - shift, 0))
    if is_dataclass(value) and not isinstance(value, type):
        changed = {f.name: _rounded(getattr(value, f.name), shift) for f in fields(value) if not f.name.startswith("__")}
        return replace(value, **changed)
    if isinstance(value, list):
        return [_rounded(item, shift) for item in value]
    if isinstance(value, float):
        return float(_round(np.array([value]))[0])
    if isinstance(value, np.ndarray) and value.dtype == np.float64:
        return _round(value)
    return value


def _round(values: Any) -> Any:
    return (np.ascontiguousarray(values).view(np.int64) & DROPPED_BITS).view(np.float64)


def write_reference(path: Path, rules: Contract, messages: Iterable[RecordedMessage], scenario: str) -> None:
    """Writes a reference file; an old one is replaced only when the new one is complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    with part.open("wb") as stream:
        writer = Writer(stream, chunk_size=1 << 24, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="palpate-replay")
        channels: dict[str, int] = {}
        for message in messages:
            if message.topic not in channels:
                channels[message.topic] = _register(writer, rules.topics[message.topic])
            writer.add_message(channels[message.topic], message.stamp, message.payload, message.stamp, message.sequence)
        writer.add_attachment(0, 0, SCENARIO, "application/yaml", scenario.encode())
        writer.finish()
    part.replace(path)


def _register(writer: Writer, topic: Topic) -> int:
    schema = writer.register_schema(topic.type, "ros2msg", codec.definition(topic.type).encode())
    channel: int = writer.register_channel(f"/{topic.name}", "cdr", schema, {"topic_type_hash": topic.type_hash})
    return channel
