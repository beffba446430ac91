"""What the contract's monitor costs its own process: time a message that it hears, and a look at all topics."""

from __future__ import annotations

from timeit import repeat

import numpy as np

from palpate_bus.contract import contract
from palpate_bus.messages import JointState, codec
from palpate_bus.messages.stamps import header
from palpate_bus.monitor.monitor import Monitor

MESSAGES = 2000
REPEATS = 5
GID = bytes(16)


def measure() -> dict[str, float]:
    """Microseconds a joint state heard and checked, and a look; the part of a core that all periodic topics take."""
    rules = contract()
    monitor = Monitor(rules)
    names = [f"lbr_A{i}" for i in range(1, 8)]
    payloads = [
        codec.encode(JointState(header(t * 1_000_000), names, *[np.zeros(7)] * 3), "sensor_msgs/msg/JointState")
        for t in range(MESSAGES)
    ]
    sequence = 0

    def hear() -> None:
        nonlocal sequence
        for payload in payloads:
            sequence += 1
            monitor.hear("joint_states", sequence * 1_000_000, sequence, GID, payload, sequence / 1000)

    hear_us = min(repeat(hear, number=1, repeat=REPEATS)) / MESSAGES * 1e6
    look_us = min(repeat(lambda: monitor.look(sequence / 1000, sequence * 1_000_000), number=20, repeat=REPEATS)) / 20 * 1e6
    a_second = sum(1000 / topic.period_ms for topic in rules.topics.values() if topic.periodic)
    return {"hear_us": hear_us, "look_us": look_us, "part_of_a_core": a_second * hear_us / 1e6}
