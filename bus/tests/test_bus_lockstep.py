"""Conservative synchronisation without transport: what a reader may see, and when."""

import random
from typing import Any

import pytest
from hypothesis import given, strategies as st
from toy_services import TOYS

from palpate_bus.contract import Edge, contract
from palpate_bus.messages import MS
from palpate_bus.runtime.lockstep import InputBuffer, LockstepError, Stepper

TOPICS = contract().topics


def buffer(topic: str, edge: Edge) -> InputBuffer:
    row = TOPICS[topic]
    return InputBuffer(row, edge, contract().roles[row.producer].period)


def first_ready(tested: InputBuffer, t: int) -> int:
    """Return the earliest tick [ns] of the producer at which the reader may step at `t`."""
    for tick in (-1, *range(0, t + MS, MS)):
        tested.advanced = tick
        if tested.ready(t):
            return tick
    raise AssertionError(f"never ready for {t} ns")


def test_same_tick_needs_the_producers_tick_and_previous_the_one_before() -> None:
    assert first_ready(buffer("joint_states", Edge.SAME_TICK), 7 * MS) == 7 * MS
    assert first_ready(buffer("control/joint_torque", Edge.PREVIOUS), 7 * MS) == 6 * MS
    assert first_ready(buffer("control/joint_torque", Edge.PREVIOUS), 0) < 0


def test_a_slow_producer_has_its_whole_period_to_compute() -> None:
    setpoint = buffer("planning/setpoint", Edge.PREVIOUS)
    assert [first_ready(setpoint, t * MS) // MS for t in (10, 15, 19, 20, 29)] == [0, 0, 0, 10, 10]


def test_messages_become_visible_after_their_delay() -> None:
    torque = buffer("control/joint_torque", Edge.PREVIOUS)
    for sequence in range(1, 5):
        torque.accept(sequence, b"")
    torque.take(2 * MS)
    assert [received.stamp for received in torque.new] == [0, MS]
    torque.take(3 * MS)
    assert [received.stamp for received in torque.new] == [2 * MS]


@pytest.mark.parametrize(
    ("sequences", "text"),
    [([2], "messages 1..1 of robot are missing"), ([5], "messages 1..4 of robot are missing"), ([1, 1], "duplicate")],
)
def test_a_gap_or_a_repetition_is_an_error_that_names_the_topic(sequences: list[int], text: str) -> None:
    joints = buffer("joint_states", Edge.SAME_TICK)
    with pytest.raises(LockstepError, match=f"joint_states: .*{text}"):
        for sequence in sequences:
            joints.accept(sequence, b"")


@given(counts=st.lists(st.integers(0, 3), min_size=1, max_size=12), order=st.randoms(use_true_random=False))
def test_event_topics_read_the_same_whatever_order_data_and_advances_arrive_in(counts: list[int], order: random.Random) -> None:
    period = 100 * MS
    sent = [(tick * period, sequence) for tick, count in enumerate(counts) for sequence in range(count)]
    stamps = [stamp for stamp, _ in sent]
    data = [("data", sequence + 1) for sequence in range(len(sent))]
    advances = [("advance", tick * period, sum(counts[: tick + 1])) for tick in range(len(counts))]
    merged: list[tuple[object, ...]] = []
    while data or advances:  # each stream is in order; how they interleave is not known
        merged.append((data if data and (not advances or order.random() < 0.5) else advances).pop(0))
    images = buffer("camera/depth/image_raw", Edge.PREVIOUS)
    for event in merged:
        if event[0] == "data":
            images.accept(int(str(event[1])), b"")
        else:
            images.advance(int(str(event[1])), int(str(event[2])))
    assert images.advanced == (len(counts) - 1) * period
    images.take(len(counts) * period)
    assert [received.stamp for received in images.new] == stamps


def test_event_topic_is_not_ready_before_its_messages_are_here() -> None:
    images = buffer("camera/depth/image_raw", Edge.PREVIOUS)
    images.advance(0, 1)
    assert not images.ready(100 * MS)
    assert images.waits_for_data
    images.accept(1, b"")
    assert images.ready(100 * MS)


def test_a_lost_producer_blocks_no_reader() -> None:
    joints = buffer("joint_states", Edge.SAME_TICK)
    joints.lost = True
    assert joints.ready(5 * MS)


@pytest.mark.parametrize(
    ("role", "change", "said"),
    [
        ("robot", lambda t, out: {k: v for k, v in out.items() if k != "ft/wrench"}, "robot sent no ft/wrench at 0 ns"),
        ("camera", lambda t, out: {"ft/wrench": None}, "camera sent ft/wrench"),
        ("robot", lambda t, out: {**out, "robot/status": None} if t else out, "not a multiple of its period"),
    ],
)
def test_an_outbox_that_breaks_the_contract_is_named(role: str, change: Any, said: str) -> None:
    toy = TOYS[role]()
    step = toy.step
    toy.step = lambda t, inbox: change(t, dict(step(t, inbox)))  # type: ignore[method-assign]
    stepper = Stepper(toy, contract())
    with pytest.raises(LockstepError, match=said):
        [stepper.step(t) for t in (0, MS)]


@pytest.mark.parametrize("returned", [None, [None], "ft/wrench", 3, iter(())])
def test_what_is_no_outbox_is_named(returned: object) -> None:
    for method, call in (("step", lambda stepper: stepper.step(0)), ("start", lambda stepper: stepper.start())):
        toy = TOYS["robot"]()
        setattr(toy, method, lambda *_: returned)
        with pytest.raises(LockstepError, match=f"robot returned {type(returned).__name__}; expected an outbox"):
            call(Stepper(toy, contract()))


def test_latched_topics_are_due_at_start() -> None:
    toy = TOYS["robot"]()
    toy.start = dict  # type: ignore[method-assign, assignment]
    with pytest.raises(LockstepError, match="did not send its latched robot_description"):
        Stepper(toy, contract()).start()
