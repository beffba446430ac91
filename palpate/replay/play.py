"""Plays a recording on the bus: the same keys, bytes and sequence numbers, in scaled real time."""

import logging
from collections.abc import Collection
from pathlib import Path
from time import monotonic_ns, sleep
from types import TracebackType
from typing import Final, NamedTuple, Self

from palpate.console import SteadyConsole, TimeLeft
from palpate_bus.contract import Contract, contract
from palpate_bus.messages import MS, NS, Clock, codec, time_message
from palpate_bus.recordings import Recording, open_recording
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.observer import CLOCK
from palpate_bus.settings import Settings
from palpate_bus.wire.liveliness import EntityKind, GraphWatch
from palpate_bus.wire.transport import Sender
from palpate_bus.wire.zenoh_config import BusOptions, close_session, open_session
from palpate_errors import RunError, UserError

DEFAULT_LISTEN = "tcp/127.0.0.1:7447"
"""Endpoint of a replay if the environment names none: ROS 2's rmw_zenoh expects its router here."""
LOOK_NS = NS
"""The bus is watched this long before anything is played, and checked at this interval during it [ns]."""


class PlayTimes(NamedTuple):
    """Times of a replay."""

    longest_ns: int = 7 * 86400 * NS
    """Longest recording that is played [ns]; a longer one has stamps of two clocks."""
    clock_period_ns: int = 10 * MS


PLAY: Final = PlayTimes()


