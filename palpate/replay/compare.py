"""Compares the messages of a re-run service with the recorded ones, field by field."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from itertools import chain
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from palpate.console import table
from palpate_bus.contract import Contract, Topic, contract
from palpate_bus.messages import NS, codec
from palpate_bus.recordings import RecordedMessage
from palpate_plugins import PluginError

Value = NDArray[Any] | tuple[str | bool, ...]
"""Numbers, or strings and booleans."""


def flat(message: Any, prefix: str = "") -> Iterator[tuple[str, Value]]:
    """Yield dotted name and value of every leaf of a message: numbers as a one-dimensional array, else strings or booleans.

    The items of a list of messages share a name. Image and point-cloud bytes that hold floats are returned as floats.
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
    """Return the floats in the bytes of a depth image or point cloud; None for any other message."""
    kind = getattr(message, "__msgtype__", "")
    image = kind == "sensor_msgs/msg/Image" and message.encoding == "32FC1"
    cloud = kind == "sensor_msgs/msg/PointCloud2" and message.fields and all(f.datatype == f.FLOAT32 for f in message.fields)
    return np.asarray(message.data, np.uint8).view(np.float32) if image or cloud else None


RELATIVE = 1e-6
"""Default tolerance, as a part of a field's range in the contract; without a range, of the value or of 1, whichever is greater.

On the platform of the recording a service returns the same bits; with other processors and libraries the last bits differ."""


@dataclass(frozen=True)
class Tolerance:
    """Allowed difference of numbers from the recorded ones."""

    relative: float = RELATIVE
    absolute: Mapping[str, float] = field(default_factory=dict)
    """By `topic:field`, in the field's unit; applies to all fields below it, too. Takes precedence over `relative`."""

    def of(self, topic: Topic, name: str) -> tuple[float, float]:
        """Return the absolute and the relative part for a field."""
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
    """Deviation in the field's unit; infinite if strings, sizes or NaNs differ."""
    tolerance: float

    @property
    def ratio(self) -> float:
        """Deviation divided by tolerance."""
        if self.deviation == 0:
            return 0.0
        return self.deviation / self.tolerance if self.tolerance > 0 else float("inf")


@dataclass
class TopicResult:
    """Comparison of one output topic."""

    topic: str
    messages: int = 0
    """Compared messages."""
    identical: int = 0
    """Compared messages that are equal byte for byte."""
    missing: int = 0
    """Recorded messages that were not sent."""
    extra: int = 0
    """Sent messages that were not recorded."""
    off_time: int = 0
    """Messages sent at another tick than recorded."""
    worst: dict[str, FieldDifference] = field(default_factory=dict)
    """By field."""

    @property
    def violations(self) -> list[FieldDifference]:
        """Fields beyond their tolerance, worst first."""
        return sorted((d for d in self.worst.values() if d.ratio > 1), key=lambda d: -d.ratio)

    @property
    def agrees(self) -> bool:
        """True if the sent messages are the recorded ones, within tolerance."""
        return not (self.missing or self.extra or self.off_time or self.violations)


def compare(
    expected: Iterable[RecordedMessage],
    sent: Iterable[RecordedMessage],
    contract: Contract,
    tolerance: Tolerance,
    topics: Iterable[str],
) -> dict[str, TopicResult]:
    """Return the comparison of `topics`; messages are paired by topic and sequence number. Both streams are ordered by stamp."""
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
            _differ(result, contract.topics[now.topic], then, now, tolerance)
    for left in chain(waiting.values(), [] if following is None else [following], recorded):
        results[left.topic].missing += 1
    return results


def _differ(result: TopicResult, topic: Topic, then: RecordedMessage, now: RecordedMessage, tolerance: Tolerance) -> None:
    decode = codec.decoder(topic.type)
    was, is_now = list(flat(decode(then.payload))), list(flat(decode(now.payload)))
    found: list[FieldDifference | None]
    if [name for name, _ in was] == [name for name, _ in is_now]:
        found = [_difference(topic, name, a, b, now.stamp, tolerance) for (name, a), (_, b) in zip(was, is_now, strict=True)]
    else:
        found = [FieldDifference("", now.stamp, f"{len(was)} fields", f"{len(is_now)} fields", float("inf"), 0.0)]
    for difference in filter(None, found):
        before = result.worst.get(difference.name)
        if before is None or difference.ratio > before.ratio:
            result.worst[difference.name] = difference


def _difference(topic: Topic, name: str, a: Value, b: Value, stamp: int, tolerance: Tolerance) -> FieldDifference | None:
    if isinstance(a, tuple) or isinstance(b, tuple):
        was, got = (", ".join(map(repr, value)) for value in (a, b))
        return None if a == b else FieldDifference(name, stamp, was, got, float("inf"), 0.0)
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


def parse_tolerance(options: list[str]) -> Tolerance:
    """Return the tolerance of `--tolerance` options. Raises PluginError for an invalid one."""
    relative, absolute = RELATIVE, {}
    for option in options:
        name, _, number = option.rpartition("=")
        try:
            value = float(number)
        except ValueError:
            raise PluginError(f"--tolerance {option}: expected a number, or TOPIC:FIELD=NUMBER") from None
        if not value >= 0:
            raise PluginError(f"--tolerance {option}: expected at least 0")
        if not name:
            relative = value
            continue
        topic = name.partition(":")[0]
        if topic not in contract().topics:
            raise PluginError(f"--tolerance {option}: the contract has no topic {topic!r}")
        absolute[name] = value
    return Tolerance(relative, absolute)


def as_dict(result: TopicResult) -> dict[str, Any]:
    """Return a result for `--json`, which has no infinity: null."""
    row = asdict(result)
    row["agrees"] = result.agrees
    worst = sorted(result.worst.values(), key=lambda d: -d.ratio)
    row["worst"] = [{**asdict(d), "deviation": _finite(d.deviation), "ratio": _finite(d.ratio)} for d in worst]
    return row


def _finite(number: float) -> float | None:
    return number if isfinite(number) else None


def result_table(results: Mapping[str, TopicResult]) -> Table:
    """Return the comparison with a row per topic."""
    counted = ("messages", "identical", "missing", "extra")
    shown = table("topic", *counted, "worst field", "difference", "allowed", "at [s]")
    for result in results.values():
        worst = max(result.worst.values(), key=lambda d: d.ratio, default=None)
        counts = [str(getattr(result, name)) for name in counted]
        cells = []
        if worst is not None:
            off = f"{worst.deviation:.3g}" if worst.deviation != float("inf") else f"{worst.recorded} -> {worst.got}"
            cells = [worst.name, off, f"{worst.tolerance:.3g}", f"{worst.stamp / NS:.3f}"]
        shown.add_row(result.topic, *counts, *cells, style=None if result.agrees else "red")
    return shown
