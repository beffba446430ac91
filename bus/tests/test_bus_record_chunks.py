"""Chunks for the recorder."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate_bus.messages.codec import CodecError
from palpate_bus.runtime.output import CHUNK_PERIOD, ChunkMessage, ChunkWriter, unpack_chunk

TOPICS = ("joint_states", "ft/wrench")
messages = st.lists(
    st.builds(ChunkMessage, st.sampled_from(TOPICS), st.binary(max_size=300), st.integers(0, 2**40), st.integers(0, 2**32 - 1)),
    max_size=40,
)


@given(messages)
def test_what_goes_in_comes_out(sent: list[ChunkMessage]) -> None:
    spool = ChunkWriter("robot", TOPICS)
    for message in sent:
        spool.add(message.topic, message.payload, message.stamp, message.sequence)
    tick, received = unpack_chunk(spool.chunk(7))
    assert tick == 7
    assert list(received) == sent


def test_a_chunk_is_due_once_a_period() -> None:
    spool = ChunkWriter("robot", TOPICS)
    assert not spool.due(CHUNK_PERIOD - 1)
    assert spool.due(CHUNK_PERIOD)
    spool.chunk(CHUNK_PERIOD)
    assert not spool.due(CHUNK_PERIOD + 1)


def test_garbage_is_an_error_of_the_codec() -> None:
    with pytest.raises(CodecError):
        unpack_chunk(b"\x00\x01\x00\x00garbage")
