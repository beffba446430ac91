"""Golden replay: a recording, a service, and whether it still sends what was recorded."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from palpate.replay.compare import Tolerance, TopicResult, compare
from palpate.replay.reference import cut, rounded, write_reference
from palpate.replay.rerun import rerun
from palpate_bus import implementations
from palpate_bus.contract import MS, Contract, contract
from palpate_bus.implementations import ChoiceError
from palpate_bus.recordings import RecordedMessage, Recording, RecordingError, open_recording
from palpate_bus.service import Service
from palpate_models.scenario.load import load_scenario, view_of
from palpate_models.scenario.schema import Scenario


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

    The scenario is `scenario`, else the recording's own, else the one beside it. Raises RecordingError, ChoiceError or
    ScenarioError.
    """
    rules = contract()
    role, _, name = choice.partition("=")
    workers = [row.name for row in rules.roles.values() if not row.observer and row.name != "conductor"]
    if role not in workers:
        raise ChoiceError(f"--service {choice}: no service {role!r}; services are {', '.join(workers)}")
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
    write_reference(path, case.rules, chain(given, _rounded(answered, case.rules)), case.scenario)


def _rounded(messages: Iterator[RecordedMessage], rules: Contract) -> Iterator[RecordedMessage]:
    for message in messages:
        yield message._replace(payload=rounded(rules.topics[message.topic], message.payload))
