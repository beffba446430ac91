"""A failed service names the input at fault."""

from __future__ import annotations

import numpy as np

from palpate_bus.contract import Edge, contract
from palpate_bus.messages import JointState, codec
from palpate_bus.messages.stamps import header
from palpate_bus.runtime.failure import described
from palpate_bus.runtime.lockstep import InputBuffer, Packet

ROW = contract().topics["joint_states"]
NAMES = [f"lbr_A{k}" for k in range(1, 8)]


def buffer(payload: bytes) -> InputBuffer:
    held = InputBuffer(ROW, Edge.SAME_TICK, contract().roles["robot"].period)
    held.deliver(Packet(payload, 0, 1))
    held.take(0)
    return held


def joints(position: np.ndarray) -> bytes:
    return codec.encode(JointState(header(0), NAMES, position, np.zeros(7), np.zeros(7)), ROW.type)


def test_what_keeps_to_the_contract_is_not_suspected() -> None:
    assert described(ValueError("no"), [buffer(joints(np.zeros(7)))]) == "ValueError: no"


def test_a_value_that_is_not_finite_is_named_with_topic_and_sender() -> None:
    words = described(IndexError("index -9"), [buffer(joints(np.full(7, np.nan)))])
    assert words.startswith("IndexError: index -9; joint_states from robot has position nan, the contract wants")


def test_bytes_that_are_no_message_are_named_too() -> None:
    words = described(ValueError("no"), [buffer(b"\x00\x01\x00\x00\xff")])
    assert words.endswith("joint_states from robot cannot be decoded (5 bytes)")
