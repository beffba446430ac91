"""Runs the conformance suite of a role, in this process or on a bus, with a progress bar, and prints the result."""

import gc
import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from time import monotonic, sleep, time_ns
from typing import Any, NamedTuple

import typer
import zenoh
from rich.text import Text

from palpate.apart import run_guarded, shared_numbers
from palpate.check.rig import ConformanceReport, Feed, ReceivedMessage, Rig, RigSettings, ServiceRig, Verdict
from palpate.check.suites import SUITES, check
from palpate.console import TimeLeft, table, wide_console
from palpate.live.topic import every_sender
from palpate_bus import implementations
from palpate_bus.contract import CONDUCTOR
from palpate_bus.messages import MS, NS, Message, RunControl, ServiceReport, codec
from palpate_bus.runs.announcement import NoBusError
from palpate_bus.runtime.conductor_link import CONTROL_TYPE, REPORT_TYPE
from palpate_bus.runtime.member import Member
from palpate_bus.settings import Settings
from palpate_bus.wire.liveliness import EntityKind, GraphWatch, gid
from palpate_bus.wire.rmw import AttachmentWriter, topic_key
from palpate_bus.wire.transport import ReceivedSample, Subscription, Transport
from palpate_bus.wire.zenoh_config import BusOptions, session
from palpate_errors import restate
from palpate_inputs import parse_json
from palpate_models.scenario.load import dump_scenario, view_of


class ProtocolTiming(NamedTuple):
    """Intervals and limits of the run protocol."""

    hello_s: float = 0.05
    ready_s: float = 20.0
    """For an implementation on the bus to answer on every edge."""
    lead_ns: int = 200 * MS
    """From the grant to the common start."""
    control_s: float = 0.4
    """Between control messages."""
    finish_s: float = 10.0


TIMING = ProtocolTiming()


