"""The conductor's service: collects what the report needs; publishes clock, diagnostics and frames. The same in every runtime."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from palpate_bus.contract import CONDUCTOR, contract
from palpate_bus.messages import (
    Clock,
    DiagnosticArray,
    ExamState,
    OperatorRequest,
    Quaternion,
    TFMessage,
    Transform,
    TransformStamped,
    codec,
)
from palpate_bus.messages.geometry import transform_message
from palpate_bus.messages.stamps import MS, NS, header, nanoseconds, time_message
from palpate_bus.service import Inbox, Outbox, Service
from palpate_models.robot.arm import arm_of, link_transforms
from palpate_models.scenario.schema import ExamInput

_FIRST_JOINT = 1
"""Index of the first joint's frame, after the base. All other frames are constant."""


class FrameTree:
    """Makes `tf` messages from measured joints: world, the arm's links, ft_sensor, indenter; and world, abdomen."""

    def __init__(self, exam: ExamInput) -> None:
        self._axes = arm_of(exam.robot).axis
        frames = [*link_transforms(np.zeros(len(self._axes)), exam.robot), ("world", "abdomen", np.array(exam.X_WA))]
        self._names = [(parent, child) for parent, child, _ in frames]
        self._transforms = [transform_message(X) for _, _, X in frames]

    def message(self, t: int, q: Iterable[float]) -> TFMessage:
        """Return the tree at joint positions `q` [rad], shape (n,), stamped `t` [ns]."""
        half = 0.5 * np.array(q, np.float64)[:, None]
        rotations = np.hstack((np.sin(half) * self._axes, np.cos(half)))  # unit quaternions (x, y, z, w), shape (n, 4)
        transforms = self._transforms.copy()
        for i, rotation in enumerate(rotations.tolist(), _FIRST_JOINT):
            transforms[i] = Transform(transforms[i].translation, Quaternion(*rotation))
        named = zip(self._names, transforms, strict=True)
        return TFMessage([TransformStamped(header(t, parent), child, transform) for (parent, child), transform in named])


DIAGNOSTICS_PERIOD_NS = NS
END_AFTER_NS = NS
"""An examination that is over ends the run after this time, whether or not planning announces it."""
SIM_LIMIT = 3600 * NS
"""Simulated time [ns] after which a run is ended in any case."""
EXAM_LIMIT = SIM_LIMIT - 120 * NS
"""Simulated time [ns] at which planning is asked to end the examination: the arm lifts and goes home before `SIM_LIMIT`."""
_OVER = frozenset({ExamState.PHASE_DONE, ExamState.PHASE_ABORTED})
_AFTER_CONTACT = frozenset({*_OVER, ExamState.PHASE_RETURN, ExamState.PHASE_ASSESS})
TF_PERIOD_NS = 50 * MS


class KeptMessages(Sequence[Any]):
    """All messages of a topic, kept as bytes: a decoded exam state takes ten times as much memory."""

    def __init__(self, topic: str) -> None:
        kind = contract().topics[topic].type
        self._encode, self._decode = codec.encoder(kind), codec.decoder(kind)
        self._kept: list[bytes] = []
        self._newest: Any | None = None

    def extend(self, messages: Iterable[Any]) -> None:
        """Append messages."""
        for self._newest in messages:
            self._kept.append(self._encode(self._newest))

    def messages_from(self, first: int) -> list[bytes]:
        """Return the messages from the one with index `first` on, as bytes."""
        return self._kept[first:]

    def keep(self, messages: Sequence[bytes]) -> None:
        """Append messages that are bytes already."""
        self._kept += messages
        self._newest = self._decode(messages[-1]) if messages else self._newest

    def __len__(self) -> int:
        return len(self._kept)

    def __iter__(self) -> Iterator[Any]:
        return map(self._decode, self._kept)

    def __getitem__(self, at: Any) -> Any:
        if at == -1 and self._kept:  # read at every tick
            return self._newest
        kept = self._kept[at]
        return self._decode(kept) if isinstance(kept, bytes) else [*map(self._decode, kept)]


@dataclass
class Collected:
    """Messages of a run: all, oldest first, or the newest only."""

    exam_states: Sequence[Any] = ()
    indentation: Sequence[Any] = ()
    motions: Sequence[Any] = ()
    """`perception/motion`"""
    exam_time: int = -1
    """Simulated time [ns] of the newest exam state, from its sequence number; -1 before the first."""
    samples: list[Any] = field(default_factory=list)
    status_changes: list[Any] = field(default_factory=list)
    supervisor: Any | None = None
    phantom: Any | None = None
    surface: Any | None = None
    correction: Any | None = None
    """Final correction of the perceived surface, from all touches and images."""
    targets: Any | None = None
    stiffness_map: Any | None = None
    findings: Any | None = None
    end_tick: int | None = None
    """Simulated time [ns] at which the run ends; None until an exam state announces it, or says that the examination is over."""

    @property
    def exam(self) -> Any | None:
        """Newest exam state."""
        return self.exam_states[-1] if self.exam_states else None

    @property
    def targets_reached(self) -> int:
        """Number of targets up to the last one that was measured."""
        return max((int(state.target_index) + 1 for state in self.exam_states if state.steady), default=0)


