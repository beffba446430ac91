"""One service again, in this process, against recorded inputs: the lockstep order of the run, no transport, no wall clock."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from palpate_bus.contract import Contract, Edge
from palpate_bus.recordings import RecordedMessage
from palpate_bus.runtime.lockstep import Packet, Stepper
from palpate_bus.service import Service


def rerun(
    service: Service, rules: Contract, inputs: Iterable[RecordedMessage], end: int, begin: int = 0
) -> Iterator[RecordedMessage]:
    """What `service` sends when it gets `inputs` (in order of their stamps), from its start to the tick `end` [ns].

    Its first step is at the tick `begin` [ns], where it gets all that came until then at once.

    At tick T it sees what it saw in the run: `same_tick` messages up to T, `previous` ones up to T less their topic's period. An
    observed topic is outside the barrier, so when a message of one was seen in a distributed run is not known; here it is seen
    on the tick after its stamp, as in a composed run. Raises LockstepError when the service breaks its contract.
    """
    stepper = Stepper(service, rules)
    late = {name for name, buffer in stepper.buffers.items() if buffer.edge is Edge.OBSERVE}
    for port, packet in stepper.start():
        yield RecordedMessage(0, port.topic.name, packet.payload, packet.sequence)
    source = iter(inputs)
    following = next(source, None)
    held: list[RecordedMessage] = []
    for t in range(begin, end + 1, stepper.role.period):
        for message in held:
            stepper.buffers[message.topic].deliver(Packet(message.payload, message.stamp, message.sequence))
        held.clear()
        while following is not None and following.stamp <= t:
            if following.topic in late and following.stamp == t:
                held.append(following)
            else:
                packet = Packet(following.payload, following.stamp, following.sequence)
                stepper.buffers[following.topic].deliver(packet)
            following = next(source, None)
        for port, packet in stepper.step(t):
            yield RecordedMessage(t, port.topic.name, packet.payload, packet.sequence)
