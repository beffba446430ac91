"""Why a service failed: its error, and which of its inputs break the contract, since then their producer is at fault."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from traceback import walk_tb
from typing import Any

from palpate_bus.contract.conformance import Checker
from palpate_bus.messages.codec import CodecError, Message
from palpate_bus.runtime.lockstep import InputBuffer, Packet
from palpate_plugins import USER_MODULE


def described(error: BaseException, buffers: Iterable[InputBuffer]) -> str:
    """An error as text, followed by each input that breaks its row of the contract and the role that sends it.

    Where a user's own file took part, its last line that did stands before the error.
    """
    words = [f"{_own_line(error)}{type(error).__name__}: {error}"]
    with suppress(Exception):  # whatever is wrong with an input must not hide the error
        words += invalid_inputs(buffers)
    return "; ".join(words)


def _own_line(error: BaseException) -> str:
    lines = [(frame.f_code.co_filename, line) for frame, line in walk_tb(error.__traceback__) if _is_own(frame.f_globals)]
    return f"{lines[-1][0]}, line {lines[-1][1]}: " if lines else ""


def _is_own(names: Mapping[str, Any]) -> bool:
    return str(names.get("__name__", "")).startswith(USER_MODULE)


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


def _wrong(buffer: InputBuffer, received: Packet) -> str:
    try:
        message: Message = received.message or buffer.decode(received.payload)
    except CodecError:
        return f"cannot be decoded ({len(received.payload)} bytes)"
    faults = Checker(buffer.topic)(message)
    return f"has {faults[0].field} {faults[0].got}, the contract wants {faults[0].expected}" if faults else ""
