"""Wall-clock mode: one service per process, each on its own timer, newest sample wins; for hardware, real or simulated.

`t` counts periods since the common start, with absolute deadlines, so that no drift builds up. A late step is counted as an
overrun. The service of a critical role simulates physics, which has to keep time: it catches up tick by tick, unless it is later
than `TIMES.catch_up_ns` or drives real hardware. All others skip to the present tick, since an old command is useless and stamps
must stay on the common clock; or to one missed shortly before at which a slower topic is due, which would starve. No service
waits for another; expiry protects the readers of a late sample. A message that breaks the contract is dropped where it is sent
or received, so that its readers act as on silence.

On a slow machine the common clock may run slower than the wall clock (PALPATE_RATE); never with hardware.
"""

import logging
from collections import Counter
from collections.abc import Callable, Sequence
from time import monotonic_ns, sleep
from typing import Any, NamedTuple

import numpy as np

from palpate_bus.contract import CONDUCTOR, Edge, Topic, Visibility
from palpate_bus.contract.port_check import RefusedMessage
from palpate_bus.messages import MS, CodecError, RunControl, ServiceReport
from palpate_bus.runtime.conductor_link import RunAborted
from palpate_bus.runtime.lockstep import NEVER, Outgoing, Packet, Stepper
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.node import Node, Seat
from palpate_bus.runtime.process import lower_priority, niceness_of_period, process_identity
from palpate_bus.service import Service
from palpate_bus.settings import Settings
from palpate_bus.wire.transport import dropped_by

BIN_NS = 20_000
"""Width of a bin of ages [ns]."""


def age_ms(bins: Counter[int]) -> dict[str, float]:
    """Return mean, median, 99th percentile and largest age of the messages of a topic [ms], given by their numbers per bin."""
    ages = np.repeat(list(bins.keys()), list(bins.values())) * BIN_NS / 1e6
    figures = {"mean": ages.mean(), "p50": np.quantile(ages, 0.5), "p99": np.quantile(ages, 0.99), "max": ages.max()}
    return {name: round(float(value), 3) for name, value in figures.items()}


log = logging.getLogger(__name__)


class WallClockTimes(NamedTuple):
    """Times of a service in wall-clock mode."""

    catch_up_ns: int = 200 * MS
    """Lag [ns] beyond which a critical role skips to the present tick."""
    handshake_poll_s: float = 0.02
    without_conductor_s: float = 4.0
    """Time for which services continue without a conductor, so that planning lifts the arm clear of the patient."""
    physics_stays_s: float = 0.5
    """Additional time for critical roles, so that a driver enters safe hold after its commander has left."""
    clock_read_ns: int = 100_000
    """Two clocks read within this time [ns] count as read at once."""


TIMES = WallClockTimes()


def _awaited(edge: Edge, topic: Topic) -> bool:
    """Return True if the first step needs a message of the topic."""
    return edge is Edge.LATCHED or (edge is Edge.SAME_TICK and topic.periodic and topic.visibility is Visibility.PUBLIC)


def _on_monotonic_clock(wall: int, now: Callable[[], int]) -> int:
    """Convert a wall time [ns] to this process's monotonic clock [ns]; `now` reads the wall clock.

    Reads both clocks again if the process was preempted in between, which would shift this service against the others.
    """
    while True:
        before, read, after = monotonic_ns(), now(), monotonic_ns()
        if after - before < TIMES.clock_read_ns:
            return (before + after) // 2 + wall - read


