"""The contract: every role and topic of the bus as typed, validated rows, read from `contract.yaml`.

The runtime connects services by `Contract.inputs(role)` and `Contract.outputs(role)`.
"""

from collections.abc import Collection, Mapping
from enum import StrEnum
from functools import cache
from importlib import resources
from typing import Annotated, Any, Final

import yaml
from pydantic import BaseModel, ConfigDict, Field, model_validator

from palpate_bus.messages import MS, codec
from palpate_bus.settings import Settings

CONDUCTOR: Final = "conductor"
"""The role that every run needs: it starts and ends the services and makes the result."""
_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""PyYAML's parser in C where it was built: every process of a run reads the contract at its start."""


class Edge(StrEnum):
    """Dependence of a reader on a topic's producer; see the head of contract.yaml."""

    SAME_TICK = "same_tick"
    PREVIOUS = "previous"
    LATCHED = "latched"
    OBSERVE = "observe"

    @property
    def blocking(self) -> bool:
        """True if the reader waits for the producer's tick in lockstep."""
        return self in (Edge.SAME_TICK, Edge.PREVIOUS)


class Visibility(StrEnum):
    """Roles that may read a topic; see the head of contract.yaml."""

    PUBLIC = "public"
    SIM = "sim"
    TRUTH = "truth"


