"""Requirements of the contract on every implementation, checked over all messages that it sent during its suite."""

from itertools import pairwise

import numpy as np

from palpate.check.report import ConformanceReport
from palpate.check.rig import ReceivedMessage, Rig
from palpate_bus.contract import MS, Topic
from palpate_bus.contract.conformance import Checker

RATE_TOLERANCE = 0.2
"""Largest relative error of a live implementation's rate, over the whole check."""
STAMP_TOLERANCE_MS = 100.0
"""Largest median difference of stamps from the check's clock, in addition to the slack."""
MAX_LOST_SHARE = 0.05
"""Largest share of a live implementation's messages that may be lost in transport."""


def suite(rig: Rig, report: ConformanceReport) -> None:
    """Check topics, rates, stamps and values."""
    report.section("contract")
    for topic in rig.rules.outputs(rig.role.name):
        received = rig.log[topic.name]
        if not received:
            if topic.event:
                report.skip(f"{topic.name}", "an event topic without an event")
            else:
                report.expect(
                    f"{topic.name} is sent", False, "once" if topic.latched else f"every {topic.period_ms} ms", "nothing"
                )
            continue
        _values(topic, received, report)
        if topic.periodic:
            _rate(rig, topic, received, report)
            _stamps(rig, topic, received, report)
        _sequence(rig, topic, received, report)
    if rig.live:
        report.expect(
            "every message can be decoded", not rig.undecodable, "valid CDR", "; ".join(rig.undecodable[:3]) or "all valid"
        )


def _values(topic: Topic, received: list[ReceivedMessage], report: ConformanceReport) -> None:
    checker = Checker(topic)
    faults = [fault for item in received for fault in checker(item.message)]
    wanted = "frame, ranges and finite numbers as in its row"
    got = f"{len(received)} messages, all valid"
    if faults:
        first = faults[0]
        got = f"{len(faults)} faults, first: {first.field} is {first.got}, allowed {first.expected}"
    report.expect(f"{topic.name}: values", not faults, wanted, got)


def _rate(rig: Rig, topic: Topic, received: list[ReceivedMessage], report: ConformanceReport) -> None:
    """Check that every tick has its message; on a live bus, the mean rate by the sender's clock."""
    wanted = f"{1000 / topic.period_ms:g} Hz"
    if not rig.live:
        times = [item.t for item in received]
        due = list(range(0, rig.t, topic.period))
        report.expect(f"{topic.name}: rate", times == due, f"{len(due)} messages, one on each tick", f"{len(times)}")
        return
    seconds = (received[-1].sent - received[0].sent) / 1e9
    rate = (len(received) - 1) / seconds if seconds > 0 else 0.0
    off = abs(rate * topic.period_ms / 1000 - 1)
    longest = max((b.sent - a.sent for a, b in pairwise(received)), default=0) / MS
    report.expect(f"{topic.name}: rate", off < RATE_TOLERANCE, wanted, f"{rate:.4g} Hz, longest pause {longest:.0f} ms")


def _stamps(rig: Rig, topic: Topic, received: list[ReceivedMessage], report: ConformanceReport) -> None:
    checker = Checker(topic)
    stamps = [(item.t, stamp) for item in received if (stamp := checker.stamp(item.message)) is not None]
    if not stamps:
        return
    back = [(a, b) for (_, a), (_, b) in pairwise(stamps) if b < a]
    report.expect(
        f"{topic.name}: stamps rise",
        not back,
        "never backwards",
        f"{back[0][1]} after {back[0][0]} ns" if back else "as expected",
    )
    if rig.live:
        off = np.median([(t - stamp) / MS for t, stamp in stamps])
        ok = bool(abs(off) < STAMP_TOLERANCE_MS + rig.settings.slack_ms)
        report.expect(
            f"{topic.name}: stamps", ok, "time since the common start [ns]", f"median {off:.1f} ms behind this check's clock"
        )
    else:
        own_rate = rig.settings.scenario.robot.driver.emulated and topic.max_age_ms is not None  # 500 Hz, say
        age = topic.max_age if own_rate else 0
        wrong = [(t, stamp) for t, stamp in stamps if not t - age <= stamp <= t]
        expected = f"at most {age / MS:g} ms before the tick" if age else "the tick"
        got = f"{wrong[0][1]} at {wrong[0][0]} ns" if wrong else "as expected"
        report.expect(f"{topic.name}: stamps", not wrong, expected, got)


def _sequence(rig: Rig, topic: Topic, received: list[ReceivedMessage], report: ConformanceReport) -> None:
    steps = np.diff([item.sequence for item in received])
    jumps = int(np.sum(steps != 1))
    ok = bool(np.all(steps > 0)) and jumps <= (MAX_LOST_SHARE * len(steps) if rig.live else 0)
    got = f"{jumps} jumps among {len(received)}" if jumps else "without a gap"
    report.expect(f"{topic.name}: sequence", ok, "numbered 1, 2, 3, ... in the attachment", got)
