"""Rigs that a conformance suite drives: one implementation of a role, with the suite in place of all other roles.

`ServiceRig` runs a service in this process, in simulated time. `LiveRig` in `perform` connects to an unknown implementation on
a bus, in wall-clock mode. The same suites run on both.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, MutableSequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np

from palpate_bus.contract import contract
from palpate_bus.contract.port_check import Checker, RefusedMessage
from palpate_bus.messages import MS, Message, RobotStatus, Vector3, Wrench, codec, header
from palpate_bus.runtime.lockstep import Outgoing, Packet, Stepper
from palpate_bus.service import Service
from palpate_models.scenario.schema import Scenario

Source = Callable[[int], "Message | None"]
"""The message of a topic at a time [ns] on the rig's clock; None for silence."""
Feed = Mapping[str, Source]
"""Messages that the suite sends, by topic; other topics are silent."""


def sense(values: Any, t: int) -> Any:
    """Return the values as a live sensor reads them at `t` [ns]: ports refuse what repeats."""
    return np.asarray(values, dtype=float) + 1e-15 * t


def robot_status(
    t: int, q: Any, qd: Any, force: Any, torque: Any, mode: int = RobotStatus.MODE_ACTIVE, cause: int = 0, reason: str = ""
) -> Message:
    """Return the status of an arm at `t` [ns] as a live one sends it: joints, force on the F/T sensor, joint torques."""
    wrench = Wrench(Vector3(*sense(force, t).tolist()), Vector3(*sense(np.zeros(3), t).tolist()))
    q, qd, torque = sense(q, t), sense(qd, t), sense(torque, t)
    return RobotStatus(header(t), mode, cause, reason, q, qd, wrench, np.zeros_like(q), 0, "", torque)


class Verdict(StrEnum):
    """Verdict of one check."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"


class Result(NamedTuple):
    """One check."""

    group: str
    name: str
    verdict: Verdict
    expected: str = ""
    got: str = ""
    """The value received, or the reason for a skip."""


@dataclass
class ConformanceReport:
    """All checks of one implementation."""

    role: str
    results: list[Result] = field(default_factory=list)
    group: str = ""

    @property
    def failed(self) -> list[Result]:
        """Failed checks."""
        return [result for result in self.results if result.verdict is Verdict.FAILED]

    @property
    def passed(self) -> bool:
        """True if at least one check passed and none failed."""
        return not self.failed and any(result.verdict is Verdict.PASSED for result in self.results)

    def as_json(self) -> dict[str, Any]:
        """Return the report as JSON data."""
        return {"role": self.role, "passed": self.passed, "results": [result._asdict() for result in self.results]}


class ReceivedMessage(NamedTuple):
    """A message of the implementation."""

    t: int
    """Time of receipt [ns], on the rig's clock."""
    message: Any
    sequence: int
    sent: int
    """Source time [ns]: of the wall clock on a live bus, else `t`."""


class RigSettings(NamedTuple):
    """Settings of a check."""

    scenario: Scenario
    slack_ms: float = 150.0
    """Allowance for transport and scheduling of a live implementation."""
    motion: bool = True
    """True if the implementation may move; on a real arm this needs its operator's consent."""


