"""Suites: requirements on an implementation of each role, from the contract and the documentation of its messages.

Those of the contract on every implementation are here, checked over all messages that it sent during its suite.
"""

from importlib import import_module
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from palpate.check.rig import ConformanceReport, ReceivedMessage, Rig
from palpate_bus.contract import Topic
from palpate_bus.contract.port_check import Checker
from palpate_bus.messages import MS

SUITES = {
    "robot": 9.0, "tissue": 4.0, "control": 7.0, "planning": 2.0, "camera": 2.5, "perception": 4.5, "assessment": 31.0,
    "search": 7.5, "supervisor": 26.0,
}  # fmt: skip
"""Roles, each with a module of this package, and the duration of their suites [s] on the rig's clock with a conforming
implementation."""


def check(rig: Rig) -> ConformanceReport:
    """Run the suite of a rig's role, then the checks of the contract, and return the report."""
    import_module(f"palpate.check.suites.{rig.role.name}").suite(rig)
    _contract(rig)
    return rig.report


class LiveTolerances(NamedTuple):
    """Tolerances of topics of a live implementation."""

    rate: float = 0.2
    """Largest relative error of a live implementation's rate, over the whole check."""
    stamp_ms: float = 100.0
    """Largest median difference of stamps from the check's clock, in addition to the slack."""
    lost_share: float = 0.05
    """Largest share of a live implementation's messages that may be lost in transport."""


LIVE: Final = LiveTolerances()


def _contract(rig: Rig) -> None:
    """Check topics, rates, stamps and values."""
    rig.section("contract")
    for topic in rig.contract.outputs(rig.role.name):
        received = rig.log[topic.name]
        if not received:
            if topic.event:
                rig.skip(f"{topic.name}", "an event topic without an event")
            else:
                rig.arrives(f"{topic.name} is sent", received, "once" if topic.latched else f"every {topic.period_ms} ms")
            continue
        _values(rig, topic, received)
        if topic.periodic:
            _rate(rig, topic, received)
            _stamps(rig, topic, received)
        _sequence(rig, topic, received)
    if rig.live:
        rig.equal("every message can be decoded", rig.undecodable[:3], [])


def _values(rig: Rig, topic: Topic, received: list[ReceivedMessage]) -> None:
    checker = Checker(topic)
    faults = [fault for item in received for fault in checker(item.message)]
    wanted = "frame, ranges and finite numbers as in its row"
    got = f"{len(received)} messages, all valid"
    if faults:
        first = faults[0]
        got = f"{len(faults)} faults, first: {first.field} is {first.got}, allowed {first.expected}"
    rig.expect(f"{topic.name}: values", not faults, wanted, got)


def _rate(rig: Rig, topic: Topic, received: list[ReceivedMessage]) -> None:
    """Check that every tick has its message; on a live bus, the mean rate by the sender's clock."""
    wanted = f"{1000 / topic.period_ms:g} Hz"
    if not rig.live:
        times = [item.t for item in received]
        due = list(range(0, rig.t, topic.period))
        rig.expect(f"{topic.name}: rate", times == due, f"{len(due)} messages, one on each tick", f"{len(times)}")
        return
    seconds = (received[-1].sent - received[0].sent) / 1e9
    rate = (len(received) - 1) / seconds if seconds > 0 else 0.0
    off = abs(rate * topic.period_ms / 1000 - 1)
    longest = max((b.sent - a.sent for a, b in pairwise(received)), default=0) / MS
    rig.expect(f"{topic.name}: rate", off < LIVE.rate, wanted, f"{rate:.4g} Hz, longest pause {longest:.0f} ms")


def _stamps(rig: Rig, topic: Topic, received: list[ReceivedMessage]) -> None:
    checker = Checker(topic)
    stamps = [(item.t, stamp) for item in received if (stamp := checker.stamp(item.message)) is not None]
    if not stamps:
        return
    back = [(a, b) for (_, a), (_, b) in pairwise(stamps) if b < a]
    got = f"{back[0][1]} after {back[0][0]} ns" if back else None
    rig.expect(f"{topic.name}: stamps rise", not back, "never backwards", got)
    if rig.live:
        off = abs(np.median([(t - stamp) / MS for t, stamp in stamps]))
        rig.below(f"{topic.name}: stamps", off, LIVE.stamp_ms + rig.settings.slack_ms, "ms off this check's clock (median)")
    else:
        own_rate = rig.settings.scenario.robot.driver.emulated and topic.max_age_ms is not None  # 500 Hz, say
        age = topic.max_age if own_rate else 0
        wrong = [(t, stamp) for t, stamp in stamps if not t - age <= stamp <= t]
        expected = f"at most {age / MS:g} ms before the tick" if age else "the tick"
        got = f"{wrong[0][1]} at {wrong[0][0]} ns" if wrong else None
        rig.expect(f"{topic.name}: stamps", not wrong, expected, got)


def _sequence(rig: Rig, topic: Topic, received: list[ReceivedMessage]) -> None:
    steps = np.diff([item.sequence for item in received])
    jumps = int(np.sum(steps != 1))
    ok = bool(np.all(steps > 0)) and jumps <= (LIVE.lost_share * len(steps) if rig.live else 0)
    got = f"{jumps} jumps among {len(received)}" if jumps else "without a gap"
    rig.expect(f"{topic.name}: sequence", ok, "numbered 1, 2, 3, ... in the attachment", got)
