"""The services of one process, stepped in the contract's order: what one of them sends, the others hear at once.

A message is encoded once, since the run hash covers its bytes. Readers get the message itself where decoding would give back its
equal, and else the first that looks at it decodes it. Whoever drives a group, `composed` without any transport or `distributed`
between others, does so in the same order: by tick, then as the same_tick edges of the contract demand among all roles, not only
those of the group. So of all the steps that are still to be made anywhere, the first in this order has all its inputs, and groups
that wait for each other always go on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import gcd, lcm

from palpate_bus.contract import Contract
from palpate_bus.runtime.lockstep import OutputPort, Packet, Sent, Stepper
from palpate_bus.service import Service


class Group:
    """Services in one process, by role in `steppers`, in the order in which they step."""

    def __init__(self, services: Sequence[Service], rules: Contract, strict: bool = True) -> None:
        """`strict`: whether services are held to a message on every tick, see `Stepper`."""
        by_role = {service.role: service for service in services}
        order = [role for role in rules.step_order(tuple(rules.roles)) if role in by_role]
        order.sort(key=lambda role: rules.roles[role].observer)
        self.steppers = {role: Stepper(by_role[role], rules, strict) for role in order}
        self.period = gcd(*(stepper.role.period for stepper in self.steppers.values()))
        """Simulated time [ns] from one tick of the group to the next."""
        self._readers: dict[OutputPort, tuple[Callable[[Packet], None], ...]] = {
            port: tuple(stepper.buffers[name].deliver for stepper in self.steppers.values() if name in stepper.buffers)
            for sender in self.steppers.values()
            for name, port in sender.ports.items()
        }
        self._schedule = self._scheduled(frozenset())

    def _scheduled(self, without: frozenset[str]) -> tuple[tuple[Stepper, ...], ...]:
        """The services that step at each tick of one cycle; every cycle is the same."""
        steppers = [stepper for role, stepper in self.steppers.items() if role not in without]
        ticks = range(0, lcm(*(stepper.role.period for stepper in steppers)), self.period)
        return tuple(tuple(one for one in steppers if not t % one.role.period) for t in ticks)

    def due(self, t: int) -> tuple[Stepper, ...]:
        """The services that step at `t` [ns], a multiple of `period`, in order."""
        return self._schedule[t // self.period % len(self._schedule)]

    def leave_out(self, roles: frozenset[str]) -> None:
        """Steps the services of `roles` no more."""
        self._schedule = self._scheduled(roles)

    def deliver(self, sent: Sequence[Sent]) -> None:
        """Hands what was sent to its readers in the group."""
        for port, packet in sent:
            for deliver in self._readers[port]:
                deliver(packet)

    def digests(self) -> dict[str, str]:
        """Digest of each hashed topic that the group sends."""
        digests: dict[str, str] = {}
        for stepper in self.steppers.values():
            digests.update(stepper.digests())
        return digests
