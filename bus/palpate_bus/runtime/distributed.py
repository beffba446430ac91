"""Distributed lockstep: processes over zenoh, conservative synchronisation with no master in the data path.

A node hosts one service, or a group of them that hear each other without the bus. It waits until each blocking input from another
process has advanced far enough, steps the service, and sends. The conductor only says how far simulated time may go (grants),
which roles were lost, and when to stop. A node never hangs: it leaves when the conductor falls silent.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from time import perf_counter_ns
from typing import Any

from palpate_bus.messages import RunControl, ServiceReport
from palpate_bus.runtime.conductor_link import POLL_S
from palpate_bus.runtime.group import Group
from palpate_bus.runtime.lockstep import NEVER, Sent
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.node import Node, Seat
from palpate_bus.runtime.process_state import whereabouts
from palpate_bus.runtime.remote import Advances, RemoteInputs, awaited_elsewhere
from palpate_bus.service import Service

log = logging.getLogger(__name__)


class LockstepNode(Node):
    """A group of services in distributed lockstep."""

    def __init__(self, services: Sequence[Service], members: Mapping[str, Member]) -> None:
        """`members` gives the membership of each role."""
        rules = next(iter(members.values())).rules
        self._group = Group(services, rules)
        roles = self._group.steppers.keys()
        seats = [Seat(stepper, members[role]) for role, stepper in self._group.steppers.items()]
        super().__init__(seats, members[seats[0].role])
        self._seat = {seat.stepper: seat for seat in seats}
        self._inputs = {seat: RemoteInputs(seat.stepper, members[seat.role], roles) for seat in seats}
        self._advances = {
            seat: Advances(seat.stepper, members[seat.role]) for seat in seats if any(awaited_elsewhere(rules, seat.role, roles))
        }
        self._horizon = NEVER
        self._last = False

    def _join(self) -> None:
        """Answers the conductor's hellos until it grants the first tick."""
        while self._horizon < 0:
            message = self._link.poll(POLL_S)
            if message is not None and message.command == RunControl.HELLO:
                for seat in self._seats:
                    seat.output.hello()
                    if seat in self._advances:
                        self._advances[seat].hello()
                    detail = {
                        "missing": self._inputs[seat].unheard(),
                        "process": [one.role for one in self._seats],
                        **whereabouts(),
                    }
                    seat.reports.say(ServiceReport.READY, NEVER, detail=detail)
            elif message is not None:
                self._obey(message)

    def _obey(self, message: Any) -> None:
        if message.command == RunControl.GRANT:
            self._horizon = max(self._horizon, message.tick) if not message.last else message.tick
            self._last = self._last or message.last
        elif message.command == RunControl.LOST:
            log.warning("%s lost at %.3f s: %s", message.role, message.tick / 1e9, message.reason)
            for inputs in self._inputs.values():
                inputs.lose(message.role)

    def _loop(self) -> None:
        t = 0
        while self._await_horizon(t):
            for stepper in self._group.due(t):
                self._step(self._seat[stepper], t)
            self._attend()
            t += self._group.period

    def _step(self, seat: Seat, t: int) -> None:
        self._acting = seat
        self._inputs[seat].await_tick(t, self._attend)
        everything: list[Sent] = []
        blame = seat.stepper.blame
        for sent in seat.stepper.parts(t):
            start = perf_counter_ns()
            self._send(seat, sent)
            blame.send += perf_counter_ns() - start
            everything += sent
        start = perf_counter_ns()
        if seat in self._advances:
            self._advances[seat].close(t)
        seat.output.record(everything, t)
        blame.send += perf_counter_ns() - start
        seat.tick = t

    def _send(self, seat: Seat, sent: Sequence[Sent]) -> None:
        self._group.deliver(sent)
        seat.output.send(sent)

    def _attend(self, waiting_for: str = "") -> None:
        """Reports what the whole process waits for, and does what the conductor says."""
        for seat in self._seats:
            seat.progress(waiting_for)
        while (message := self._link.poll()) is not None:
            self._obey(message)

    def _await_horizon(self, t: int) -> bool:
        """Waits until tick `t` is granted; False when the run ends before it."""
        while t > self._horizon:
            if self._last:
                return False
            message = self._link.poll(POLL_S)
            if message is not None:
                self._obey(message)
            for seat in self._seats:
                seat.progress("grant")
        return True

    def _counts(self, seat: Seat) -> dict[str, Any]:
        counts = self._inputs[seat].counts()
        if seat is self._seats[0]:
            counts["garbage"] += self._link.garbage
        return {"digests": seat.stepper.digests(), **counts}