class Player:
    """Plays a recording. Every role that it plays appears in the ROS graph; use it as a context manager."""

    def __init__(
        self,
        recording: Recording,
        rate: float = 1.0,
        topics: Collection[str] | None = None,
        listen: str | None = None,
        drive: bool = False,
    ) -> None:
        """Join the bus.

        Raises UserError if nothing can be played, or if a running service sends a topic that would be played, or, without
        `drive`, would act on it.
        """
        self._recording = recording
        self._rate = rate
        self._drive = drive
        self._looked = 0
        self.topics = _choose_topics(recording, contract(), topics)
        recording.check(contract(), self.topics, whole=False)
        self.origin = recording.origin(self.topics)
        """Stamp [ns] from which the times of `play` count."""
        if (span := recording.last - self.origin) > PLAY.longest_ns:
            raise UserError(f"{recording.path}: its stamps span {span / NS / 86400:.0f} days: some of them are wrong")
        options = _options(listen)
        self.where = f"on {', '.join(options.listen)}" if options.listen else "on the bus of the environment"
        self._session = open_session(options)
        try:
            domain = Settings.read().domain
            self._graph = GraphWatch(self._session, domain)
            begin = monotonic_ns()
            while monotonic_ns() - begin < LOOK_NS:  # peers retry every 0.1 s to connect
                self._look()
                sleep(0.05)
            clock = [CLOCK] if CLOCK not in recording.types and topics is None else []
            members: dict[str, Member] = {}
            self._members = members  # a deleted member withdraws its tokens
            self._publishers: dict[str, Sender] = {}
            for name in (*self.topics, *clock):
                row = contract().topics[name]
                if row.producer not in members:
                    members[row.producer] = Member(self._session, row.producer, contract(), domain)
                self._publishers[name] = members[row.producer].publisher(row)
        except BaseException:
            close_session(self._session)
            raise
        self._own_clock = bool(clock)
        self._encode_clock = codec.encoder(contract().topics[CLOCK].type)
        self._next_clock = 0
        self.now = 0
        """Time reached [ns], from the recording's origin."""
        self.sent = 0
        self.lag_ms = 0.0
        """Largest delay of a message."""

    def _look(self) -> None:
        """Raise UserError if a service of another process sends a topic that is played, or would act on it."""
        self._graph.changes()
        own = str(self._session.zid())
        alive = {e.node for e in self._graph.alive.values() if e.kind is EntityKind.NODE and e.zid != own}
        for name in self.topics if alive else ():
            row = contract().topics[name]
            if row.producer in alive:
                advice = "play on another bus (--listen) or other topics"
                raise UserError(f"{row.producer} runs on this bus and sends {name} itself; {advice}")
            acting = sorted(role for role in row.readers if role in alive and not contract().roles[role].observer)
            if acting and not self._drive:
                raise UserError(f"{', '.join(acting)} would act on {name}; --drive allows it")

    def play(self, start: int = 0, until: int | None = None) -> None:
        """Play from `start` to `until` [ns after the origin].

        It begins with the last earlier message of each topic that is not periodic.

        Raises UserError if a service appears that sends a topic that is played, or would act on it.
        """
        self.now, prelude = start, start > 0
        start += self.origin
        until = None if until is None else until + self.origin
        self._next_clock = start
        if prelude:
            self._prelude(start)
        epoch = 0
        for message in self._recording.messages(self.topics, start, until):
            epoch = epoch or monotonic_ns()  # after the first chunk is unpacked
            while self._own_clock and self._next_clock <= message.stamp:
                self._wait(epoch + round((self._next_clock - start) / self._rate))
                self._tick()
            self._wait(epoch + round((message.stamp - start) / self._rate))
            self.now = message.stamp - self.origin
            self._publishers[message.topic].put(message.payload, max(message.sequence, 1))
            self.sent += 1

    def _prelude(self, start: int) -> None:
        """Send the last message before `start` of each topic that is not periodic, which a late joiner would receive."""
        quiet = [name for name in self.topics if not contract().topics[name].periodic]
        last = {message.topic: message for message in self._recording.messages(quiet, end=start - 1)}
        for message in last.values():
            self._publishers[message.topic].put(message.payload, max(message.sequence, 1))
            self.sent += 1

    def _tick(self) -> None:
        message = Clock(time_message(self._next_clock))
        self._publishers[CLOCK].put(self._encode_clock(message), self._next_clock // PLAY.clock_period_ns + 1)
        self._next_clock += PLAY.clock_period_ns

    def _wait(self, due: int) -> None:
        left = due - monotonic_ns()
        self.lag_ms = max(self.lag_ms, -left / 1e6)
        while True:
            now = monotonic_ns()
            if now - self._looked > LOOK_NS:
                self._looked = now
                self._look()
            if now >= due:
                return
            sleep(min(due - now, LOOK_NS) / NS)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        close_session(self._session)


def _choose_topics(recording: Recording, contract: Contract, topics: Collection[str] | None) -> tuple[str, ...]:
    for name in topics or ():
        if name.strip("/") not in recording.types:
            raise UserError(f"--topic {name}: {recording.path} has {', '.join(sorted(recording.types))}")
    wanted = [name.strip("/") for name in topics] if topics else list(recording.types)
    unknown = [name for name in wanted if name not in contract.topics]
    if unknown and topics:
        raise UserError(f"--topic {', '.join(unknown)}: not in the contract")
    chosen = tuple(name for name in wanted if name in contract.topics and recording.counts.get(name))
    if not chosen:
        known = ", ".join(f"{name} ({recording.types[name].name})" for name in sorted(wanted)[:12]) or "no topic with a schema"
        raise UserError(f"{recording.path}: has no message on a topic of the contract; it has {known}")
    return chosen


def _options(listen: str | None) -> BusOptions:
    options = BusOptions.from_settings(Settings.read())
    if listen:
        return BusOptions(listen=(listen,), connect=options.connect, router=options.router)
    if not (options.listen or options.connect or options.router or options.zenoh_config):
        return BusOptions(listen=(DEFAULT_LISTEN,))
    return options


def play(
    file: Path,
    start: int,
    end: int | None,
    rate: float,
    topics: Collection[str] | None,
    listen: str | None,
    hold: bool,
    drive: bool,
) -> None:
    """Play a recording on the bus from `start` to `end` [ns] or Ctrl-C; with `hold` until Ctrl-C. Raises UserError."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s")
    console = SteadyConsole(stderr=True)
    recording = open_recording(file)
    with Player(recording, rate, topics, listen, drive) as player:
        console.print(f"playing {file} at {rate:g} x {player.where}; Ctrl-C ends")
        last = recording.last - player.origin
        if start > last:
            raise UserError(f"--from {start / NS:g}: {file} ends at {last / NS:.3f} s")
        try:
            with TimeLeft(lambda: "playing", lambda: player.now, start, last if end is None else min(end, last)):
                player.play(start, end)
            if not player.sent:
                raise RunError(f"{file}: played no message: it has none in the part that was chosen")
            console.print(f"played {player.sent} messages up to {player.now / NS:.3f} s, at most {player.lag_ms:.1f} ms late")
            if hold:
                console.print("holding; Ctrl-C ends")
            while hold:
                sleep(1.0)
        except KeyboardInterrupt:
            console.print(f"ended at {player.now / NS:.3f} s after {player.sent} messages")
