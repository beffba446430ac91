"""Composed lockstep: all services in one process, as one group without transport.

In a group messages are delivered at once. A message is encoded once, since the run hash covers its bytes. Readers get the message
itself, with copies of its arrays, if decoding would give an equal one, else the first reader decodes it. `Composed` and
`distributed` (between other processes) drive a group in the same order: by tick, then by the same_tick edges of the contract
among all roles, also those outside the group. So the first of all pending steps in this order has all its inputs, and groups
that wait for each other do not deadlock.
"""

from collections.abc import Callable, MutableSequence, Sequence
from math import gcd, lcm
from typing import Any

from palpate_bus.contract import CONDUCTOR, Contract, Topic, contract as default_contract
from palpate_bus.messages import codec
from palpate_bus.runtime.failure import Failure
from palpate_bus.runtime.lockstep import Outgoing, OutputPort, Packet, Stepper, run_hash
from palpate_bus.service import Service
from palpate_errors import RunError

Tap = Callable[[Topic, bytes, int, int], None]
"""Called for every message: topic, payload, stamp [ns], sequence."""
NO_ROLE = -1
"""The number of no role, between two steps."""


class ServiceFailed(RunError):
    """A service raised. Names the role and the tick; the cause is chained."""

    def __init__(self, stepper: Stepper, t: int, cause: BaseException) -> None:
        self.role = stepper.role.name
        self.t = t
        self.failure = Failure.of(cause, self.role, stepper.buffers.values())
        super().__init__(f"{self.role} failed at {t / 1e9:.3f} s: {self.failure}")