class Rig(ABC):
    """One implementation of a role under test."""

    live = False
    """True for a separate process in real time."""

    def __init__(self, role: str, settings: RigSettings) -> None:
        self.contract = contract()
        self.role = self.contract.roles[role]
        self.settings = settings
        self.log: dict[str, list[ReceivedMessage]] = {topic.name: [] for topic in self.contract.outputs(role)}
        """All messages of the implementation, by topic."""
        self.undecodable: list[str] = []
        """Descriptions of payloads that could not be decoded."""
        self.t = 0
        """Now [ns]."""
        self.memory: dict[str, int] = {}
        """State that a suite keeps between checks."""
        self.report = ConformanceReport(role)

    @property
    def slack(self) -> int:
        """Allowance for transport and scheduling [ns]; 0 in simulated time."""
        return round(self.settings.slack_ms * MS) if self.live else 0

    @property
    def slack_s(self) -> float:
        """Allowance for transport and scheduling [s]; 0 in simulated time."""
        return self.slack / 1e9

    # -- checks

    def section(self, name: str) -> None:
        """Begin a group of checks."""
        self.report.group = name

    def expect(self, name: str, ok: bool, expected: object, got: object = None) -> bool:
        """Record a check; returns True if it passed. `got`: the value received, by default that it is as expected or not."""
        got = ("as expected" if ok else "not as expected") if got is None else got
        verdict = Verdict.PASSED if ok else Verdict.FAILED
        self.report.results.append(Result(self.report.group, name, verdict, str(expected), str(got)))
        return ok

    def equal(self, name: str, got: object, wanted: object) -> bool:
        """Record that a value is the wanted one."""
        return self.expect(name, got == wanted, wanted, got)

    def below(self, name: str, value: Any, limit: float, unit: str, scale: float = 1.0) -> bool:
        """Record that a value is below a limit; the report has both times `scale`, in `unit`."""
        return self.expect(name, bool(value < limit), f"below {scale * limit:.3g} {unit}", f"{scale * value:.3g} {unit}")

    def within(self, name: str, values: Any, low: float, high: float, unit: str) -> bool:
        """Record that all `values` are from `low` to `high`, and that there are any."""
        v = np.atleast_1d(np.asarray(values, dtype=float))
        got = f"{v.min():.3g} to {v.max():.3g} {unit}" if v.size else "nothing"
        return self.expect(name, bool(v.size and np.all((v >= low) & (v <= high))), f"{low:.3g} to {high:.3g} {unit}", got)

    def arrives(self, name: str, received: object, wanted: object) -> bool:
        """Record that something was received."""
        there = bool(received) if isinstance(received, list) else received is not None
        return self.expect(name, there, wanted, "as expected" if there else "nothing")

    def skip(self, name: str, reason: str) -> None:
        """Record a check that was not made."""
        self.report.results.append(Result(self.report.group, name, Verdict.SKIPPED, "", reason))

    # -- messages

    def await_message(self, topic: str, seconds: float, feed: Feed) -> list[ReceivedMessage]:
        """Send `feed` until there is a message on `topic`, at most for `seconds`; return all on that topic."""
        end = self.t + round(seconds * 1e9)
        while not self.log[topic] and self.t < end:
            self.run(0.5, feed)
        return self.log[topic]

    def run(self, seconds: float, feed: Feed) -> dict[str, list[ReceivedMessage]]:
        """Advance by `seconds` while `feed` is sent; return the messages received in this time, by topic."""
        before = {name: len(received) for name, received in self.log.items()}
        self._advance(self.t + round(seconds * 1e9), feed)
        return {name: received[before[name] :] for name, received in self.log.items()}

    def last(self, topic: str) -> Any:
        """Return the newest message of a topic, None before the first."""
        received = self.log[topic]
        return received[-1].message if received else None

    @abstractmethod
    def _advance(self, end: int, feed: Feed) -> None:
        """Advance to `end` [ns]."""

    @abstractmethod
    def send(self, topic: str, message: Message) -> None:
        """Send one message now."""

    @abstractmethod
    def lose(self, role: str) -> None:
        """Report a role as lost."""


class ServiceRig(Rig):
    """A service in this process, in simulated time."""

    def __init__(self, service: Service, settings: RigSettings, steps: MutableSequence[int] | None = None) -> None:
        """The first number of `steps` is that of its steps."""
        super().__init__(service.role, settings)
        self._steps: MutableSequence[int] = [0] if steps is None else steps
        self._stepper = Stepper(service, self.contract, strict=False, refuse=self._log_refused)
        self._sequences = dict.fromkeys(self._stepper.buffers, 0)
        self._checks = {name: Checker(self.contract.topics[name]) for name in self._stepper.buffers}
        self._take(self._stepper.start())

    def _advance(self, end: int, feed: Feed) -> None:
        due = [(name, self.contract.topics[name].period, source) for name, source in feed.items()]
        while self.t < end:
            for name, period, source in due:
                if not self.t % period and (message := source(self.t)) is not None:
                    self.send(name, message)
            if not self.t % self.role.period:
                self._steps[0] += 1
                self._take(self._stepper.step(self.t))
            self.t += MS

    def send(self, topic: str, message: Message) -> None:
        """Deliver a message as bytes, like the wire. A port refuses one that breaks its row of the contract."""
        if self._checks[topic](message):
            return
        self._sequences[topic] += 1
        payload = codec.encode(message, self.contract.topics[topic].type)
        self._stepper.buffers[topic].deliver(Packet(payload, self.t, self._sequences[topic], checked=True))

    def lose(self, role: str) -> None:
        """Mark a role lost."""
        self._stepper.inbox.lost_roles.add(role)

    def _log_refused(self, refused: RefusedMessage) -> None:
        """Log a message that breaks the contract as sent: the suite names what is wrong with it."""
        log = self.log[refused.topic]
        log.append(ReceivedMessage(self.t, refused.message, len(log) + 1, self.t))

    def _take(self, sent: list[Outgoing]) -> None:
        for port, packet in sent:
            message = codec.decode(packet.payload, port.topic.type)
            self.log[port.topic.name].append(ReceivedMessage(self.t, message, packet.sequence, self.t))
