"""`palpate topic list|info|echo|hz|bw`: topics on a live bus."""

from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, fields, is_dataclass
from math import inf
from time import monotonic
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
import typer
import yaml
import zenoh
from rich.filesize import decimal
from rich.text import Text

from palpate.console import print_json, print_line, say, table, wide_console
from palpate.live.bus import AsJson, ChosenRun, Connect, Domain, ends, join_bus, present
from palpate.run.options import takes
from palpate_bus.contract import Topic, contract
from palpate_bus.messages import codec, nanoseconds
from palpate_bus.runs.announcement import NoBusError
from palpate_bus.wire.liveliness import Entity, EntityKind
from palpate_bus.wire.rmw import parse_key, topic_key
from palpate_bus.wire.transport import ReceivedSample, Subscription
from palpate_errors import restate


class TopicTimes(NamedTuple):
    """Windows of the statistics, and limits of the output."""

    report_period_s: float = 1.0
    silent_s: float = 5.0
    """A topic without a message for this time is announced."""
    bandwidth_periods: int = 5
    """Bandwidth is the mean over this many report periods."""
    spacing_messages: int = 10_000
    """Maximum number of messages over which rate and spacing are computed."""
    shown_items: int = 12
    """Longer arrays are shortened in the output."""


TOPIC: Final = TopicTimes()

app = typer.Typer(help="Topics on a live bus.", no_args_is_help=True)
Name = Annotated[str, typer.Argument(metavar="TOPIC", help="Name of a topic, e.g. joint_states.")]


@app.command("list")
def list_topics(connect: Connect = None, run: ChosenRun = None, domain: Domain = None, as_json: AsJson = False) -> None:
    """List the topics on the bus: type, who publishes, who subscribes, and whether the contract has it."""
    with join_bus(connect, run, domain) as bus:
        rows = topic_rows(present(bus))
    if as_json:
        print_json(rows)
        return
    out = table("topic", "type", "published by", "subscribed by", "in the contract")
    for topic in rows:
        row = contract().topics.get(topic["topic"])
        known = Text("no", "yellow") if row is None else Text(row.sent)
        if row is not None and not topic["matches_contract"]:
            known = Text("other type or hash", "bold red")
        types = ", ".join(one["type"].replace("/msg/", "/") for one in topic["types"])
        publishers = ", ".join(topic["publishers"]) or Text("none", "yellow")
        out.add_row(topic["topic"], types, publishers, ", ".join(topic["subscribers"]), known)
    wide_console().print(out)


def topic_rows(found: Sequence[Entity]) -> list[dict[str, Any]]:
    """Return a row per topic, sorted: its types with their hashes, of which more than one is a mismatch, and its nodes."""
    rows: dict[str, dict[str, Any]] = {}
    for side, kind in (("publishers", EntityKind.PUBLISHER), ("subscribers", EntityKind.SUBSCRIPTION)):
        for node, end in ends(found, kind):
            row = rows.setdefault(end.topic, {"topic": end.topic, "types": set(), "publishers": [], "subscribers": []})
            row["types"].add((end.type, end.type_hash))
            row[side] = sorted([*row[side], node])
    for name, row in rows.items():
        known = contract().topics.get(name)
        row["in_contract"] = known is not None
        row["matches_contract"] = known is not None and {(known.type, known.type_hash)} == row["types"]
        row["types"] = [{"type": kind, "hash": digest} for kind, digest in sorted(row["types"])]
    return [rows[name] for name in sorted(rows)]


@app.command()
def info(name: Name, connect: Connect = None, run: ChosenRun = None, domain: Domain = None, as_json: AsJson = False) -> None:
    """Show a topic: its row of the contract, and who publishes and subscribes on the bus with which type hash."""
    name = name.strip("/")
    with join_bus(connect, run, domain) as bus:
        found = [e for e in present(bus) if e.endpoint is not None and e.endpoint.topic == name]
    row = contract().topics.get(name)
    if not found and row is None:
        raise _unknown(name)
    there = [(entity, entity.endpoint) for entity in found if entity.endpoint is not None]
    if as_json:
        nodes = [{"node": entity.node, "kind": entity.kind.name.lower()} for entity, _ in there]
        kinds = [{"type": end.type, "hash": end.type_hash, "qos": end.qos} for _, end in there]
        endpoints = [node | kind for node, kind in zip(nodes, kinds, strict=True)]
        print_json({"topic": name, "contract": None if row is None else row.model_dump(mode="json"), "endpoints": endpoints})
        return
    out = table("", "")
    out.show_header = False
    about = [("contract", "does not have it")] if row is None else [("topic", name), ("", row.doc), *row.facts()]
    for key, value in about:
        out.add_row(Text(key, "bold"), value)
    ends_table = table("node", "", "type", "hash")
    for entity, end in there:
        same = row is None or (end.type, end.type_hash) == (row.type, row.type_hash)
        shown = Text(f"{end.type_hash[:24]}…") if same else Text(f"{end.type_hash[:24]}… differs", "bold red")
        ends_table.add_row(entity.node, entity.kind.name.lower(), end.type, shown)
    for part in (out, "", ends_table):
        wide_console().print(part)


