"""Wall clock: one service a process, each on its own timer, freshest sample wins: for hardware, real or simulated in real time.

A service still sees whole ticks: `t` counts periods since the common start, with absolute deadlines, so that no drift builds up.
A late step is counted as an overrun. The service of a critical role simulates physics, which has to keep time: it catches up tick
by tick, unless it is later than `CATCH_UP` or drives real hardware. All others skip to the present tick, since an old command
helps nobody and stamps must stay on the common clock. No service waits for another; expiry protects the readers of a late sample.

On a machine that cannot keep up, the common clock may go slower than the wall's (PALPATE_RATE); never with hardware.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from time import monotonic_ns, perf_counter_ns, sleep
from typing import Any

from palpate_bus.contract import MS, Edge, Topic, Visibility
from palpate_bus.messages import RunControl, ServiceReport
from palpate_bus.messages.codec import CodecError
from palpate_bus.runtime.conductor_link import CONDUCTOR, RunAborted
from palpate_bus.runtime.latency import LatencyHistogram
from palpate_bus.runtime.lockstep import NEVER, Packet, Sent, Stepper
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.node import Node, Seat
from palpate_bus.runtime.priority import by_period, give_way
from palpate_bus.runtime.process_state import whereabouts
from palpate_bus.service import Service
from palpate_bus.settings import Settings

log = logging.getLogger(__name__)

CATCH_UP = 200 * MS
"""Lag [ns] beyond which a critical role gives up catching up."""
HANDSHAKE_POLL_S = 0.02
WITHOUT_CONDUCTOR_S = 4.0
"""For how long services go on without a conductor: planning lifts the arm in this time, and it comes clear of the patient."""
PHYSICS_STAYS_S = 0.5
"""A critical role goes on for so much longer: a driver whose commander has left holds before it leaves itself."""
READ_NS = 100_000
"""Two clocks read within this time [ns] were read at once."""


def _awaited(edge: Edge, topic: Topic) -> bool:
    """Whether the first step needs a message of a topic."""
    return edge is Edge.LATCHED or (edge is Edge.SAME_TICK and topic.periodic and topic.visibility is Visibility.PUBLIC)


def _on_monotonic_clock(wall: int, now: Callable[[], int]) -> int:
    """A wall time [ns] on this process's monotonic clock [ns]; `now` reads the wall clock.

    Read again when the process was set aside between the readings: that would put this service ahead of the others for good.
    """
    while True:
        before, read, after = monotonic_ns(), now(), monotonic_ns()
        if after - before < READ_NS:
            return (before + after) // 2 + wall - read


class WallClockNode(Node):
    """One service on its own timer."""

    def __init__(self, service: Service, member: Member) -> None:
        self._stepper = Stepper(service, member.rules, strict=False)
        self._seat = Seat(self._stepper, member)
        stays = PHYSICS_STAYS_S if self._stepper.role.critical else 0.0
        super().__init__((self._seat,), member, WITHOUT_CONDUCTOR_S + stays)
        self._now = member.transport.now
        self._data = {
            name: member.subscription(buffer.topic, history=buffer.topic.latched)
            for name, buffer in self._stepper.buffers.items()
        }
        self._sequences = dict.fromkeys(self._data, 0)
        self.gaps = 0
        self.undecodable = 0
        self.overruns = 0
        self.skips = 0
        self._ages = {name: LatencyHistogram() for name in self._data}
        self._end: int | None = None
        self._rate = Settings.read().rate or 1.0
        self._epoch = 0
        """The common start of the run on this process's monotonic clock [ns]."""

    def _join(self) -> None:
        give_way(by_period(self._stepper.role.period))
        self._epoch = self._await_start()

    def _await_start(self) -> int:
        """Answers hellos until the conductor gives the common start, which it returns on this process's monotonic clock [ns].

        The conductor repeats the start, so that a service that takes over a role in the middle of a run hears it too.
        """
        while True:
            message = self._link.poll(HANDSHAKE_POLL_S)
            self._receive(0)  # a quicker service may have sent its latched topics already
            if message is None:
                continue
            if message.command == RunControl.HELLO:
                self._seat.output.hello()
                missing = [
                    name for name, buffer in self._stepper.buffers.items() if buffer.edge.blocking and not self._data[name].heard
                ]
                self._seat.reports.say(ServiceReport.READY, NEVER, detail={"missing": missing, **whereabouts()})
            elif message.command == RunControl.GRANT and message.last:
                raise RunAborted("the run is already ending")
            elif message.command == RunControl.GRANT:
                return _on_monotonic_clock(int(message.tick), self._now)

    def _obey(self, message: Any) -> None:
        if message.command == RunControl.LOST:
            log.warning("%s lost: %s", message.role, message.reason)
            self._stepper.inbox.lost_roles.add(message.role)
        elif message.command == RunControl.HANDOVER:
            log.warning("%s changes hands: %s", message.role, message.reason)
            for name, buffer in self._stepper.buffers.items():
                if buffer.topic.producer == message.role:
                    self._data[name].hand_over()
                    self._sequences[name] = 0
        elif message.command == RunControl.GRANT and message.last:
            self._end = int(message.tick)

    def _loop(self) -> None:
        period = self._stepper.role.period
        catch_up = CATCH_UP if self._stepper.role.critical and self._seat.service.catches_up else period
        t = self._await_inputs()
        while self._end is None or t <= self._end:
            late = self._passed() - t
            if late < 0:
                sleep(-late / self._rate / 1e9)
            elif late > period:
                self.overruns += 1
                if late > catch_up:
                    t += late // period * period
                    self.skips += 1
            self._receive(t)
            everything: list[Sent] = []
            for sent in self._stepper.parts(t):
                start = perf_counter_ns()
                self._send(self._seat, sent)
                self._stepper.blame.send += perf_counter_ns() - start
                everything += sent
            self._seat.output.record(everything, t)
            self._seat.tick = t
            while (message := self._link.poll()) is not None:
                self._obey(message)
            self._note_lost_conductor()
            self._seat.progress()
            t += period

    def _note_lost_conductor(self) -> None:
        """Tells the service once that the conductor is lost, and the conductor, in case that it comes back."""
        lost = self._stepper.inbox.lost_roles
        if self._link.lost and CONDUCTOR not in lost:
            lost.add(CONDUCTOR)
            self._seat.reports.miss_conductor(self._seat.tick, self._link.lost)

    def _passed(self) -> int:
        """The time of the run [ns]: the wall's since the common start, or less of it."""
        passed = monotonic_ns() - self._epoch
        return passed if self._rate == 1.0 else int(passed * self._rate)

    def _await_inputs(self) -> int:
        """Waits until every input that the first step needs has come once; returns the tick [ns] at which it may step.

        Not for events, which may never come, nor for what only a simulation sends, which hardware in this role never hears.
        """
        needed = [b for b in self._stepper.buffers.values() if _awaited(b.edge, b.topic)]
        while True:
            self._receive(0)
            missing = next((b.topic.name for b in needed if not b.holds_any), "")
            if not missing:
                break
            self._seat.progress(missing)
            if self._end is not None:  # what is missing does not come any more
                return self._end + 1
            message = self._link.poll(HANDSHAKE_POLL_S if needed else None)
            if message is not None:
                self._obey(message)
        period = self._stepper.role.period
        return max(0, self._passed() // period * period)

    def _receive(self, t: int) -> None:
        now = self._now()
        for name, buffer in self._stepper.buffers.items():
            data = self._data[name]
            while (sample := data.get(0)) is not None:
                if data.replaced:  # what came before was a stranger's
                    data.replaced = False
                    self._sequences[name] = 0
                    buffer.pending.clear()
                last = self._sequences[name]
                if sample.sequence <= last and not buffer.topic.open:
                    continue
                if sample.sequence > last + 1 and not buffer.topic.open:
                    self.gaps += sample.sequence - last - 1
                self._sequences[name] = sample.sequence
                self._ages[name].add(now - sample.sent)
                try:
                    # Now, not when the service looks: broken bytes must not end a driver whose arm is in contact.
                    message = buffer.decode(sample.payload)
                except CodecError as error:
                    self.undecodable += 1
                    if self.undecodable == 1:
                        log.error("%s: %s; it and its like are dropped and counted", name, error)
                    continue
                buffer.deliver(Packet(sample.payload, t - buffer.delay, sample.sequence, message))

    def _send(self, seat: Seat, sent: Sequence[Sent]) -> None:
        seat.output.send(sent)

    def _counts(self, seat: Seat) -> dict[str, Any]:
        return {
            "digests": {},
            "garbage": sum(s.garbage for s in self._data.values()) + self._link.garbage,
            "foreign": sum(s.foreign for s in self._data.values()),
            "forged": sum(s.forged for s in self._data.values()),
            "gaps": self.gaps,
            "undecodable": self.undecodable,
            "overruns": self.overruns,
            "skips": self.skips,
            "age_ms": {name: ages.as_ms() for name, ages in self._ages.items() if ages.count},
        }
