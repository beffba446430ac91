"""Re-runs one service in this process on recorded inputs, in the lockstep order of the run, without transport."""

from collections.abc import Iterable, Iterator

from palpate_bus.contract import Contract, Edge
from palpate_bus.recordings import RecordedMessage
from palpate_bus.runtime.lockstep import Packet, Stepper
from palpate_bus.service import Service


def rerun(
    service: Service, rules: Contract, inputs: Iterable[RecordedMessage], end: int, begin: int = 0
) -> Iterator[RecordedMessage]:
    """Yield the messages of `service` for `inputs` (ordered by stamp), from its start to the tick `end` [ns].

    The first step is at the tick `begin` [ns] and receives all earlier inputs.

    At tick T the service receives the same inputs as in the run: `same_tick` messages up to T, `previous` messages up to T minus
    the period of their topic. Observed topics are outside the barrier, so the tick at which a distributed run received a message
    of one is unknown; here it is the tick after its stamp, as in a composed run. Raises LockstepError if the service breaks its
    contract.
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
