"""What `palpate topic` does with the topics on a live bus."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from math import inf
from time import monotonic
from typing import Any, NamedTuple

import yaml
from rich.console import Console

from palpate.live import graph
from palpate.live.connection import command, joined
from palpate.live.console import bandwidth, console, print_json, print_line, table
from palpate.live.listening import Heard, Listener, plain
from palpate.live.options import ChosenBus
from palpate.live.statistics import Spacing
from palpate_bus.contract import Topic, contract
from palpate_bus.messages import codec
from palpate_bus.runs.joining import NoBus

EVERY_S = 1.0
BANDWIDTH_OVER = 5
"""Bandwidth is the mean over so many seconds."""


def list_topics(chosen: ChosenBus, as_json: bool) -> None:
    """Prints the topics on the bus: type, who publishes, who subscribes, and whether the contract has it."""
    with command(), joined(chosen) as bus:
        found = graph.topics(graph.present(bus))
        rules = contract().topics
        if as_json:
            print_json([_topic_facts(topic) for topic in found.values()])
            return
        out = table("topic", "type", "published by", "subscribed by", "in the contract")
        for topic in found.values():
            row = rules.get(topic.name)
            known = "[yellow]no[/]" if row is None else _period(row)
            if row is not None and {(row.type, row.type_hash)} != topic.types:
                known = "[bold red]other type or hash[/]"
            types = ", ".join(sorted(name.replace("/msg/", "/") for name, _ in topic.types))
            who = ", ".join(sorted(topic.publishers)) or "[yellow]none[/]"
            out.add_row(topic.name, types, who, ", ".join(sorted(topic.subscribers)), known)
        console().print(out)


def show_topic(name: str, chosen: ChosenBus, as_json: bool) -> None:
    """Prints a topic's row of the contract, and who publishes and subscribes on the bus with which type hash."""
    with command(), joined(chosen) as bus:
        name = name.strip("/")
        found = [e for e in graph.present(bus) if e.endpoint is not None and e.endpoint.topic == name]
        row = contract().topics.get(name)
        if not found and row is None:
            raise NoBus(f"no topic {name!r} on the bus or in the contract; palpate topic list shows those that are")
        if as_json:
            ends = [
                {
                    "node": e.node,
                    "kind": e.kind.name.lower(),
                    "type": e.endpoint.type,
                    "hash": e.endpoint.type_hash,
                    "qos": e.endpoint.qos,
                }
                for e in found
                if e.endpoint is not None
            ]
            print_json({"topic": name, "contract": None if row is None else row.model_dump(mode="json"), "endpoints": ends})
            return
        out = table("", "")
        out.show_header = False
        for key, value in _facts(row):
            out.add_row(f"[bold]{key}[/]", value)
        console().print(out)
        ends_table = table("node", "", "type", "hash")
        for entity in found:
            end = entity.endpoint
            if end is not None:
                same = row is None or (end.type, end.type_hash) == (row.type, row.type_hash)
                shown = end.type_hash[:24] + "…" if same else f"[bold red]{end.type_hash[:24]}… differs[/]"
                ends_table.add_row(entity.node, f"{entity.kind.name.lower()}", end.type, shown)
        console().print()
        console().print(ends_table)


class Echo(NamedTuple):
    """What of the messages of a topic is printed, and for how long."""

    field: str | None = None
    """Only this field."""
    at_most: int | None = None
    full: bool = False
    """Long arrays in full."""
    seconds: float | None = None


def print_messages(name: str, chosen: ChosenBus, wanted: Echo, as_json: bool) -> None:
    """Prints the messages of a topic as they come."""
    left = wanted.at_most
    with command(), _listening(name, chosen) as (topic, listener):
        for heard in _until(listener, wanted.seconds):
            message = _message(heard, topic)
            value = plain(message, full=wanted.full or as_json, path=wanted.field)
            if as_json:
                print_line({"topic": topic.name, "sequence": heard.sequence, "sent_ns": heard.sent, "message": value})
            else:
                print(yaml.safe_dump(value, sort_keys=False, allow_unicode=True, width=120), end="---\n", flush=True)
            left = None if left is None else left - 1
            if left == 0:
                return


def measure_rate(name: str, chosen: ChosenBus, seconds: float | None, as_json: bool) -> None:
    """Measures a topic's rate, once a second: messages per second of real and of simulated time, and their spacing."""
    with command(), _listening(name, chosen) as (topic, listener):
        spacing = Spacing()
        for heard in _each_second(listener, seconds):
            for one in heard:
                spacing.add(one.sent, _stamp(one, topic))
            _say_rate(spacing, topic, as_json)
        if spacing.messages > 1:
            _say_rate(spacing, topic, as_json, whole=True)


def measure_bandwidth(name: str, chosen: ChosenBus, seconds: float | None, as_json: bool) -> None:
    """Measures a topic's bandwidth, once a second: payload bytes per second and per message."""
    with command(), _listening(name, chosen) as (topic, listener):
        window: deque[list[int]] = deque(maxlen=BANDWIDTH_OVER)
        for heard in _each_second(listener, seconds):
            window.append([len(one.payload) for one in heard])
            _say_bandwidth(window, topic, as_json)


