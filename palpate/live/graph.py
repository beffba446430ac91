"""Topics and nodes of a live bus, from its liveliness tokens."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from time import monotonic

from palpate.live.connection import Joined
from palpate_bus.contract import Contract
from palpate_bus.runs.announcement import Run
from palpate_bus.wire.liveliness import Entity, EntityKind, GraphWatch


@dataclass
class LiveTopic:
    """A topic as it is on the bus."""

    name: str
    types: set[tuple[str, str]] = field(default_factory=set)
    """(type, hash) by which it is sent or wanted; more than one is a mismatch."""
    publishers: list[str] = field(default_factory=list)
    subscribers: list[str] = field(default_factory=list)
    qos: set[str] = field(default_factory=set)


@dataclass
class LiveNode:
    """A node as it is on the bus."""

    name: str
    zids: set[str] = field(default_factory=set)
    publishes: list[str] = field(default_factory=list)
    subscribes: list[str] = field(default_factory=list)
    services: list[str] = field(default_factory=list)


QUIET_S = 0.3
"""Everyone's tokens come in one burst; after this long without a new one they are taken to be all."""
PATIENCE_S = 3.0


def present(bus: Joined) -> list[Entity]:
    """Who is there, sorted by token: waits for the roles that the run is known to have, and until nothing new comes."""
    expected = set(bus.target.run.endpoints) if bus.target.run is not None else set()
    watch = GraphWatch(bus.session, bus.domain)
    try:
        end = monotonic() + PATIENCE_S
        quiet = monotonic()
        while monotonic() < end:
            if watch.changes(timeout=0.05):
                quiet = monotonic()
            if monotonic() - quiet > QUIET_S and watch.alive and expected <= watch.roles():
                break
        return [watch.alive[token] for token in sorted(watch.alive)]
    finally:
        watch.close()


def topics(found: Iterable[Entity]) -> dict[str, LiveTopic]:
    """Topics by name, sorted."""
    by_name: dict[str, LiveTopic] = {}
    for entity in found:
        end = entity.endpoint
        if end is None or entity.kind not in (EntityKind.PUBLISHER, EntityKind.SUBSCRIPTION):
            continue
        topic = by_name.setdefault(end.topic, LiveTopic(end.topic))
        topic.types.add((end.type, end.type_hash))
        if entity.kind is EntityKind.PUBLISHER:
            topic.publishers.append(entity.node)
            topic.qos.add(end.qos)
        else:
            topic.subscribers.append(entity.node)
    return dict(sorted(by_name.items()))


def nodes(found: Iterable[Entity]) -> dict[str, LiveNode]:
    """Nodes by name, sorted."""
    by_name: dict[str, LiveNode] = {}
    for entity in found:
        node = by_name.setdefault(entity.node, LiveNode(entity.node))
        node.zids.add(entity.zid)
        end = entity.endpoint
        if end is None:
            continue
        kept = {EntityKind.PUBLISHER: node.publishes, EntityKind.SUBSCRIPTION: node.subscribes}.get(entity.kind, node.services)
        kept.append(end.topic)
    return dict(sorted(by_name.items()))


def processes(found: Iterable[Entity]) -> list[tuple[str, ...]]:
    """The nodes of each process, sorted: those with a session in common. On a secure bus each node has its own session."""
    by_session: dict[str, set[str]] = {}
    for entity in found:
        by_session.setdefault(entity.zid, set()).add(entity.node)
    return sorted(tuple(sorted(names)) for names in by_session.values())


def missing(rules: Contract, found: Iterable[Entity], run: Run | None) -> list[str]:
    """Roles that are not on the bus, the critical ones first.

    They are those that `run` has, or where it is not known, those that every run has; and all observers.
    """
    there = {entity.node for entity in found}
    absent = [
        role
        for role in rules.roles.values()
        if role.name not in there and (role.observer or (role.name in run.endpoints if run is not None else not role.optional))
    ]
    return [role.name for role in sorted(absent, key=lambda role: (role.observer, not role.critical))]
