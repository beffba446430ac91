"""References: a cut of a recording that one service is held to, small enough for a repository.

A reference is an MCAP file like any recording, with the service's inputs, its outputs and, as an attachment, its scenario. Times
are shifted so that it begins at zero, and floats keep 24 bits (relative 3e-8), which is what makes it small. The outputs are what
the service gives on the rounded inputs, so on one platform a reference differs from a replay by that rounding alone.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer

from palpate.replay.compare import Tolerance, TopicResult, compare
from palpate.replay.rerun import rerun
from palpate_bus import implementations
from palpate_bus.contract import MS, Contract, Topic, contract
from palpate_bus.messages import codec
from palpate_bus.messages.stamps import nanoseconds, time_message
from palpate_bus.recordings import SCENARIO, RecordedMessage, Recording, RecordingError, open_recording
from palpate_bus.service import Service
from palpate_models.scenario.load import load_scenario, view_of
from palpate_models.scenario.schema import Scenario
from palpate_plugins import PluginError

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
    return codec.encode(_rounded_value(codec.decode(payload, topic.type), shift), topic.type)


def _rounded_value(value: Any, shift: int) -> Any:
    if getattr(value, "__msgtype__", "") == "builtin_interfaces/msg/Time":
        return time_message(max(nanoseconds(value) - shift, 0))
    if is_dataclass(value) and not isinstance(value, type):
        changed = {f.name: _rounded_value(getattr(value, f.name), shift) for f in fields(value) if not f.name.startswith("__")}
        return replace(value, **changed)
    if isinstance(value, list):
        return [_rounded_value(item, shift) for item in value]
    if isinstance(value, float):
        return float(_round(np.array([value]))[0])
    if isinstance(value, np.ndarray) and value.dtype == np.float64:
        return _round(value)
    return value


def _round(values: Any) -> Any:
    return (np.ascontiguousarray(values).view(np.int64) & DROPPED_BITS).view(np.float64)


def write_recording(
    path: Path, rules: Contract, messages: Iterable[RecordedMessage], attachments: Mapping[str, tuple[str, bytes]]
) -> None:
    """Writes messages to an MCAP file; an old file is replaced only when the new one is complete.

    `attachments`: media type and content by name.
    """
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
        for name, (kind, data) in attachments.items():
            writer.add_attachment(0, 0, name, kind, data)
        writer.finish()
    part.replace(path)


def _register(writer: Writer, topic: Topic) -> int:
    schema = writer.register_schema(topic.type, "ros2msg", codec.definition(topic.type).encode())
    channel: int = writer.register_channel(f"/{topic.name}", "cdr", schema, {"topic_type_hash": topic.type_hash})
    return channel


@dataclass(frozen=True)
class GoldenCase:
    """One service against one recording."""

    recording: Recording
    role: str
    service: Service
    scenario: str
    """As YAML."""
    rules: Contract

    @property
    def inputs(self) -> tuple[str, ...]:
        """Topics that the service reads and the recording has."""
        return tuple(topic.name for topic, _ in self.rules.inputs(self.role) if topic.name in self.recording.types)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Topics that the service writes and the recording has."""
        return tuple(topic.name for topic in self.rules.outputs(self.role) if topic.name in self.recording.types)

    @property
    def end(self) -> int:
        """Last tick of the role in the recording [ns]: of its periodic outputs, or else the recording's last stamp."""
        period = self.rules.roles[self.role].period
        periodic = [t for t in self.outputs if self.rules.topics[t].periodic and self.recording.counts[t]]
        if periodic:
            return max((self.recording.counts[t] - 1) * self.rules.topics[t].period for t in periodic)
        return self.recording.last - self.recording.last % period


def prepare(path: Path, choice: str, scenario: Path | None = None) -> GoldenCase:
    """Opens a recording and makes the service `choice`: ROLE as the scenario has it, or ROLE=NAME_OR_FILE.

    The scenario is `scenario`, else the recording's own, else the one beside it. Raises RecordingError, PluginError or
    ScenarioError.
    """
    rules = contract()
    role, _, name = choice.partition("=")
    workers = [row.name for row in rules.roles.values() if not row.observer and row.name != "conductor"]
    if role not in workers:
        raise PluginError(f"--service {choice}: no service {role!r}; services are {', '.join(workers)}")
    if name:
        implementations.check(role, name)
    recording = open_recording(path)
    text = scenario.read_text(encoding="utf-8") if scenario else recording.scenario or _beside(path, role)
    topics = [topic.name for topic, _ in rules.inputs(role)] + [topic.name for topic in rules.outputs(role)]
    recording.check(rules, topics)
    if not any(recording.counts.get(topic.name) for topic in rules.outputs(role)):
        raise RecordingError(f"{path}: has nothing that {role} sent, so there is nothing to compare with")
    loaded = load_text(text)
    service = implementations.create(role, name or getattr(loaded.services, role), loaded)
    return GoldenCase(recording, role, service, text, rules)


def load_text(text: str) -> Scenario:
    """A scenario from YAML text. Raises ScenarioError."""
    with tempfile.TemporaryDirectory(prefix="palpate-replay-") as folder:
        file = Path(folder) / "recorded.yaml"
        file.write_text(text, encoding="utf-8")
        return load_scenario(str(file))


def _beside(path: Path, role: str) -> str:
    name = f"{view_of(role)}.yaml"  # as in a run
    for folder in (path, *path.resolve().parents[:2]):
        if (folder / name).is_file():
            return (folder / name).read_text(encoding="utf-8")
    raise RecordingError(f"{path}: no {name} in it or beside it; {role} needs the scenario of the run: --scenario FILE")


def replay_service(
    case: GoldenCase, tolerance: Tolerance, tell: Callable[[int], None] = lambda _: None
) -> dict[str, TopicResult]:
    """Re-runs the service and compares all that it sends; `tell` hears how far it is [ns], with each message."""

    def sent() -> Iterator[RecordedMessage]:
        for message in rerun(case.service, case.rules, case.recording.messages(case.inputs), case.end):
            tell(message.stamp)
            yield message

    expected = case.recording.messages(case.outputs, end=case.end)
    results = compare(expected, sent(), case.rules, tolerance, case.outputs)
    facts = case.service.finish()
    del facts
    return results


def make_reference(case: GoldenCase, path: Path, begin: int, end: int) -> None:
    """Writes what the service gets from `begin` to `end` [ns], and what it answers, as a reference."""
    period = case.rules.roles[case.role].period
    begin -= begin % max(period, 100 * MS)  # a tick of every role
    end = min(end, case.end)
    given = list(cut(case.recording, case.rules, case.inputs, begin, end))
    last = (end - begin) // period * period
    answered = rerun(case.service, case.rules, iter(given), last)
    messages = chain(given, _rounded(answered, case.rules))
    write_recording(path, case.rules, messages, {SCENARIO: ("application/yaml", case.scenario.encode())})


def _rounded(messages: Iterator[RecordedMessage], rules: Contract) -> Iterator[RecordedMessage]:
    for message in messages:
        yield message._replace(payload=rounded(rules.topics[message.topic], message.payload))
