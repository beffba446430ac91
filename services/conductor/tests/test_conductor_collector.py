"""What the conductor keeps of a run: all of it, in little memory."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from typing import Any

import pytest

from palpate_bus.contract import contract
from palpate_bus.messages import IndentationTruth, Point, codec
from palpate_bus.messages.stamps import header
from palpate_conductor.collector import KeptMessages

TOPIC = "truth/indentation"


def contact(k: int) -> IndentationTruth:
    return IndentationTruth(header(k * 10_000_000, "world"), 0.01 * k, 1 / (k + 1), 0.5, 2.5, 20, Point(0.1 * k, 0.2, 0.7), 6.8e5)


def test_messages_come_back_as_they_were() -> None:
    messages, kept = [contact(k) for k in range(5)], KeptMessages(TOPIC)
    with pytest.raises(IndexError):
        kept[-1]
    kept.extend(messages[:3])
    kept.extend(messages[3:])
    assert len(kept) == 5
    assert list(kept) == list(kept) == messages
    assert (kept[1], kept[-1], kept[::2]) == (messages[1], messages[-1], messages[::2])


def test_they_take_less_than_a_quarter_of_the_memory() -> None:
    kind = contract().topics[TOPIC].type
    payloads = [codec.encode(contact(k), kind) for k in range(1000)]

    def taken(keep: Callable[[Any], None]) -> int:
        tracemalloc.start()
        try:
            for payload in payloads:
                keep([codec.decode(payload, kind)])
            return tracemalloc.get_traced_memory()[0]
        finally:
            tracemalloc.stop()

    decoded: list[Any] = []
    assert taken(KeptMessages(TOPIC).extend) < taken(decoded.extend) / 4
