"""Services of one process, stepped in the contract's order; messages between them are delivered at once.

A message is encoded once, since the run hash covers its bytes. Readers get the message itself, with copies of its arrays, if
decoding would give an equal one, else the first reader decodes it. `composed` (without transport) and `distributed` (between
other processes) drive a group in the same order: by tick, then by the same_tick edges of the contract among all roles, also
those outside the group. So the first of all pending steps in this order has all its inputs, and groups that wait for each
other do not deadlock.
"""

from collections.abc import Callable, Sequence
from math import gcd, lcm

from palpate_bus.contract import Contract
from palpate_bus.messages import codec
from palpate_bus.runtime.lockstep import Outgoing, OutputPort, Packet, Stepper
from palpate_bus.service import Service


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