class _Row(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    def _ns(self, field: str) -> int:
        """Return a time of the row [ns]."""
        if (value := getattr(self, field)) is None:
            raise ValueError(f"contract.yaml: {getattr(self, 'name', '')} has no {field}")
        return int(value * MS)


class Role(_Row):
    """A role, implemented by a service. Its period is in whole milliseconds of simulated time."""

    name: str
    period_ms: Annotated[int, Field(ge=1)]
    critical: bool = False
    observer: bool = False
    optional: bool = False
    """Absent from runs that do not use it."""
    doc: str

    @property
    def period(self) -> int:
        """Period [ns]."""
        return self.period_ms * MS


class Qos(_Row):
    """A class of delivery, in zenoh's terms, with its reason."""

    name: str
    priority: str
    congestion: str
    express: bool
    reliability: str
    depth: int
    transient_local: bool = False
    reason: str


class Topic(_Row):
    """A row of the contract."""

    name: str
    type: str
    producer: str
    period_ms: Annotated[int, Field(ge=1)] = 1
    event: bool = False
    latched: bool = False
    readers: dict[str, Edge]
    qos: str
    hashed: bool = False
    visibility: Visibility = Visibility.PUBLIC
    frame: str | None = None
    units: dict[str, str] = {}
    ranges: dict[str, tuple[float, float]] = {}
    rates: dict[str, float] = {}
    """Maximum change per second of each number; for a quaternion, maximum rate of turning [rad/s]."""
    varies: dict[str, int] = {}
    """Number of messages in a row whose field may repeat exactly."""
    compared_while: dict[str, int | str] = {}
    """Values of other fields that two messages in a row have if `rates` and `varies` compare them."""
    max_age_ms: int | None = None
    expiry_ms: int | None = None
    record_ms: int = 0
    """Interval in which the recorder keeps one message with --record normal; 0: it keeps every message."""
    open: bool = False
    """Senders other than the producer are allowed."""
    tagged: bool = False
    """Its messages carry an authentication tag in runs with a key."""
    tagged_values: dict[str, tuple[int, ...]] = {}
    """Field values of an open topic that are accepted with a tag only; other messages are accepted from anyone."""
    doc: str

    @property
    def period(self) -> int:
        """Period [ns]."""
        return self.period_ms * MS

    @property
    def max_age(self) -> int:
        """Age [ns] from which the newest message is stale. Raises ValueError if the contract gives none."""
        return self._ns("max_age_ms")

    @property
    def expiry(self) -> int:
        """Time [ns] after its stamp at which a message expires. Raises ValueError if the contract gives none."""
        return self._ns("expiry_ms")

    @property
    def periodic(self) -> bool:
        """True if the topic carries exactly one message on each of its ticks, so that it needs no Advance messages."""
        return not (self.event or self.latched)

    @property
    def type_hash(self) -> str:
        """RIHS01 hash of the message type."""
        return codec.type_hash(self.type)

    @property
    def sent(self) -> str:
        """When it is sent, as text."""
        return "once, latched" if self.latched else f"{'at most every ' if self.event else ''}{self.period_ms} ms"

    def facts(self) -> list[tuple[str, str]]:
        """Return the row as pairs of a name and a text: the topic, then its fields with unit and range."""
        facts = [("type", self.type), ("hash", self.type_hash), ("sent by", self.producer), ("sent", self.sent)]
        facts += [("read by", ", ".join(f"{role} ({edge})" for role, edge in self.readers.items())), ("QoS", self.qos)]
        facts += [("may be known to", str(self.visibility)), ("in the run hash", "yes" if self.hashed else "no")]
        facts += [("frame", self.frame)] if self.frame else []
        facts += [("may be sent by", "anyone, including a ROS 2 node")] if self.open else []
        facts += [("tagged", "in runs with a key")] if self.tagged else []
        facts += [("--record normal keeps", f"one message in {self.record_ms} ms")] if self.record_ms else []
        facts += [("stale after", f"{self.max_age_ms} ms")] if self.max_age_ms else []
        facts += [("expires after", f"{self.expiry_ms} ms: the receiver then enters its safe state")] if self.expiry_ms else []
        for path in dict.fromkeys([*self.units, *self.ranges]):
            low, high = self.ranges.get(path, (None, None))
            facts.append((path, f"[{self.units.get(path, '1')}]" + ("" if low is None else f" {low:g} .. {high:g}")))
        return facts


class Internal(_Row):
    """A message of the runtime."""

    name: str
    type: str
    producer: str
    readers: str
    period_ms: int | None = None
    deadline_ms: int | None = None
    """Maximum time without a message in wall-clock mode; then the sender is lost."""
    tagged: bool = False
    """Its messages carry an authentication tag in runs with a key."""
    doc: str

    @property
    def period(self) -> int:
        """Time between messages [ns]. Raises ValueError if the contract gives none."""
        return self._ns("period_ms")

    @property
    def deadline(self) -> int:
        """Time [ns] without a message after which its sender is lost. Raises ValueError if the contract gives none."""
        return self._ns("deadline_ms")


_MAY_KNOW = {
    Visibility.SIM: {"robot", "tissue", "camera", "dashboard", "recorder"},
    Visibility.TRUTH: {CONDUCTOR, "dashboard", "recorder"},
}


class Contract(_Row):
    """All rows. Validates roles, periods, visibility, and that same_tick edges have no cycle."""

    roles: dict[str, Role]
    qos: dict[str, Qos]
    topics: dict[str, Topic]
    internal: dict[str, Internal]

    @model_validator(mode="after")
    def _check(self) -> "Contract":
        for topic in self.topics.values():
            codec.message_type(topic.type)
            for role in (topic.producer, *topic.readers):
                if role not in self.roles:
                    raise ValueError(f"topic {topic.name}: no role {role!r}; roles are {sorted(self.roles)}")
            if topic.qos not in self.qos:
                raise ValueError(f"topic {topic.name}: no QoS class {topic.qos!r}; classes are {sorted(self.qos)}")
            if not topic.latched and topic.period_ms % (own_ms := self.roles[topic.producer].period_ms):
                reason = f"not a multiple of the period of {topic.producer}, {own_ms} ms"
                raise ValueError(f"topic {topic.name}: period {topic.period_ms} ms is {reason}")
            if wrong := topic.readers.keys() - _MAY_KNOW.get(topic.visibility, topic.readers.keys()):
                raise ValueError(f"topic {topic.name} is {topic.visibility} and must not be read by {sorted(wrong)}")
        self.step_order(tuple(self.roles))
        return self

    @property
    def served(self) -> dict[str, Role]:
        """All roles but the conductor, by name."""
        return {name: role for name, role in self.roles.items() if name != CONDUCTOR}

    def outputs(self, role: str) -> tuple[Topic, ...]:
        """Return the topics that a role produces, in contract order."""
        return tuple(topic for topic in self.topics.values() if topic.producer == role)

    def inputs(self, role: str) -> tuple[tuple[Topic, Edge], ...]:
        """Return the topics that a role reads, with the kind of edge, in contract order."""
        return tuple((topic, topic.readers[role]) for topic in self.topics.values() if role in topic.readers)

    def tagged(self, name: str) -> bool:
        """Return True if messages of this topic, or of this name of the runtime, carry a tag in runs with a key."""
        row = self.topics.get(name) or self.internal.get(name) or self.internal.get(f"{name.rpartition('/')[0]}/<role>")
        return row is not None and row.tagged

    def step_order(self, roles: tuple[str, ...]) -> tuple[str, ...]:
        """Return the roles ordered so that each steps after the producers of its same_tick inputs.

        Raises ValueError that names the members of a cycle.
        """
        needs = {role: {t.producer for t, edge in self.inputs(role) if edge is Edge.SAME_TICK} for role in roles}
        order: list[str] = []
        while left := [role for role in roles if role not in order]:
            ready = [role for role in left if needs[role].isdisjoint(left)]
            if not ready:
                raise ValueError(f"cycle of same_tick edges among {sorted(left)}")
            order += ready
        return tuple(order)


def parse(text: str, periods: Mapping[str, int] | None = None, absent: Collection[str] = ()) -> Contract:
    """Return the contract in a YAML text, with other `periods` of roles [ms] and without `absent` optional roles.

    Periods of a role's topics are rounded up to multiples of its new period. Raises ValueError for a role that is unknown or not
    optional, and (pydantic's ValidationError) one that names the row and field.
    """
    raw = yaml.load(text, _LOADER)
    roles = raw["roles"]
    for role, period_ms in (periods or {}).items():
        if role not in roles:
            raise ValueError(f"PALPATE_PERIODS: unknown role {role!r}; roles are {', '.join(roles)}")
        roles[role]["period_ms"] = period_ms
        for topic in raw["topics"].values():
            if topic["producer"] == role and "period_ms" in topic:
                topic["period_ms"] = -(-topic["period_ms"] // period_ms) * period_ms
    for role in absent:
        if not roles.get(role, {}).get("optional"):
            optional = [name for name, row in roles.items() if row.get("optional")]
            raise ValueError(f"PALPATE_ABSENT: {role!r} is not an optional role; these are {', '.join(optional)}")
        del roles[role]
        raw["topics"] = {name: topic for name, topic in raw["topics"].items() if topic["producer"] != role}
        for topic in raw["topics"].values():
            topic["readers"].pop(role, None)
    for section in ("roles", "qos", "topics", "internal"):
        raw[section] = {name: {"name": name, **row} for name, row in raw[section].items()}
    return Contract.model_validate(raw)


@cache
def contract() -> Contract:
    """Return the contract of this installation, with the changes of PALPATE_PERIODS and PALPATE_ABSENT."""
    text = resources.files("palpate_bus.contract").joinpath("contract.yaml").read_text(encoding="utf-8")
    settings = Settings.read()
    return parse(text, settings.periods, settings.absent)