class Group:
    """Services of one process; `steppers` has them by role, in step order."""

    def __init__(self, services: Sequence[Service], contract: Contract) -> None:
        by_role = {service.role: service for service in services}
        order = [role for role in contract.step_order(tuple(contract.roles)) if role in by_role]
        order.sort(key=lambda role: contract.roles[role].observer)
        self.steppers = {role: Stepper(by_role[role], contract) for role in order}
        self.period = gcd(*(stepper.role.period for stepper in self.steppers.values()))
        """Period of the group's ticks [ns]."""
        self._readers: dict[OutputPort, tuple[Callable[[Packet], None], ...]] = {
            port: tuple(stepper.buffers[name].deliver for stepper in self.steppers.values() if name in stepper.buffers)
            for sender in self.steppers.values()
            for name, port in sender.ports.items()
        }
        for port, readers in self._readers.items():
            port.passed = codec.passer(port.topic.type) if readers else None
        self._schedule = self._schedule_cycle(frozenset())

    def _schedule_cycle(self, without: frozenset[str]) -> tuple[tuple[Stepper, ...], ...]:
        """Return the services that step at each tick of one cycle, which repeats."""
        steppers = [stepper for role, stepper in self.steppers.items() if role not in without]
        ticks = range(0, lcm(*(stepper.role.period for stepper in steppers)), self.period)
        return tuple(tuple(one for one in steppers if not t % one.role.period) for t in ticks)

    def due(self, t: int) -> tuple[Stepper, ...]:
        """Return the services that step at `t` [ns], a multiple of `period`, in order."""
        return self._schedule[t // self.period % len(self._schedule)]

    def leave_out(self, roles: frozenset[str]) -> None:
        """Stop stepping the services of `roles`."""
        self._schedule = self._schedule_cycle(roles)

    def deliver(self, sent: Sequence[Outgoing]) -> None:
        """Deliver messages to their readers in the group."""
        for port, packet in sent:
            for deliver in self._readers[port]:
                deliver(packet)

    def digests(self) -> dict[str, str]:
        """Return the digest of each hashed topic of the group."""
        return {name: digest for stepper in self.steppers.values() for name, digest in stepper.digests().items()}


class Composed:
    """A run of services in this process.

    run = Composed([RobotService(...), ...])
    run.run(lambda: end_tick, limit)

    A service that raises ends the run. An observer or a tap that raises is left out from then on, see `lost` and `trouble`.
    """

    def __init__(
        self,
        services: Sequence[Service],
        contract: Contract | None = None,
        taps: Sequence[Tap] = (),
        at: MutableSequence[int] | None = None,
    ) -> None:
        """`at` is kept up to date: the number of the role that steps, in the order of the contract, and simulated time [ns]."""
        contract = contract or default_contract()
        self._roles = contract.roles
        self._group = Group(services, contract)
        self.steppers = self._group.steppers
        self._at: MutableSequence[int] = [NO_ROLE, 0] if at is None else at
        numbers = {role: number for number, role in enumerate(contract.roles)}
        self._numbers = {stepper: numbers[role] for role, stepper in self.steppers.items()}
        self._taps = tuple(taps)
        for stepper in self.steppers.values():
            for port in stepper.ports.values():
                port.here, port.passed = not taps, codec.passer(port.topic.type)
        self._started = False
        self.t = 0
        self.lost: dict[str, int] = {}
        """Tick [ns] at which each failed service raised."""
        self.trouble: list[str] = []
        """Messages for the user about failed observers."""
        self.failure: Failure | None = None
        """The first failure of another service."""

    def _send(self, sent: Sequence[Outgoing], t: int) -> None:
        self._group.deliver(sent)
        for tap in self._taps:
            try:
                for port, packet in sent:
                    tap(port.topic, packet.payload, t, packet.sequence)
            except Exception as error:
                self._taps = tuple(other for other in self._taps if other is not tap)
                self._leave_out("recorder", t, f"{type(error).__name__}: {error}")

    def start(self) -> None:
        """Send the latched messages."""
        for stepper in self.steppers.values():
            self._at[0] = self._numbers[stepper]
            try:
                self._send(stepper.start(), 0)
            except (Exception, SystemExit) as error:
                raise self._fail(stepper, 0, error) from error
        self._started = True

    def tick(self) -> None:
        """Step the services that are due, then advance simulated time to the next tick."""
        t, at, numbers = self.t, self._at, self._numbers
        at[1] = t
        for stepper in self._group.due(t):
            at[0] = numbers[stepper]
            try:
                sent = stepper.step(t)
            except (Exception, SystemExit) as error:
                if not stepper.role.observer or stepper.role.name == CONDUCTOR:
                    raise self._fail(stepper, t, error) from error
                self._leave_out(stepper.role.name, t, Failure.of(error, stepper.role.name, stepper.buffers.values()).text)
                self._group.leave_out(frozenset(self.lost))
                continue
            at[0] = NO_ROLE
            if sent:
                self._send(sent, t)
        self.t = t + self._group.period

    def _fail(self, stepper: Stepper, t: int, cause: BaseException) -> ServiceFailed:
        """Note the failure of a service other than an observer, and return it."""
        error = ServiceFailed(stepper, t, cause)
        self.lost[error.role] = t
        self.failure = self.failure or error.failure._replace(text=f"{error.role} lost at {t / 1e9:.3f} s: {error.failure}")
        return error

    def _leave_out(self, role: str, t: int, reason: str) -> None:
        self.lost[role] = t
        self.trouble.append(f"{role} lost at {t / 1e9:.3f} s: {reason}")

    def run(self, end: Callable[[], int | None], limit: int) -> int:
        """Run up to and including the tick [ns] that `end()` returns once known, at most to `limit`; return the last tick."""
        if not self._started:
            self.start()
        last = limit
        while self.t <= last:
            self.tick()
            decided = end()
            if decided is not None:
                last = min(decided, limit)
        return self.t - self._group.period

    def finish(self, *tapping: Service) -> dict[str, dict[str, Any]]:
        """Finish every service and those of the taps; return the facts of each.

        An error is a failure of its service, unless that failed before.
        """
        services = {role: stepper.service for role, stepper in self.steppers.items()} | {one.role: one for one in tapping}
        facts = {}
        for role, service in services.items():
            self._at[0] = list(self._roles).index(role)
            try:
                facts[role] = dict(service.finish())
            except (Exception, SystemExit) as error:
                if role in self.lost:
                    continue
                if self._roles[role].observer:
                    self._leave_out(role, self._at[1], f"{type(error).__name__}: {error}")
                else:
                    self._fail(self.steppers[role], self._at[1], error)
        return facts

    def run_hash(self) -> str:
        """Return the run hash."""
        return run_hash(self.digests())

    def digests(self) -> dict[str, str]:
        """Return the digest of each hashed topic."""
        return self._group.digests()
