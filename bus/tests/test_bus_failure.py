"""A failed service names the input at fault."""

from __future__ import annotations

import numpy as np

from palpate_bus.contract import Edge, contract
from palpate_bus.messages import JointState, codec
from palpate_bus.messages.stamps import header
from palpate_bus.runtime.failure import Failure, FailureCode
from palpate_bus.runtime.lockstep import ForgedSenderError, InputBuffer, Packet

ROW = contract().topics["joint_states"]
NAMES = [f"lbr_A{k}" for k in range(1, 8)]


def buffer(payload: bytes) -> InputBuffer:
    held = InputBuffer(ROW, Edge.SAME_TICK, contract().roles["robot"].period)
    held.deliver(Packet(payload, 0, 1))
    held.take(0)
    return held


def joints(position: np.ndarray) -> bytes:
    return codec.encode(JointState(header(0), NAMES, position, np.zeros(7), np.zeros(7)), ROW.type)


def test_valid_inputs_are_not_named() -> None:
    failure = Failure.of(ValueError("no"), "control", [buffer(joints(np.zeros(7)))])
    assert failure == Failure(FailureCode.ROLE_FAILED, "ValueError: no", ("control",))
    assert Failure.from_report("control", failure.report()) == failure


def test_an_input_that_is_not_finite_is_named_with_topic_and_sender() -> None:
    failure = Failure.of(IndexError("index -9"), "control", [buffer(joints(np.full(7, np.nan)))])
    assert failure.topics == ("joint_states",)
    assert failure.text.startswith("IndexError: index -9; joint_states from robot has position nan")


def test_an_input_that_cannot_be_decoded_is_named() -> None:
    failure = Failure.of(ValueError("no"), "control", [buffer(b"\x00\x01\x00\x00\xff")])
    assert failure.topics == ("joint_states",)


def test_some_errors_have_a_code_of_their_own() -> None:
    for error, code in (
        (ForgedSenderError("twice", "joint_states"), FailureCode.FORGED),
        (OSError(28, "No space left on device"), FailureCode.DISK_FULL),
    ):
        assert Failure.of(error, "control", ()).code is code