class LiveRig(Rig):
    """One implementation of a role on the bus of `session`."""

    live = True

    def __init__(self, session: zenoh.Session, role: str, settings: RigSettings, domain: int = 0) -> None:
        super().__init__(role, settings)
        self._session = session
        self._domain = domain
        self.graph = GraphWatch(session, domain)
        producers = {CONDUCTOR, *(topic.producer for topic, _ in self.contract.inputs(role))}
        transport = Transport(session)
        self._members = {name: Member(session, name, self.contract, domain, transport) for name in sorted(producers)}
        self._publishers = {t.name: self._members[t.producer].publisher(t) for t, _ in self.contract.inputs(role)}
        self._control = self._members[CONDUCTOR].internal_publisher("palpate/control", CONTROL_TYPE, "event")
        self._reports = self._members[CONDUCTOR].internal_subscription(f"palpate/report/{role}", REPORT_TYPE)
        self._readers = {topic.name: every_sender(session, topic, domain) for topic in self.contract.outputs(role)}
        self._sequences = dict.fromkeys([*self._publishers, "control"], 0)
        self._epoch = 0
        self._last_control = 0.0
        self.finished = False
        self.facts: dict[str, Any] = {}
        """Facts that the implementation reported at its end."""
        self.error = ""
        """Error that it reported if it failed."""

    # -- protocol

    def await_implementation(self, seconds: float) -> None:
        """Wait for the role to appear, send hello and start it. Raises NoBusError if it does not appear within `seconds`."""
        self.section("protocol")
        gc.freeze()  # a full collection during a check would delay commands beyond their validity
        end = monotonic() + seconds
        while self.role.name not in self._others():
            if monotonic() > end:
                reason = f"no node {self.role.name!r} appeared within {seconds:.0f} s"
                raise NoBusError(f"{reason}; it needs a liveliness token of that name")
            self._say(RunControl.HELLO)
            sleep(TIMING.hello_s)
        self.expect("joins as a node of its role", True, self.role.name, self.role.name)
        self._greet()
        self._check_graph()
        self._epoch = time_ns() + TIMING.lead_ns
        self._say(RunControl.GRANT, self._epoch)
        while time_ns() < self._epoch:
            sleep(0.002)

    def _others(self) -> set[str]:
        self.graph.changes()
        ours = str(self._session.zid())
        return {entity.node for entity in self.graph.alive.values() if entity.zid != ours}

    def _greet(self) -> None:
        end = monotonic() + TIMING.ready_s
        missing: list[str] | None = None
        while missing != [] and monotonic() < end:
            self._say(RunControl.HELLO)
            for publisher in self._publishers.values():
                publisher.hello()
            sleep(TIMING.hello_s)
            for message in self._receive_reports():
                if message.state == ServiceReport.READY:
                    missing = list(parse_json(message.detail or "{}", "the detail of palpate/report").get("missing", []))
        ready = missing == []
        got = "nothing" if missing is None else f"READY, but it receives nothing on {', '.join(missing)}"
        got = "READY" if ready else got
        self.expect("answers the conductor's hello", ready, "a ServiceReport READY with nothing missing", got)

    def _check_graph(self) -> None:
        self.graph.changes()
        ours = str(self._session.zid())
        ends = [e for e in self.graph.alive.values() if e.node == self.role.name and e.zid != ours and e.endpoint is not None]
        sent = {e.endpoint.topic: e.endpoint for e in ends if e.kind is EntityKind.PUBLISHER and e.endpoint is not None}
        for topic in self.contract.outputs(self.role.name):
            end = sent.pop(topic.name, None)
            wanted = f"{topic.type} {topic.type_hash[:15]}"
            got = "no publisher's token" if end is None else f"{end.type} {end.type_hash[:15]}"
            if end is None and topic.name.startswith("sim/"):
                self.skip(f"publishes {topic.name}", "hardware has no such sensor")
                continue
            self.equal(f"publishes {topic.name}", got, wanted)
        self.expect("publishes nothing else", not sent, "the topics of its role only", ", ".join(sent) or "nothing else")

    def finish(self) -> None:
        """Send garbage to it, end it, and check its reactions."""
        self.section("garbage")
        self._disturb()
        self.section("end")
        self._say(RunControl.GRANT, self.t + 100 * MS, last=True)
        end = monotonic() + TIMING.finish_s
        while not self.finished and monotonic() < end:
            self._receive_reports()
            self._drain()
            sleep(0.02)
        got = "FINISHED" if self.finished else f"FAILED: {self.error}" if self.error else "nothing"
        self.expect("reports FINISHED at the end", self.finished, f"within {TIMING.finish_s:.0f} s", got)
        self._say(RunControl.END)

    def close(self) -> None:
        """Abort an implementation that still runs, and leave the bus."""
        self._say(RunControl.ABORT, reason="the conformance check is over")
        for member in self._members.values():
            member.close()
        self.graph.close()
        for reader in self._readers.values():
            reader.close()
        self._reports.close()

    def _disturb(self) -> None:
        """Send undecodable bytes and messages of an unknown sender on every input."""
        stranger = AttachmentWriter(gid("a stranger")).pack
        for name in self._publishers:
            topic = self.contract.topics[name]
            key = topic_key(topic, self._domain)
            self._session.put(key, b"\xff" * 40)
            self._session.put(key, b"\xff" * 40, attachment=b"no attachment")
            self._session.put(key, b"\xff" * 40, attachment=stranger(1, time_ns()))
            self._next(name, b"\x00\x01\x00\x00\xff")
        after = self.run(0.6, {})
        self._receive_reports()
        silent = [t.name for t in self.contract.outputs(self.role.name) if t.periodic and self.log[t.name] and not after[t.name]]
        there = self.role.name in self._others()
        states = {"gone": not there, f"silent on {', '.join(silent)}": silent, f"failed: {self.error}": self.error}
        got = next((text for text, so in states.items() if so), "continues")
        self.equal("garbage on its inputs does not stop it", got, "continues")

    def _receive_reports(self) -> list[Any]:
        received = [message for _, message in self._decoded(self._reports, REPORT_TYPE, "palpate/report")]
        for message in received:
            if message.state == ServiceReport.FINISHED:
                self.finished = True
                self.facts = parse_json(message.detail or "{}", "the detail of palpate/report")
            elif message.state == ServiceReport.FAILED:
                self.error = message.detail
        return received

    def _say(self, command: int, tick: int = 0, last: bool = False, role: str = "", reason: str = "") -> None:
        self._last_control = monotonic()
        self._sequences["control"] += 1
        message = RunControl(command, tick, last, role, reason)
        self._control.put(codec.encode(message, CONTROL_TYPE), self._sequences["control"])

    # -- the rig

    def _advance(self, end: int, feed: Feed) -> None:
        last = {name: (self.t - 1) // self.contract.topics[name].period for name in feed}
        while True:
            now = max(time_ns() - self._epoch, 0)
            for name, source in feed.items():
                period = self.contract.topics[name].period
                if now // period > last[name]:
                    last[name] = now // period
                    message = source(last[name] * period)
                    if message is not None:
                        self.send(name, message)
            self.t = now
            self._drain()
            if monotonic() - self._last_control > TIMING.control_s:
                self._say(RunControl.GRANT, self._epoch)
                self._receive_reports()
            if now >= end:
                return
            sleep(max(0.0, (MS - (time_ns() - self._epoch) % MS) / NS))

    def send(self, topic: str, message: Message) -> None:
        """Publish a message as its producer."""
        self._next(topic, codec.encode(message, self.contract.topics[topic].type))

    def lose(self, role: str) -> None:
        """Report a role as lost, as a conductor does."""
        self._say(RunControl.LOST, self.t, role=role, reason="conformance check")

    def _next(self, topic: str, payload: bytes) -> None:
        self._sequences[topic] += 1
        self._publishers[topic].put(payload, self._sequences[topic])

    def _drain(self) -> None:
        for name, reader in self._readers.items():
            for received, message in self._decoded(reader, self.contract.topics[name].type, name):
                self.log[name].append(ReceivedMessage(self.t, message, received.sequence, received.sent))

    def _decoded(self, reader: Subscription, kind: str, name: str) -> Iterator[tuple[ReceivedSample, Message]]:
        """Yield what a subscription has received, and its messages; note what cannot be decoded."""
        while (received := reader.get(0)) is not None:
            try:
                message = codec.decode(received.payload, kind)
            except codec.CodecError as error:
                self.undecodable.append(f"{name}: {error}")
                continue
            yield received, message


@contextmanager
def start_implementation(command: str | None, role: str, settings: RigSettings, endpoint: str, domain: int) -> Iterator[None]:
    """Start the implementation for the duration of the check, if a command was given."""
    if command is None:
        yield
        return
    with tempfile.TemporaryDirectory(prefix="palpate-check-") as folder:
        view = view_of(role)
        file = Path(folder) / f"{view}.yaml"
        file.write_text(dump_scenario(settings.scenario, view), encoding="utf-8")
        given = {"router": endpoint, "scenario": file, "out": folder, "domain": domain}
        environment = os.environ | Settings.read().replace(runtime="wallclock", record="none", **given).to_env()
        split = shlex.split(command)
        with restate(OSError, NoBusError, f"--start {command}"):
            child = subprocess.Popen([sys.executable if split[0] == "python" else split[0], *split[1:]], env=environment)
        try:
            yield
            with suppress(subprocess.TimeoutExpired):
                child.wait(timeout=5)
        finally:
            for end in (child.terminate, child.kill):
                if child.poll() is None:
                    end()
                    with suppress(subprocess.TimeoutExpired):
                        child.wait(timeout=5)


def _progress_bar(rig: Rig) -> TimeLeft:
    """Return a bar that follows the clock of a rig."""
    role, report = rig.role.name, rig.report
    return TimeLeft(lambda: f"{role}: {report.group}, {len(report.results)} checks", lambda: rig.t / NS, 0.0, SUITES[role])


_COLOURS = {Verdict.PASSED: "green", Verdict.FAILED: "bold red", Verdict.SKIPPED: "dim"}


def check_here(role: str, choice: str, settings: RigSettings) -> ConformanceReport:
    """Check an implementation in a child process, in simulated time. Raises PluginError for one that there is not, RunError for
    one that exits, crashes or hangs.
    """
    steps = shared_numbers()

    def perform() -> ConformanceReport:
        rig = ServiceRig(implementations.create(role, choice, settings.scenario), settings, steps)
        with _progress_bar(rig):
            return check(rig)

    limits = Settings.read()
    return run_guarded(f"services.{role} = {choice!r}", perform, limits.start_limit_s, place=lambda: (steps[0],))


def check_live(
    role: str, settings: RigSettings, connect: list[str] | None, listen: str, start: str | None, domain: int, wait: float
) -> ConformanceReport:
    """Wait for an implementation on the bus and check it there. Raises NoBusError if none joins."""
    options = BusOptions(connect=tuple(connect)) if connect else BusOptions(mode="router", listen=(listen,))
    with session(options) as bus:
        where = ", ".join(connect) if connect else listen
        typer.echo(f"waiting for {role} at {where}, domain {domain}", err=True)
        rig = LiveRig(bus, role, settings, domain)
        try:
            with start_implementation(start, role, settings, where, domain):
                rig.await_implementation(wait)
                with _progress_bar(rig):
                    check(rig)
                    rig.finish()
        finally:
            rig.close()
    return rig.report


def print_report(report: ConformanceReport, failures: bool) -> None:
    """Print each check, or with `failures` only failed ones, and the verdict."""
    out = wide_console()
    rows = table("", "check", "expected", "got")
    group = ""
    for result in report.results:
        if failures and result.verdict is not Verdict.FAILED:
            continue
        if result.group != group:
            group = result.group
            rows.add_row("", Text(group, "bold"), "", "")
        rows.add_row(Text(result.verdict, _COLOURS[result.verdict]), result.name, result.expected, result.got)
    out.print(rows)
    counts = {kind: sum(result.verdict is kind for result in report.results) for kind in Verdict}
    summary = ", ".join(f"{count} {kind}" for kind, count in counts.items())
    verdict = ("conforms", "green") if report.passed else ("does not conform", "bold red")
    load = os.getloadavg()[0] / (os.cpu_count() or 1)
    if not report.passed and load > 1:
        reason = f"this machine is overloaded (load {load:.1f} per processor)"
        out.print(f"\n{reason}: rates and reaction times are unreliable", style="yellow")
    out.print(Text.assemble(f"\n{report.role}: ", verdict, f", {summary}"))
