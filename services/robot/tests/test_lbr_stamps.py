"""What the driver's messages are stamped with."""

from __future__ import annotations

from lbr_bench import MS, Rig

from palpate_bus.messages.stamps import nanoseconds


def stamps(rig: Rig, ticks: int, topic: str) -> list[int]:
    """The age [ms] of each message of a topic by its own stamp, a tick a message."""
    found = []
    for _ in range(ticks):
        rig.tick(1)
        if topic in rig.outbox:
            found.append((rig.t - nanoseconds(rig.outbox[topic].header.stamp)) // MS)
    return found


def test_joint_states_carry_the_time_at_which_the_state_was_heard() -> None:
    rig = Rig(period_ms=5)
    rig.tick(101)
    assert stamps(rig, 10, "joint_states") == [1, 2, 3, 4, 0] * 2


def test_a_silent_arms_joint_states_grow_old_and_cease() -> None:
    rig = Rig()
    rig.tick(101)
    rig.port.silent = True
    ages = stamps(rig, 40, "joint_states")
    assert ages == list(range(1, 21)), "a reader sees how old they are, until they are none"


def test_wrenches_carry_the_time_of_the_reading() -> None:
    rig = Rig()
    rig.tick(101)
    rig.port.ft_silent = True
    assert stamps(rig, 70, "ft/wrench") == list(range(1, 21))