@contextmanager
def _listening(name: str, chosen: ChosenBus) -> Iterator[tuple[Topic, Listener]]:
    """Joins the bus and listens to a topic: the contract's, or any that is there with a message type that we know."""
    with joined(chosen) as bus:
        name = name.strip("/")
        row = contract().topics.get(name)
        if row is None:
            live = graph.topics(graph.present(bus)).get(name)
            if live is None:
                raise NoBus(f"no topic {name!r} on the bus or in the contract; palpate topic list shows those that are")
            types = sorted(kind for kind, _ in live.types)
            try:
                codec.message_type(types[0])
            except codec.CodecError as error:
                raise NoBus(f"topic {name}: {error}") from error
            row = Topic(name=name, type=types[0], producer="", readers={}, qos="event", event=True, doc="")
        listener = Listener(bus.session, row, bus.domain)
        try:
            yield row, listener
        finally:
            listener.close()


def _until(listener: Listener, seconds: float | None) -> Iterator[Heard]:
    """Messages as they come, until the time is over."""
    end = None if seconds is None else monotonic() + seconds
    while end is None or monotonic() < end:
        if (heard := listener.get(0.1)) is not None:
            yield heard


def _each_second(listener: Listener, seconds: float | None) -> Iterator[list[Heard]]:
    """The messages of each second, until the time is over."""
    left = inf if seconds is None else seconds
    while left > 0:
        yield list(_until(listener, min(left, EVERY_S)))
        left -= EVERY_S


def _message(heard: Heard, topic: Topic) -> Any:
    try:
        return codec.decode(heard.payload, topic.type)
    except codec.CodecError as error:
        raise NoBus(f"{topic.name}: a message of {len(heard.payload)} bytes is not {topic.type}: {error}") from error


def _stamp(heard: Heard, topic: Topic) -> int | None:
    header = getattr(_message(heard, topic), "header", None)
    return None if header is None else int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def _say_rate(spacing: Spacing, topic: Topic, as_json: bool, whole: bool = False) -> None:
    facts = spacing.summary(whole)
    wanted = None if topic.latched or topic.event else 1000 / topic.period_ms
    if as_json:
        print_line({"topic": topic.name, "contract_hz": wanted, **facts})
        return
    if facts["messages"] < 2:
        Console(highlight=False).print("[dim]no messages[/]")
        return
    simulated = "" if facts["simulated_hz"] is None else f", {facts['simulated_hz']:.4g} Hz of simulated time"
    text = f"{facts['wall_hz']:.4g} Hz{simulated}"
    text += f" (contract {wanted:g} Hz)" if wanted else ""
    text += (
        f"; spacing {facts['mean_ms']:.3g} ms mean, {facts['least_ms']:.3g} to {facts['most_ms']:.3g}, std {facts['std_ms']:.2g}"
    )
    print(("in all: " if whole else "") + text + f"; {facts['messages']} messages", flush=True)


def _say_bandwidth(window: Collection[list[int]], topic: Topic, as_json: bool) -> None:
    """`window` has the sizes of the messages of the last seconds."""
    sizes = [size for second in window for size in second]
    rate = sum(sizes) / (len(window) * EVERY_S)
    if as_json:
        print_line(
            {"topic": topic.name, "bytes_per_s": rate, "messages": len(sizes), "mean_bytes": sum(sizes) / max(len(sizes), 1)}
        )
    elif not sizes:
        Console(highlight=False).print("[dim]no messages[/]")
    else:
        mean = sum(sizes) / len(sizes)
        print(f"{bandwidth(rate)}; {mean:.0f} B a message, {min(sizes)} to {max(sizes)}; {len(sizes)} messages", flush=True)


def _period(row: Topic) -> str:
    return "latched" if row.latched else f"{row.period_ms} ms{' event' if row.event else ''}"


def _facts(row: Topic | None) -> list[tuple[str, str]]:
    if row is None:
        return [("contract", "does not have it")]
    facts = [("topic", row.name), ("", row.doc), ("type", row.type), ("hash", row.type_hash), ("producer", row.producer)]
    facts += [("sent", _period(row)), ("QoS", row.qos), ("may be known to", str(row.visibility))]
    facts += [("frame", row.frame)] if row.frame else []
    for path in dict.fromkeys([*row.units, *row.ranges]):
        least, most = row.ranges.get(path, (None, None))
        facts.append(
            (path, f"[{row.units.get(path, '1')}]".replace("[", r"\[") + ("" if least is None else f" {least:g} .. {most:g}"))
        )
    facts += [("stale after", f"{row.max_age_ms} ms")] if row.max_age_ms else []
    facts += [("expires after", f"{row.expiry_ms} ms")] if row.expiry_ms else []
    return facts


def _topic_facts(topic: graph.LiveTopic) -> dict[str, Any]:
    row = contract().topics.get(topic.name)
    return {
        "topic": topic.name,
        "types": [{"type": name, "hash": digest} for name, digest in sorted(topic.types)],
        "publishers": sorted(topic.publishers),
        "subscribers": sorted(topic.subscribers),
        "in_contract": row is not None,
        "matches_contract": row is not None and {(row.type, row.type_hash)} == topic.types,
    }