class CollectedNews:
    """Data collected by a process since its last report to another one, which adds them to its copy."""

    def __init__(self, collected: Collected) -> None:
        self._collected = collected
        self._counts: dict[str, int] = {}
        self._newest: dict[str, Any] = {}

    def take(self) -> dict[str, Any]:
        """Return by field of `Collected` the further messages, or the newest one."""
        news: dict[str, Any] = {}
        for field_ in fields(Collected):
            name, value = field_.name, getattr(self._collected, field_.name)
            if isinstance(value, KeptMessages | list):
                first, self._counts[name] = self._counts.get(name, 0), len(value)
                further = value.messages_from(first) if isinstance(value, KeptMessages) else value[first:]
                news |= {name: further} if further else {}
            elif value is not self._newest.get(name):
                news[name] = self._newest[name] = value
        return news


def collect(collected: Collected, news: Mapping[str, Any]) -> None:
    """Add what `CollectedNews.take` of another process returned."""
    for name, value in news.items():
        mine = getattr(collected, name)
        if isinstance(mine, KeptMessages):
            mine.keep(value)
        elif isinstance(mine, list):
            mine += value
        else:
            setattr(collected, name, value)


class Collector(Service):
    """Role conductor."""

    role = CONDUCTOR

    def __init__(self, tree: FrameTree | None = None) -> None:
        """Without `tree` no `tf` is published."""
        self._exam_states, self._indentation, self._motions = map(
            KeptMessages, ("exam/state", "truth/indentation", "perception/motion")
        )
        self.collected = Collected(self._exam_states, self._indentation, self._motions)
        self.diagnose: Callable[[], Sequence[Any]] | None = None
        """Returns the statuses for `diagnostics`."""
        self._tree = tree
        self._sampled = False
        """True once there are samples of this run; those of a resumed one have negative stamps."""
        self._diagnostics_at = -DIAGNOSTICS_PERIOD_NS
        self._tf_at = -TF_PERIOD_NS

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Collect new messages; publish the clock, diagnostics and frames at their periods; end an examination at its limit."""
        c = self.collected
        states = inbox.new("exam/state")
        self._exam_states.extend(states)
        for state in states:
            if c.end_tick is None and (state.end_tick >= 0 or state.phase in _OVER):
                c.end_tick = int(state.end_tick) if state.end_tick >= 0 else nanoseconds(state.header.stamp) + END_AFTER_NS
        before, seen = c.exam_time, inbox.stamp("exam/state")
        c.exam_time = -1 if seen is None else seen
        self._indentation.extend(inbox.new("truth/indentation"))
        self._motions.extend(inbox.new("perception/motion"))
        samples = inbox.new("assessment/samples")
        c.samples.extend(samples)
        self._sampled = self._sampled or any(sample.header.stamp.sec >= 0 for sample in samples)
        for status in inbox.new("robot/status"):
            last = c.status_changes[-1] if c.status_changes else None
            if last is None or (last.mode, last.cause) != (status.mode, status.cause):
                c.status_changes.append(status)
        c.supervisor, c.phantom = inbox.latest("supervisor/state"), inbox.latest("truth/phantom")
        if not self._sampled:  # the frame of the samples is the first scan; later scans are of a patient who has moved
            c.surface, c.targets = inbox.latest("perception/surface"), inbox.latest("perception/targets")
        c.correction = inbox.latest("exam/correction")
        c.stiffness_map, c.findings = inbox.latest("assessment/map"), inbox.latest("assessment/findings")
        out: dict[str, Any] = {"clock": Clock(time_message(t))}
        if before < EXAM_LIMIT <= c.exam_time and c.exam_states[-1].phase not in _AFTER_CONTACT:
            out["operator/request"] = OperatorRequest(header(t), OperatorRequest.END, f"limit of {EXAM_LIMIT / NS:g} s reached")
        if self.diagnose is not None and t - self._diagnostics_at >= DIAGNOSTICS_PERIOD_NS:
            self._diagnostics_at = t
            out["diagnostics"] = DiagnosticArray(header(t), list(self.diagnose()))
        status = inbox.latest("robot/status")
        if self._tree is not None and status is not None and len(status.position) and t - self._tf_at >= TF_PERIOD_NS:
            self._tf_at = t
            out["tf"] = self._tree.message(nanoseconds(status.header.stamp), status.position)
        return out

    def finish(self) -> Mapping[str, Any]:
        """Return the numbers of exam states and samples."""
        return {"exam_states": len(self.collected.exam_states), "samples": len(self.collected.samples)}