@dataclass(frozen=True)
class StreamOptions:
    """The topic that a command receives, on which bus, and for how long."""

    name: Name
    connect: Connect = None
    run: ChosenRun = None
    domain: Domain = None
    as_json: AsJson = False
    seconds: Annotated[float | None, typer.Option("--seconds", min=0)] = None
    """Stop after this long; by default Ctrl-C ends it."""


@dataclass(frozen=True)
class EchoOptions(StreamOptions):
    """Selection and form of the printed messages."""

    field: Annotated[str | None, typer.Option()] = None
    """Only this field, e.g. wrench.force."""
    count: Annotated[int | None, typer.Option("--count", "-n", min=1)] = None
    """Stop after N messages."""
    once: Annotated[bool, typer.Option("--once")] = False
    """Stop after one message."""
    full: Annotated[bool, typer.Option("--full")] = False
    """Print long arrays in full."""


@app.command()
@takes(EchoOptions)
def echo(options: EchoOptions) -> None:
    """Print the messages of a topic as they arrive."""
    left = 1 if options.once else options.count
    with _subscribe(options) as (topic, reader):
        for received in _until(reader, options.seconds):
            value = plain(_message(received, topic), full=options.full or options.as_json, path=options.field)
            if options.as_json:
                print_line({"topic": topic.name, "sequence": received.sequence, "sent_ns": received.sent, "message": value})
            else:
                print(yaml.safe_dump(value, sort_keys=False, allow_unicode=True, width=120), end="---\n", flush=True)
            left = None if left is None else left - 1
            if left == 0:
                return


@app.command()
@takes(StreamOptions)
def hz(options: StreamOptions) -> None:
    """Measure a topic's rate, once a second: messages per second of real and of simulated time, and their spacing."""
    with _subscribe(options) as (topic, reader):
        rows: deque[tuple[int, int | None]] = deque(maxlen=TOPIC.spacing_messages)
        for received in _each_period(reader, options.seconds):
            rows.extend((message.sent, _stamp_ns(message, topic)) for message in received)
            _print_rate(list(rows)[-len(received) - 1 :], topic, options.as_json)
        if len(rows) > 1:
            _print_rate(list(rows), topic, options.as_json, whole=True)


@app.command()
@takes(StreamOptions)
def bw(options: StreamOptions) -> None:
    """Measure a topic's bandwidth, once a second: payload bytes per second and per message."""
    with _subscribe(options) as (topic, reader):
        window: deque[list[int]] = deque(maxlen=TOPIC.bandwidth_periods)
        for received in _each_period(reader, options.seconds):
            window.append([len(message.payload) for message in received])
            sizes = [size for period in window for size in period]
            rate, mean = sum(sizes) / (len(window) * TOPIC.report_period_s), sum(sizes) / max(len(sizes), 1)
            if options.as_json:
                print_line({"topic": topic.name, "bytes_per_s": rate, "messages": len(sizes), "mean_bytes": mean})
            else:
                size = f"{mean:.0f} B per message, {min(sizes, default=0)} to {max(sizes, default=0)}"
                print(f"{decimal(round(rate))}/s; {size}; {len(sizes)} messages", flush=True)


def every_sender(session: zenoh.Session, topic: Topic, domain: int) -> Subscription:
    """Subscribe to the messages of all senders of a topic; of a latched topic also to the last one sent before."""
    return Subscription(session, topic_key(topic, domain), topic.latched, decode=bytes)


def spacing(rows: Sequence[tuple[int, int | None]]) -> dict[str, Any]:
    """Return rates and spacing of messages, given by source time and stamp [ns], by the sender's clocks."""
    sent = np.array([source for source, _ in rows], dtype=np.int64)
    stamps = [stamp for _, stamp in rows if stamp is not None]
    steps_ms = np.diff(sent) / 1e6
    if steps_ms.size == 0 or not sent[-1] > sent[0]:
        return {"wall_hz": None, "simulated_hz": None}
    passed_ns = stamps[-1] - stamps[0] if len(stamps) > 1 else 0
    simulated_hz = 1e9 * (len(stamps) - 1) / passed_ns if passed_ns > 0 else None
    figures = {"mean": steps_ms.mean(), "least": steps_ms.min(), "most": steps_ms.max(), "std": steps_ms.std()}
    rates = {"wall_hz": 1e3 * steps_ms.size / steps_ms.sum(), "simulated_hz": simulated_hz}
    return {**rates, **{f"{name}_ms": float(value) for name, value in figures.items()}}


