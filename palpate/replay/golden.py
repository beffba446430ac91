"""Golden replay: runs one service again on recorded inputs and compares its outputs; writes references for tests.

A reference is a short part of a recording, small enough for a repository: an MCAP file with the service's inputs, its outputs
and, as an attachment, its scenario. Times begin at zero, and floats keep 24 bits (relative 3e-8), which makes the file small. The
outputs are those for the rounded inputs, so on one platform a reference differs from a replay by the rounding of outputs only.
"""

import logging
import math
import tempfile
from collections.abc import Iterable, Iterator, Mapping, MutableSequence
from dataclasses import fields, is_dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.writer import CompressionType, Writer

from palpate.apart import run_guarded, shared_numbers
from palpate.console import SteadyConsole, TimeLeft, fail, print_json, wide_console
from palpate.replay.compare import Tolerance, TopicResult, as_dict, compare, parse_tolerance, result_table
from palpate_bus import Service, implementations
from palpate_bus.contract import Contract, Edge, Topic, contract
from palpate_bus.mcap_records import RecordingError
from palpate_bus.messages import MS, codec, nanoseconds, time_message
from palpate_bus.recordings import SCENARIO, RecordedMessage, Recording, open_recording
from palpate_bus.runtime.lockstep import Packet, Stepper
from palpate_bus.settings import Settings
from palpate_inputs import read_text
from palpate_models.scenario.load import load_scenario, view_of
from palpate_models.scenario.schema import Scenario
from palpate_plugins import PluginError


def rerun(
    service: Service, contract: Contract, inputs: Iterable[RecordedMessage], end: int, begin: int = 0
) -> Iterator[RecordedMessage]:
    """Yield the messages of `service` for `inputs` (ordered by stamp), from its start to the tick `end` [ns].

    The first step is at the tick `begin` [ns] and receives all earlier inputs.

    At tick T the service receives the same inputs as in the run: `same_tick` messages up to T, `previous` messages up to T minus
    the period of their topic. Observed topics are outside the barrier, so the tick at which a distributed run received a message
    of one is unknown; here it is the tick after its stamp, as in a composed run. Raises LockstepError if the service breaks its
    contract.
    """
    stepper = Stepper(service, contract)

    def deliver(message: RecordedMessage) -> None:
        stepper.buffers[message.topic].deliver(Packet(message.payload, message.stamp, message.sequence))

    late = {name for name, buffer in stepper.buffers.items() if buffer.edge is Edge.OBSERVE}
    for port, packet in stepper.start():
        yield RecordedMessage(0, port.topic.name, packet.payload, packet.sequence)
    source = iter(inputs)
    following = next(source, None)
    held: list[RecordedMessage] = []
    for t in range(begin, end + 1, stepper.role.period):
        for message in held:
            deliver(message)
        held.clear()
        while following is not None and following.stamp <= t:
            (held.append if following.topic in late and following.stamp == t else deliver)(following)
            following = next(source, None)
        for port, packet in stepper.step(t):
            yield RecordedMessage(t, port.topic.name, packet.payload, packet.sequence)


DROPPED_BITS = np.int64(~((1 << 29) - 1))
"""Mask that keeps 23 of the 52 fraction bits of a double, so 24 significant bits."""


def cut(recording: Recording, contract: Contract, topics: Iterable[str], begin: int, end: int) -> Iterator[RecordedMessage]:
    """Yield the messages of `topics` from `begin` to `end` [ns], rounded, with times and sequence numbers from zero.

    The last earlier message of each topic that is not periodic comes first, as for a late joiner.
    """
    names = tuple(topics)
    numbers = dict.fromkeys(names, 0)
    before: dict[str, RecordedMessage] = {}
    if begin > 0:
        before = {message.topic: message for message in recording.messages(names, None, begin - 1)}
    kept = [message._replace(stamp=begin) for message in before.values() if not contract.topics[message.topic].periodic]
    for message in [*kept, *recording.messages(names, begin, end)]:
        topic = contract.topics[message.topic]
        numbers[topic.name] += 1
        stamp = message.stamp - begin
        sequence = stamp // topic.period + 1 if topic.periodic else numbers[topic.name]
        yield RecordedMessage(stamp, topic.name, round_message(topic, message.payload, begin), sequence)


