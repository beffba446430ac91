"""Why a service failed: its error, and which of its inputs break the contract, since then their producer is at fault."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress

from palpate_bus.contract.conformance import Checker
from palpate_bus.messages.codec import CodecError, Message
from palpate_bus.runtime.lockstep import InputBuffer, Received


def described(error: BaseException, buffers: Iterable[InputBuffer]) -> str:
    """An error as text, followed by each input that breaks its row of the contract and the role that sends it."""
    words = [f"{type(error).__name__}: {error}"]
    with suppress(Exception):  # whatever is wrong with an input must not hide the error
        words += invalid_inputs(buffers)
    return "; ".join(words)


def invalid_inputs(buffers: Iterable[InputBuffer]) -> list[str]:
    """A sentence for each topic whose newest messages cannot be decoded or have values that the contract does not allow."""
    found = []
    for buffer in buffers:
        for received in buffer.new or ([buffer.latest] if buffer.latest is not None else []):
            wrong = _wrong(buffer, received)
            if wrong:
                found.append(f"{buffer.topic.name} from {buffer.topic.producer} {wrong}")
                break
    return found


def _wrong(buffer: InputBuffer, received: Received) -> str:
    try:
        message: Message = received.message or buffer.decode(received.payload)
    except CodecError:
        return f"cannot be decoded ({len(received.payload)} bytes)"
    faults = Checker(buffer.topic)(message)
    return f"has {faults[0].field} {faults[0].got}, the contract wants {faults[0].expected}" if faults else ""