@contextmanager
def _subscribe(options: StreamOptions) -> Iterator[tuple[Topic, Subscription]]:
    """Join the bus and subscribe to a topic: the contract's, or any that is there with a known message type."""
    with join_bus(options.connect, options.run, options.domain) as bus:
        name = options.name.strip("/")
        row = contract().topics.get(name)
        if row is None:
            found = ends(present(bus), EntityKind.PUBLISHER, EntityKind.SUBSCRIPTION)
            live = [end.type for _, end in found if end.topic == name]
            if not live:
                raise _unknown(name)
            kind = min(live)
            with restate(codec.CodecError, NoBusError, f"topic {name}"):
                codec.message_type(kind)
            row = Topic(name=name, type=kind, producer="", readers={}, qos="event", event=True, doc="")
        with closing(every_sender(bus.session, row, bus.target.domain)) as reader:
            yield row, reader


def _unknown(name: str) -> NoBusError:
    return NoBusError(f"no topic {name!r} on the bus or in the contract; palpate topic list shows those that are")


def _until(reader: Subscription, seconds: float | None) -> Iterator[ReceivedSample]:
    """Yield messages until the time is over. Says once that none arrives."""
    begin = monotonic()
    end, silent = None if seconds is None else begin + seconds, True
    while end is None or monotonic() < end:
        if (received := reader.get(0.1)) is not None:
            silent = False
            yield received
        elif silent and monotonic() - begin > TOPIC.silent_s:
            silent = False
            limit = "until Ctrl-C" if seconds is None else f"{seconds:g} s at most"
            say(f"no message on {parse_key(reader.key).topic} for {TOPIC.silent_s:g} s; waiting {limit}")


def _each_period(reader: Subscription, seconds: float | None) -> Iterator[list[ReceivedSample]]:
    """Yield the messages of each report period until the time is over."""
    left = inf if seconds is None else seconds
    while left > 0:
        yield list(_until(reader, min(left, TOPIC.report_period_s)))
        left -= TOPIC.report_period_s


def _message(received: ReceivedSample, topic: Topic) -> Any:
    with restate(codec.CodecError, NoBusError, f"{topic.name}: a message of {len(received.payload)} bytes is not {topic.type}"):
        return codec.decode(received.payload, topic.type)


def _stamp_ns(received: ReceivedSample, topic: Topic) -> int | None:
    header = getattr(_message(received, topic), "header", None)
    return None if header is None else nanoseconds(header.stamp)


def plain(message: Any, *, full: bool, path: str | None = None) -> Any:
    """Return a message, or its field `path`, as values for YAML and JSON. Without `full` long arrays are shortened.

    Raises NoBusError naming the fields for an unknown one.
    """
    for name in (path or "").split(".") if path else []:
        names = [field.name for field in fields(message)] if is_dataclass(message) else []
        if name not in names:
            raise NoBusError(f"no field {path!r}: no {name!r} among {', '.join(names) or 'nothing (it is a value)'}")
        message = getattr(message, name)
    return _plain(message, full)


def _plain(value: Any, full: bool) -> Any:
    if is_dataclass(value):
        # constants of the message type are fields of its dataclass, in capitals
        names = [field.name for field in fields(value) if not field.name.isupper() and field.name != "__msgtype__"]
        return {name: _plain(getattr(value, name), full) for name in names}
    if isinstance(value, np.ndarray | list | tuple):
        items = [_plain(item, full) for item in (value if full else value[: TOPIC.shown_items])]
        return items if len(items) == len(value) else [*items, f"... {len(value)} items"]
    return value.item() if isinstance(value, np.generic) else value


def _print_rate(rows: Sequence[tuple[int, int | None]], topic: Topic, as_json: bool, whole: bool = False) -> None:
    """Print the rate of the new messages, which follow the first of `rows`, or of the `whole` stream."""
    facts = {"messages": max(len(rows) - (not whole), 0), **spacing(rows)}
    contract_hz = None if topic.latched or topic.event else 1000 / topic.period_ms
    if as_json:
        print_line({"topic": topic.name, "contract_hz": contract_hz, **facts})
        return
    if facts["messages"] < 2:
        print("no messages", flush=True)
        return
    text = "in all: " if whole else ""
    text += f"{facts['wall_hz']:.4g} Hz"
    text += "" if facts["simulated_hz"] is None else f", {facts['simulated_hz']:.4g} Hz of simulated time"
    text += f" (contract {contract_hz:g} Hz)" if contract_hz else ""
    text += f"; spacing {facts['mean_ms']:.3g} ms mean, {facts['least_ms']:.3g} to {facts['most_ms']:.3g}"
    print(f"{text}, std {facts['std_ms']:.2g}; {facts['messages']} messages", flush=True)