def round_message(topic: Topic, payload: bytes, shift: int = 0) -> bytes:
    """Return a message with rounded doubles and with time stamps `shift` [ns] earlier (not below zero)."""
    return codec.encode(_round_value(codec.decode(payload, topic.type), shift), topic.type)


def _round_value(value: Any, shift: int) -> Any:
    if getattr(value, "__msgtype__", "") == "builtin_interfaces/msg/Time":
        return time_message(max(nanoseconds(value) - shift, 0))
    if is_dataclass(value) and not isinstance(value, type):
        changed = {f.name: _round_value(getattr(value, f.name), shift) for f in fields(value) if not f.name.startswith("__")}
        return replace(value, **changed)
    if isinstance(value, list):
        return [_round_value(item, shift) for item in value]
    if isinstance(value, float):
        return float(_round(np.array([value]))[0])
    return _round(value) if isinstance(value, np.ndarray) and value.dtype == np.float64 else value


def _round(values: Any) -> Any:
    return (np.ascontiguousarray(values).view(np.int64) & DROPPED_BITS).view(np.float64)


def write_recording(
    path: Path, contract: Contract, messages: Iterable[RecordedMessage], attachments: Mapping[str, tuple[str, bytes]]
) -> None:
    """Write messages to an MCAP file and replace an old file when the new one is complete.

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
                channels[message.topic] = _register(writer, contract.topics[message.topic])
            writer.add_message(channels[message.topic], message.stamp, message.payload, message.stamp, message.sequence)
        for name, (kind, data) in attachments.items():
            writer.add_attachment(0, 0, name, kind, data)
        writer.finish()
    part.replace(path)


def _register(writer: Writer, topic: Topic) -> int:
    schema = writer.register_schema(topic.type, "ros2msg", codec.definition(topic.type).encode())
    channel: int = writer.register_channel(f"/{topic.name}", "cdr", schema, {"topic_type_hash": topic.type_hash})
    return channel


class GoldenCase(NamedTuple):
    """A service and the recording that it is compared with."""

    recording: Recording
    role: str
    service: Service
    scenario: str
    """YAML."""
    contract: Contract

    @property
    def inputs(self) -> tuple[str, ...]:
        """Recorded topics that the service reads."""
        return tuple(topic.name for topic, _ in self.contract.inputs(self.role) if topic.name in self.recording.types)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Recorded topics that the service sends."""
        return tuple(topic.name for topic in self.contract.outputs(self.role) if topic.name in self.recording.types)

    @property
    def end(self) -> int:
        """Last tick of the role in the recording [ns], from its periodic outputs, else from the recording's last stamp."""
        period = self.contract.roles[self.role].period
        periodic = [t for t in self.outputs if self.contract.topics[t].periodic and self.recording.counts[t]]
        if periodic:
            return max((self.recording.counts[t] - 1) * self.contract.topics[t].period for t in periodic)
        return self.recording.last - self.recording.last % period


def prepare(path: Path, choice: str, scenario: Path | None = None) -> GoldenCase:
    """Open a recording and create the service `choice`: ROLE with the scenario's implementation, or ROLE=NAME_OR_FILE.

    The scenario is `scenario`, else the one in the recording, else the one in its folder. Raises RecordingError, PluginError or
    ScenarioError.
    """
    role, _, name = choice.partition("=")
    workers = [name for name, row in contract().served.items() if not row.observer]
    if role not in workers:
        raise PluginError(f"--service {choice}: there is no service {role!r}; allowed are {', '.join(workers)}")
    if name:
        implementations.kind(role).check(name)
    recording = open_recording(path)
    text = read_text(scenario) if scenario else recording.scenario or _scenario_near(path, role)
    topics = [topic.name for topic, _ in contract().inputs(role)] + [topic.name for topic in contract().outputs(role)]
    recording.check(contract(), topics)
    if recording.origin([name for name in topics if recording.counts.get(name)]):
        raise RecordingError(f"{path}: has Unix time, not that of a run: it can be played, but no service re-run on it")
    if not any(recording.counts.get(topic.name) for topic in contract().outputs(role)):
        raise RecordingError(f"{path}: has no message of {role} to compare with")
    loaded = load_text(text)
    service = implementations.create(role, name or getattr(loaded.services, role), loaded)
    return GoldenCase(recording, role, service, text, contract())


