"""The conductor as a service: it gathers what the report needs. The same in every runtime."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from palpate_bus.contract import MS, contract
from palpate_bus.messages import Clock, DiagnosticArray, codec
from palpate_bus.messages.stamps import NS, header, nanoseconds, time_message
from palpate_bus.service import Inbox, Outbox, Service
from palpate_conductor.tree import FrameTree

HEALTH_PERIOD = NS
"""Simulated time between two messages on `diagnostics`."""
TREE_PERIOD = 50 * MS
"""Simulated time between two messages on `tf`."""


class KeptMessages(Sequence[Any]):
    """All messages of a topic, as bytes: decoded, a state of the examination takes ten times as much memory."""

    def __init__(self, topic: str) -> None:
        kind = contract().topics[topic].type
        self._encode, self._decode = codec.encoder(kind), codec.decoder(kind)
        self._kept: list[bytes] = []
        self._newest: Any | None = None

    def extend(self, messages: Iterable[Any]) -> None:
        """Keeps further messages."""
        for message in messages:
            self._kept.append(self._encode(message))
            self._newest = message

    def __len__(self) -> int:
        return len(self._kept)

    def __iter__(self) -> Iterator[Any]:
        return map(self._decode, self._kept)

    def __getitem__(self, at: Any) -> Any:
        if at == -1 and self._kept:  # asked for at every tick
            return self._newest
        kept = self._kept[at]
        return self._decode(kept) if isinstance(kept, bytes) else [*map(self._decode, kept)]


@dataclass
class Collected:
    """Messages of a run, oldest first, or the newest where only that counts."""

    exam_states: Sequence[Any] = ()
    indentation: Sequence[Any] = ()
    motions: Sequence[Any] = ()
    """How perception saw the wall move."""
    exam_time: int = -1
    """Simulated time [ns] of the newest exam state, -1 before the first: by its number: no clock can spoil that."""
    samples: list[Any] = field(default_factory=list)
    status_changes: list[Any] = field(default_factory=list)
    supervisor: Any | None = None
    """Its newest state."""
    phantom: Any | None = None
    surface: Any | None = None
    correction: Any | None = None
    """Where the skin lay relative to the surface, as all of the examination tells."""
    targets: Any | None = None
    stiffness_map: Any | None = None
    findings: Any | None = None

    @property
    def exam(self) -> Any | None:
        """The newest exam state."""
        return self.exam_states[-1] if self.exam_states else None

    @property
    def end_tick(self) -> int | None:
        """The simulated time [ns] at which the run ends, None while planning has not decided it."""
        exam = self.exam
        return None if exam is None or exam.end_tick < 0 else int(exam.end_tick)


class Collector(Service):
    """Role conductor."""

    role = "conductor"

    def __init__(self, diagnose: Callable[[], Sequence[Any]] | None = None, tree: FrameTree | None = None) -> None:
        """`diagnose` gives the statuses for `diagnostics`; `tree` makes `tf` of the measured joints."""
        self._exam_states, self._indentation, self._motions = map(
            KeptMessages, ("exam/state", "truth/indentation", "perception/motion")
        )
        self.collected = Collected(self._exam_states, self._indentation, self._motions)
        self.diagnose = diagnose
        self._tree = tree
        self._felt = False
        """Whether there are samples of this run: those of a run that it goes on with are of before its start."""
        self._said = -HEALTH_PERIOD
        self._drawn = -TREE_PERIOD

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Takes everything new and publishes the clock."""
        c = self.collected
        self._exam_states.extend(inbox.new("exam/state"))
        seen = inbox.stamp("exam/state")
        c.exam_time = -1 if seen is None else seen
        self._indentation.extend(inbox.new("truth/indentation"))
        self._motions.extend(inbox.new("perception/motion"))
        samples = inbox.new("assessment/samples")
        c.samples.extend(samples)
        self._felt = self._felt or any(sample.header.stamp.sec >= 0 for sample in samples)
        for status in inbox.new("robot/status"):
            last = c.status_changes[-1] if c.status_changes else None
            if last is None or (last.mode, last.cause) != (status.mode, status.cause):
                c.status_changes.append(status)
        c.supervisor = inbox.latest("supervisor/state")
        c.phantom = inbox.latest("truth/phantom")
        if not self._felt:  # later looks are at a patient who has moved: what is felt is told where the first look saw it
            c.surface = inbox.latest("perception/surface")
            c.targets = inbox.latest("perception/targets")
        c.correction = inbox.latest("exam/correction")
        c.stiffness_map = inbox.latest("assessment/map")
        c.findings = inbox.latest("assessment/findings")
        out: dict[str, Any] = {"clock": Clock(time_message(t))}
        if self.diagnose is not None and t - self._said >= HEALTH_PERIOD:
            self._said = t
            out["diagnostics"] = DiagnosticArray(header(t), list(self.diagnose()))
        status = inbox.latest("robot/status")
        if self._tree is not None and status is not None and t - self._drawn >= TREE_PERIOD:
            self._drawn = t
            out["tf"] = self._tree.message(nanoseconds(status.header.stamp), status.position)
        return out

    def finish(self) -> Mapping[str, Any]:
        """Nothing to close."""
        return {"exam_states": len(self.collected.exam_states), "samples": len(self.collected.samples)}