class WallClockNode(Node):
    """One service on its own timer."""

    def __init__(self, service: Service, member: Member) -> None:
        self._member = member
        self._stepper = Stepper(service, member.contract, strict=False, refuse=self._refuse)
        self._seat = Seat(self._stepper, member)
        stays = TIMES.physics_stays_s if self._stepper.role.critical else 0.0
        super().__init__((self._seat,), member, TIMES.without_conductor_s + stays)
        self._now = member.transport.now
        self._data = {
            name: member.subscription(buffer.topic, history=buffer.topic.latched)
            for name, buffer in self._stepper.buffers.items()
        }
        self._sequences = dict.fromkeys(self._data, 0)
        self._number = Counter(gaps=0, undecodable=0, refused=0, overruns=0, skips=0)
        self._ages: dict[str, Counter[int]] = {name: Counter() for name in self._data}
        self._end: int | None = None
        self._rate = Settings.read().rate or 1.0
        self._epoch = 0
        """Common start of the run on this process's monotonic clock [ns]."""

    def _join(self) -> None:
        lower_priority(niceness_of_period(self._stepper.role.period))
        self._epoch = self._await_start()

    def _await_start(self) -> int:
        """Answer hellos until the conductor sends the common start; return it on this process's monotonic clock [ns].

        The conductor repeats the start for services that replace another during the run. One counts after a hello, which the
        conductor sends to a free slot: the answer names the process that it then watches.
        """
        greeted = False
        while True:
            message = self._link.poll(TIMES.handshake_poll_s)
            self._receive(0)  # a faster service may have sent its latched topics already
            if message is None:
                continue
            if message.command == RunControl.HELLO and message.role in ("", self._seat.role):
                greeted = True
                self._seat.output.hello()
                silent = (name for name, data in self._data.items() if not data.hello_received)
                missing = [name for name in silent if self._stepper.buffers[name].edge.blocking]
                self._seat.reports.send(ServiceReport.READY, NEVER, detail={"missing": missing, **process_identity()})
            elif message.command == RunControl.GRANT and message.last:
                raise RunAborted("the run is already ending")
            elif message.command == RunControl.GRANT and greeted:
                return _on_monotonic_clock(int(message.tick), self._now)

    def _obey(self, message: Any) -> None:
        if message.command == RunControl.LOST:
            log.warning("%s lost: %s", message.role, message.reason)
            self._stepper.inbox.lost_roles.add(message.role)
        elif message.command == RunControl.HANDOVER:
            log.warning("%s is replaced: %s", message.role, message.reason)
            for name, buffer in self._stepper.buffers.items():
                if buffer.topic.producer == message.role:
                    self._data[name].hand_over()
                    self._sequences[name] = 0
        elif message.command == RunControl.GRANT and message.last:
            self._end = int(message.tick)

    def _loop(self) -> None:
        period = self._stepper.role.period
        slower = [port.period for port in self._stepper.ports.values() if port.topic.periodic and port.period > period]
        grid = min(slower, default=period)
        catch_up = TIMES.catch_up_ns if self._stepper.role.critical and self._seat.service.catches_up else period
        t = self._await_inputs()
        while self._end is None or t <= self._end:
            late = self._run_time() - t
            if late < 0:
                sleep(-late / self._rate / 1e9)
            elif late > period:
                self._number["overruns"] += 1
                if late > catch_up:
                    present = t + late // period * period
                    due = present // grid * grid
                    t = due if due >= t else present
                    self._number["skips"] += 1
            self._receive(t)
            self._seat.output.record(self._step_and_send(self._seat, t), t)
            self._seat.tick = t
            while (message := self._link.poll()) is not None:
                self._obey(message)
            self._note_lost_conductor()
            self._seat.progress()
            t += period

    def _note_lost_conductor(self) -> None:
        """Mark the conductor lost for the service, and report that in case the conductor returns."""
        lost = self._stepper.inbox.lost_roles
        if self._link.lost and CONDUCTOR not in lost:
            lost.add(CONDUCTOR)
            self._seat.reports.report_conductor_lost(self._seat.tick, self._link.lost)

    def _run_time(self) -> int:
        """Return the time of the run [ns]: wall time since the common start, times the rate."""
        passed = monotonic_ns() - self._epoch
        return passed if self._rate == 1.0 else int(passed * self._rate)

    def _await_inputs(self) -> int:
        """Wait for a first message on every input that the first step needs; return the tick [ns] at which it may step.

        Events are not awaited, nor topics that only a simulation sends, since there may be none.
        """
        self._receive(0)
        needed = [b for b in self._stepper.buffers.values() if _awaited(b.edge, b.topic)]
        while missing := [b.topic.name for b in needed if not b.holds_any]:
            self._seat.progress(missing[0])
            if self._end is not None:  # the missing input will not be sent
                return self._end + 1
            message = self._link.poll(TIMES.handshake_poll_s)
            if message is not None:
                self._obey(message)
            self._receive(0)
        period = self._stepper.role.period
        return max(0, self._run_time() // period * period)

    def _receive(self, t: int) -> None:
        now = self._now()
        for name, buffer in self._stepper.buffers.items():
            data = self._data[name]
            while (sample := data.get(0)) is not None:
                if data.replaced:  # earlier messages were of another sender
                    data.replaced = False
                    self._sequences[name] = 0
                    buffer.pending.clear()
                last = self._sequences[name]
                if sample.sequence <= last and not buffer.topic.open:
                    continue
                if sample.sequence > last + 1 and not buffer.topic.open:
                    self._number["gaps"] += sample.sequence - last - 1
                self._sequences[name] = sample.sequence
                self._ages[name][max(now - sample.sent, 0) // BIN_NS] += 1  # clocks of two machines may give a negative age
                try:
                    # decoded here, not in the service: invalid bytes must not end a driver whose arm is in contact
                    message = buffer.decode(sample.payload)
                    buffer.check(message, t)
                except RefusedMessage as refused:
                    self._refuse(refused)
                    continue
                except CodecError as error:
                    if not self._number["undecodable"]:
                        log.error("%s: %s; such messages are dropped and counted", name, error)
                    self._number["undecodable"] += 1
                    continue
                buffer.deliver(Packet(sample.payload, t - buffer.delay, sample.sequence, message))

    def _refuse(self, refused: RefusedMessage) -> None:
        self._number["refused"] += 1
        self._member.note_refused(refused)

    def _send(self, seat: Seat, sent: Sequence[Outgoing]) -> None:
        seat.output.send(sent)

    def _counts(self, seat: Seat) -> dict[str, Any]:
        ages = {name: age_ms(bins) for name, bins in self._ages.items() if bins}
        dropped = dropped_by(self._data.values())
        dropped["garbage"] += self._link.garbage
        return {"digests": {}, **dropped, **self._number, "refused_topics": sorted(self._member.refused_topics), "age_ms": ages}