def load_text(text: str) -> Scenario:
    """Return the scenario of a YAML text. Raises ScenarioError."""
    with tempfile.TemporaryDirectory(prefix="palpate-replay-") as folder:
        file = Path(folder) / "recorded.yaml"
        file.write_text(text, encoding="utf-8")
        return load_scenario(str(file))


def _scenario_near(path: Path, role: str) -> str:
    """Return the text of the scenario file of a role in the run's folder. Raises RecordingError if there is none."""
    name = f"{view_of(role)}.yaml"
    for folder in (path, *path.resolve().parents[:2]):
        if (folder / name).is_file():
            return read_text(folder / name)
    raise RecordingError(f"{path}: no {name} in it or next to it; {role} needs the scenario of the run: --scenario FILE")


def replay_service(case: GoldenCase, tolerance: Tolerance, reached: MutableSequence[int] | None = None) -> dict[str, TopicResult]:
    """Run the service again and compare all its messages; the stamp of each [ns] is written into `reached`."""

    def sent() -> Iterator[RecordedMessage]:
        for message in rerun(case.service, case.contract, case.recording.messages(case.inputs), case.end):
            if reached is not None:
                reached[0] = message.stamp
            yield message

    expected = case.recording.messages(case.outputs, end=case.end)
    results = compare(expected, sent(), case.contract, tolerance, case.outputs)
    case.service.finish()
    return results


def make_reference(case: GoldenCase, path: Path, begin: int, end: int) -> None:
    """Write a reference: the inputs of the service from `begin` to `end` [ns] and its outputs."""
    period = case.contract.roles[case.role].period
    begin -= begin % max(period, 100 * MS)  # a tick of every role
    end = min(end, case.end)
    given = list(cut(case.recording, case.contract, case.inputs, begin, end))
    sent = rerun(case.service, case.contract, iter(given), (end - begin) // period * period)
    answers = (message._replace(payload=round_message(case.contract.topics[message.topic], message.payload)) for message in sent)
    attached = {SCENARIO: ("application/yaml", case.scenario.encode())}
    write_recording(path, case.contract, chain(given, answers), attached)


def write_reference(file: Path, service: str, scenario: Path | None, start: int, end: int | None, target: Path) -> None:
    """Write the reference of a service from a recording between `start` and `end` [ns]."""

    def write() -> None:
        case = prepare(file, service, scenario)
        make_reference(case, target, start, case.end if end is None else end)

    run_guarded(f"--service {service}", write, math.inf)
    SteadyConsole(stderr=True).print(f"{target}: {target.stat().st_size} bytes")


def run_again(file: Path, service: str, scenario: Path | None, tolerance: list[str], as_json: bool) -> None:
    """Run a service again on its recorded inputs and print the comparison. Raises typer.Exit(3) if the outputs differ."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s")
    role, allowed, reached = service.partition("=")[0], parse_tolerance(tolerance), shared_numbers()

    def perform() -> dict[str, TopicResult]:
        case = prepare(file, service, scenario)
        with TimeLeft(lambda: f"running {role} again", lambda: reached[0], 0, case.end):
            return replay_service(case, allowed, reached)

    results = run_guarded(f"--service {service}", perform, Settings.read().start_limit_s, place=lambda: (reached[0],))
    if as_json:
        print_json({name: as_dict(result) for name, result in results.items()})
    else:
        wide_console(140).print(result_table(results))
    if not all(result.agrees for result in results.values()):
        fail(f"the messages of {role} differ from {file}; if this is intended, renew it with --update-refs")
