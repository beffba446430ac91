"""Rate, silence and age of a periodic topic against its row, measured in the bus's own time.

A rate is the number of messages over the time that passed by their own stamps, so that a run at a third of real time has right
rates and a busy monitor does not misjudge; in wall-clock mode by their source times and the rate of the run. A topic is silent
when nothing came while the time of the bus, the median of all periodic topics' stamps, went on.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from statistics import median
from typing import NamedTuple

from palpate_bus.contract import MS, Topic
from palpate_bus.contract.conformance import ViolationKind as Kind
from palpate_bus.monitor.streams import Stream

RATE_TOLERANCE = 0.2
LEAST_OFF = 3
"""A rate is wrong when more than this many messages, and more than `RATE_TOLERANCE` of them, are missing or too many."""
SILENCE_NS = 100 * MS
"""Bus time that has to pass without a message before a topic counts as silent."""
GRACE_S = 0.5
"""After a first message, until its topic is judged by rate."""
AGES = 5
"""Looks whose median an age is."""
SLACK_MS = 100.0
"""Wall time [ms] that passes while a look takes its turn through the topics."""


class BusTime(NamedTuple):
    """How the bus's time moved over the window."""

    seconds: float
    """Wall time [s]."""
    passed: int
    """Bus time [ns]: in wall-clock mode the wall's at the rate of the run."""
    now: int | None
    """The newest [ns]; None while no stamped message came."""

    @property
    def progress(self) -> float | None:
        """Bus time per wall time, None while that is not known."""
        return self.passed / 1e9 / self.seconds if self.now is not None else None


class TimingProblem(NamedTuple):
    """What is wrong with the timing of a stream."""

    kind: Kind
    expected: str
    got: str


def bus_time(streams: Iterable[Stream], rate: float | None) -> BusTime:
    """The median over the streams of the periodic topics. `rate` as for `Monitor`."""
    moved, newest = [], []
    for stream in streams:
        passed = stream.passed()
        if passed.stamps is not None and passed.seconds >= GRACE_S:
            moved.append((passed.stamps, passed.seconds))
            newest.append(stream.stamp or 0)
    if not moved:
        return BusTime(0.0, 0, None)
    seconds = median(s for _, s in moved)
    progress = seconds * 1e9 * rate if rate else median(p for p, _ in moved)
    return BusTime(seconds, int(progress), int(median(newest)))


def problems(topic: Topic, stream: Stream, time: BusTime, rate: float | None, now: float) -> Iterator[TimingProblem]:
    """What is wrong with rate and age of a periodic topic's stream; `now` [s] is the clock by which it is marked."""
    own = stream.passed()
    if now - stream.began < GRACE_S or own.seconds < GRACE_S:
        return
    wanted = f"{1000 / topic.period_ms:g} {'Hz' if rate == 1.0 else 'Hz of simulated time'}"
    if not own.messages:
        if is_due(topic, time) and time.passed > SILENCE_NS:
            yield TimingProblem(Kind.SILENT, wanted, f"nothing for {own.seconds:.1f} s")
        return
    spent = own.sent * rate if rate else own.stamps
    if spent:
        off = abs(own.messages - spent / topic.period)
        if off > LEAST_OFF and off > RATE_TOLERANCE * spent / topic.period:
            unit = wanted.partition(" ")[2]
            yield TimingProblem(Kind.RATE, wanted, f"{own.messages * 1e9 / spent:.4g} {unit}")
    yield from _age(topic, stream, time, rate)


def is_due(topic: Topic, time: BusTime) -> bool:
    """Whether enough of the bus's time passed for several messages of a periodic topic."""
    return time.passed / topic.period > LEAST_OFF


def _age(topic: Topic, stream: Stream, time: BusTime, rate: float | None) -> Iterator[TimingProblem]:
    if topic.max_age_ms is None or len(stream.ages) < AGES:
        return
    if rate:
        age = median(stream.ages) * rate
        if age > topic.max_age_ms + topic.period_ms:
            yield TimingProblem(Kind.AGE, f"at most {topic.max_age_ms} ms", f"{age:.0f} ms")
    elif stream.stamp is not None and time.now is not None:
        behind = (time.now - stream.stamp) / MS - topic.period_ms
        if behind > topic.max_age_ms + SLACK_MS * max(time.progress or 0.0, 1.0):
            yield TimingProblem(Kind.AGE, f"at most {topic.max_age_ms} ms", f"{behind:.0f} ms behind the others")
