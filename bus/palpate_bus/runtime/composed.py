"""Composed lockstep: all services in one process, in the order and with the messages of distributed lockstep.

Every message is encoded once, since the run hash covers its bytes, and decoded by the first reader that looks at it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from math import lcm
from typing import Any

from palpate_bus.contract import MS, Contract, Topic, contract
from palpate_bus.runtime.failure import described
from palpate_bus.runtime.lockstep import OutputPort, Received, Sent, Stepper, run_hash
from palpate_bus.service import Service

Tap = Callable[[Topic, bytes, int, int], None]
"""Called for every message: topic, payload, stamp [ns], sequence."""


CONDUCTOR = "conductor"
"""The one observer without which there is no result."""


class ServiceFailed(RuntimeError):
    """A service raised. Names the role and the tick; the cause is chained."""

    def __init__(self, stepper: Stepper, t: int, cause: Exception) -> None:
        self.role = stepper.role.name
        self.t = t
        self.why = described(cause, stepper.buffers.values())
        """The cause, with the inputs that are not as they should be."""
        super().__init__(f"{self.role} failed at tick {t / 1e9:.3f} s: {self.why}")


class Composed:
    """A run of services in this process.

    run = Composed([RobotService(...), ...])
    run.run(lambda: end_tick, limit)

    A service that raises ends the run; an observer or a tap that does is left out from then on (`lost`, `trouble`).
    """

    def __init__(self, services: Sequence[Service], rules: Contract | None = None, taps: Sequence[Tap] = ()) -> None:
        self.contract = rules or contract()
        by_role = {service.role: service for service in services}
        order = self.contract.step_order(tuple(role for role in self.contract.roles if role in by_role))
        workers = [role for role in order if not self.contract.roles[role].observer]
        observers = [role for role in order if self.contract.roles[role].observer]
        self.steppers = {role: Stepper(by_role[role], self.contract) for role in (*workers, *observers)}
        self._taps = tuple(taps)
        self._readers: dict[OutputPort, tuple[Callable[[Received], None], ...]] = {
            port: tuple(stepper.buffers[name].deliver for stepper in self.steppers.values() if name in stepper.buffers)
            for sender in self.steppers.values()
            for name, port in sender.ports.items()
        }
        self._schedule = _schedule(tuple(self.steppers.values()))
        self._started = False
        self.t = 0
        self.lost: dict[str, int] = {}
        """Observers that have failed, and at what tick [ns]."""
        self.trouble: list[str] = []
        """A sentence for each."""

    def _send(self, sent: Sequence[Sent], t: int) -> None:
        for port, payload, sequence in sent:
            if readers := self._readers[port]:
                received = Received(payload, t, sequence)
                for deliver in readers:
                    deliver(received)
            for tap in self._taps:
                try:
                    tap(port.topic, payload, t, sequence)
                except Exception as error:
                    self._taps = tuple(other for other in self._taps if other is not tap)
                    self._leave_out("recorder", t, f"{type(error).__name__}: {error}")

    def start(self) -> None:
        """Sends the latched messages."""
        for stepper in self.steppers.values():
            try:
                self._send(stepper.start(), 0)
            except Exception as error:
                raise ServiceFailed(stepper, 0, error) from error
        self._started = True

    def tick(self) -> None:
        """Steps every service whose tick this is, then advances simulated time by a millisecond."""
        t = self.t
        for stepper in self._schedule[t // MS % len(self._schedule)]:
            try:
                sent = stepper.step(t)
            except Exception as error:
                if not stepper.role.observer or stepper.role.name == CONDUCTOR:
                    raise ServiceFailed(stepper, t, error) from error
                self._leave_out(stepper.role.name, t, described(error, stepper.buffers.values()))
                self._schedule = _schedule(tuple(one for role, one in self.steppers.items() if role not in self.lost))
                continue
            if sent:
                self._send(sent, t)
        self.t = t + MS

    def _leave_out(self, role: str, t: int, why: str) -> None:
        self.lost[role] = t
        self.trouble.append(f"{role} lost at tick {t / 1e9:.3f} s: {why}")

    def run(self, end: Callable[[], int | None], limit: int) -> int:
        """Runs up to and including the tick [ns] that `end()` gives once it knows, at most to `limit`; returns the last tick."""
        if not self._started:
            self.start()
        last = limit
        while self.t <= last:
            self.tick()
            decided = end()
            if decided is not None:
                last = min(decided, limit)
        return self.t - MS

    def finish(self) -> dict[str, Mapping[str, Any]]:
        """Finishes every service; returns what each reports. One that has failed need not."""
        facts = {}
        for role, stepper in self.steppers.items():
            with suppress(Exception) if role in self.lost else nullcontext():
                facts[role] = stepper.service.finish()
        return facts

    def run_hash(self) -> str:
        """The run hash."""
        return run_hash(self.digests())

    def digests(self) -> dict[str, str]:
        """Digest of each hashed topic."""
        digests: dict[str, str] = {}
        for stepper in self.steppers.values():
            digests.update(stepper.digests())
        return digests


def _schedule(steppers: Sequence[Stepper]) -> tuple[tuple[Stepper, ...], ...]:
    """The services that step at each tick of one cycle; every cycle is the same."""
    cycle = lcm(*(stepper.role.period // MS for stepper in steppers))
    return tuple(tuple(one for one in steppers if not tick * MS % one.role.period) for tick in range(cycle))
