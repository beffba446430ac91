"""Messages as flat fields: names without indices, values as numbers or words."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_bus.contract import Contract, Topic
from palpate_bus.messages import codec
from palpate_bus.recordings import RecordedMessage

Words = tuple[str | bool, ...]
Value = NDArray[Any] | Words


def flat(message: Any, prefix: str = "") -> Iterator[tuple[str, Value]]:
    """Every leaf of a message: its dotted name, and its numbers as an array of one dimension or its words.

    The items of a list of messages share a name. Image and point-cloud bytes that hold floats come as floats.
    """
    for row in fields(message):
        if row.name.startswith("__"):
            continue
        name, value = f"{prefix}{row.name}", getattr(message, row.name)
        if row.name == "data" and (pixels := _floats(message)) is not None:
            yield name, pixels
        elif is_dataclass(value):
            yield from flat(value, f"{name}.")
        elif isinstance(value, list) and value and is_dataclass(value[0]):
            yield name, np.array([len(value)])
            for item in value:
                yield from flat(item, f"{name}.")
        elif isinstance(value, str | bool):
            yield name, (value,)
        elif isinstance(value, list):
            yield name, tuple(value)
        else:
            yield name, np.atleast_1d(value)


def _floats(message: Any) -> NDArray[np.float32] | None:
    """The floats in the bytes of a depth image or point cloud; None for any other message."""
    kind = getattr(message, "__msgtype__", "")
    if kind == "sensor_msgs/msg/Image" and message.encoding == "32FC1":
        return np.asarray(message.data, np.uint8).view(np.float32)
    if kind == "sensor_msgs/msg/PointCloud2" and message.fields and all(f.datatype == f.FLOAT32 for f in message.fields):
        return np.asarray(message.data, np.uint8).view(np.float32)
    return None


RELATIVE = 1e-6
"""Default tolerance, as a part of a field's range in the contract; without a range, of the value or of one, whichever is more.

On the platform of the recording a service gives the same bits; other processors and libraries differ in the last ones."""


@dataclass(frozen=True)
class Tolerance:
    """How far a number may be from the recorded one."""

    relative: float = RELATIVE
    absolute: Mapping[str, float] = field(default_factory=dict)
    """By `topic:field`, in the field's unit; a field holds for all below it. Wins over `relative`."""

    def of(self, topic: Topic, name: str) -> tuple[float, float]:
        """Absolute and relative part for a field."""
        for part in _upwards(name):
            key = f"{topic.name}:{part}"
            if key in self.absolute:
                return self.absolute[key], 0.0
            if part in topic.ranges:
                low, high = topic.ranges[part]
                return self.relative * (high - low), 0.0
        return self.relative, self.relative


def _upwards(name: str) -> Iterator[str]:
    while name:
        yield name
        name = name.rpartition(".")[0]


@dataclass
class FieldDifference:
    """The worst difference of one field, as a part of its tolerance."""

    name: str
    stamp: int
    recorded: str
    got: str
    deviation: float
    """In the field's unit; infinite where words, sizes or NaNs differ."""
    tolerance: float

    @property
    def ratio(self) -> float:
        """Deviation over tolerance."""
        if self.deviation == 0:
            return 0.0
        return self.deviation / self.tolerance if self.tolerance > 0 else float("inf")


@dataclass
class TopicResult:
    """How one output topic compares."""

    topic: str
    messages: int = 0
    """Compared."""
    identical: int = 0
    """How many of the compared messages are equal byte for byte."""
    missing: int = 0
    """Recorded, but not sent now."""
    extra: int = 0
    """Sent now, but not recorded."""
    off_time: int = 0
    """Sent at another tick than recorded."""
    worst: dict[str, FieldDifference] = field(default_factory=dict)

    @property
    def violations(self) -> list[FieldDifference]:
        """Fields beyond their tolerance, worst first."""
        return sorted((d for d in self.worst.values() if d.ratio > 1), key=lambda d: -d.ratio)

    @property
    def agrees(self) -> bool:
        """Whether the service sent what was recorded, within tolerance."""
        return not (self.missing or self.extra or self.off_time or self.violations)


def compare(
    expected: Iterable[RecordedMessage],
    sent: Iterable[RecordedMessage],
    rules: Contract,
    tolerance: Tolerance,
    topics: Iterable[str],
) -> dict[str, TopicResult]:
    """Pairs messages by topic and sequence number; both streams are in order of their stamps. `topics` are those compared."""
    results = {name: TopicResult(name) for name in topics}
    waiting: dict[tuple[str, int], RecordedMessage] = {}
    recorded = iter(expected)
    following = next(recorded, None)
    for now in sent:
        result = results.get(now.topic)
        if result is None:
            continue
        while following is not None and following.stamp <= now.stamp:
            waiting[following.topic, following.sequence] = following
            following = next(recorded, None)
        then = waiting.pop((now.topic, now.sequence), None)
        if then is None:
            result.extra += 1
            continue
        result.messages += 1
        result.off_time += then.stamp != now.stamp
        if then.payload == now.payload:
            result.identical += 1
        else:
            _differ(result, rules.topics[now.topic], then, now, tolerance)
    for left in waiting.values():
        results[left.topic].missing += 1
    while following is not None:
        results[following.topic].missing += 1
        following = next(recorded, None)
    return results


def _differ(result: TopicResult, topic: Topic, then: RecordedMessage, now: RecordedMessage, tolerance: Tolerance) -> None:
    decode = codec.decoder(topic.type)
    was, is_now = list(flat(decode(then.payload))), list(flat(decode(now.payload)))
    if [name for name, _ in was] != [name for name, _ in is_now]:
        _note(result, FieldDifference("", now.stamp, f"{len(was)} fields", f"{len(is_now)} fields", float("inf"), 0.0))
        return
    for (name, a), (_, b) in zip(was, is_now, strict=True):
        difference = _difference(topic, name, a, b, now.stamp, tolerance)
        if difference is not None:
            _note(result, difference)


def _note(result: TopicResult, difference: FieldDifference) -> None:
    before = result.worst.get(difference.name)
    if before is None or difference.ratio > before.ratio:
        result.worst[difference.name] = difference


def _difference(topic: Topic, name: str, a: Value, b: Value, stamp: int, tolerance: Tolerance) -> FieldDifference | None:
    if isinstance(a, tuple) or isinstance(b, tuple):
        return None if a == b else FieldDifference(name, stamp, _word(a), _word(b), float("inf"), 0.0)
    if a.shape != b.shape:
        return FieldDifference(name, stamp, f"{a.size} items", f"{b.size} items", float("inf"), 0.0)
    x, y = a.astype(np.float64), b.astype(np.float64)
    off = np.abs(x - y)
    off[(x == y) | (np.isnan(x) & np.isnan(y))] = 0.0
    off[np.isnan(off)] = np.inf
    if not off.any():
        return None
    absolute, relative = tolerance.of(topic, name)
    allowed = absolute + relative * np.abs(np.where(np.isfinite(x), x, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(off == 0, 0.0, off / allowed)
    i = int(np.argmax(ratio))
    return FieldDifference(name, stamp, f"{x[i]:.9g}", f"{y[i]:.9g}", float(off[i]), float(allowed[i]))


def _word(value: Value) -> str:
    return ", ".join(repr(item) for item in value) if isinstance(value, tuple) else f"{value.size} items"
