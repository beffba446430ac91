"""Draws a run again from the recorder's MCAP file, without simulating it again.

python -m palpate_dashboard.replay DIR            # writes DIR/recording.rrd from DIR/recording_mcap and DIR/scenario.yaml
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence, Set
from heapq import heappop, heappush
from itertools import groupby
from pathlib import Path

from mcap.reader import make_reader
from mcap.records import Channel
from mcap.records import Message as McapMessage

from palpate_bus.contract import contract
from palpate_bus.messages import codec
from palpate_bus.messages.codec import Message
from palpate_bus.recordings import BROKEN, complete_records
from palpate_bus.settings import RECORDING
from palpate_dashboard.service import FILE, DashboardService
from palpate_dashboard.sinks import Live
from palpate_models.scenario.load import load_scenario

DISORDER = 2_000_000_000
"""Messages in a recording are at most so far out of order [ns]."""


class RecordedInbox:
    """The inbox that the dashboard would have had: the latest message of each topic, decoded when looked at."""

    def __init__(self) -> None:
        self._types = {topic.name: topic.type for topic, _ in contract().inputs("dashboard")}
        self._payloads: dict[str, bytes] = {}
        self._messages: dict[str, Message] = {}
        self._stamps: dict[str, int] = {}

    def put(self, topic: str, payload: bytes, stamp: int) -> None:
        """Takes one message."""
        self._payloads[topic] = payload
        self._messages.pop(topic, None)
        self._stamps[topic] = stamp

    def latest(self, topic: str) -> Message | None:
        """The newest message, or None before the first."""
        if topic not in self._messages and topic in self._payloads:
            self._messages[topic] = codec.decode(self._payloads[topic], self._types[topic])
        return self._messages.get(topic)

    def new(self, topic: str) -> list[Message]:
        """The newest message alone: the dashboard wants no other."""
        message = self.latest(topic)
        return [] if message is None else [message]

    def stamp(self, topic: str) -> int | None:
        """The simulated time [ns] of the newest message."""
        return self._stamps.get(topic)

    def lost(self, role: str) -> bool:
        """Whether that role's service is gone; a recording does not say."""
        return False


def recording_of(folder: Path) -> tuple[Path, ...]:
    """The MCAP files of the run in `folder`, in order; empty when there are none. A long recording has several."""
    files = (folder / RECORDING).glob(f"{RECORDING}_*.mcap")
    return tuple(sorted(files, key=lambda path: int(path.stem.rpartition("_")[2])))


def end_of(files: Sequence[Path]) -> int | None:
    """The time of a recording's last message [ns]; None where its last file is not complete. Raises OSError."""
    with files[-1].open("rb") as stream:
        try:
            summary = make_reader(stream).get_summary()
        except BROKEN:
            return None
    return None if summary is None or summary.statistics is None else summary.statistics.message_end_time


def messages(files: Sequence[Path]) -> Iterator[tuple[int, str, bytes]]:
    """Time [ns], topic and payload of what the dashboard observes, in order of time: all that is complete in the files.

    The last one may still be written, or be cut off. Chunks of the services come as they were sent, so the order of time is
    restored within `DISORDER`. Raises OSError.
    """
    topics = {f"/{topic.name}" for topic, _ in contract().inputs("dashboard")}
    waiting: list[tuple[int, int, str, bytes]] = []
    for count, (name, record) in enumerate(_records(files, topics)):
        heappush(waiting, (record.log_time, count, name, record.data))
        while waiting[0][0] < record.log_time - DISORDER:
            time, _, topic, payload = heappop(waiting)
            yield time, topic, payload
    while waiting:
        time, _, topic, payload = heappop(waiting)
        yield time, topic, payload


def _records(files: Sequence[Path], topics: Set[str]) -> Iterator[tuple[str, McapMessage]]:
    for path in files:
        names: dict[int, str] = {}
        for record in complete_records(path):
            if isinstance(record, Channel) and record.topic in topics:
                names[record.id] = record.topic.removeprefix("/")
            elif isinstance(record, McapMessage) and record.channel_id in names:
                yield names[record.channel_id], record


def draw(source: Iterable[tuple[int, str, bytes]], service: DashboardService, tell: Callable[[int], None] | None = None) -> int:
    """Steps `service` through messages in order of time, every period of its role; returns the last time [ns], -1 if none.

    `tell` hears the simulated time [ns] that is reached.
    """
    period = contract().roles[service.role].period
    inbox = RecordedInbox()
    last = -1
    for tick, group in groupby(source, key=lambda item: -(-item[0] // period)):
        for stamp, topic, payload in group:
            inbox.put(topic, payload, stamp)
        last = tick * period
        service.step(last, inbox)
        if tell is not None:
            tell(last)
    return last


def replay(files: Sequence[Path], service: DashboardService, tell: Callable[[int], None] | None = None) -> None:
    """Steps `service` through the messages of a recording and finishes it. Raises OSError."""
    draw(messages(files), service, tell)
    service.finish()


def main(folder: Path, tell: Callable[[int], None] | None = None) -> Path:
    """Draws the run in `folder` again; returns the file. Raises FileNotFoundError naming what is missing."""
    files, scenario = recording_of(folder), folder / "scenario.yaml"
    if not files or not scenario.is_file():
        needed = scenario if files else folder / RECORDING
        raise FileNotFoundError(f"{needed}: not there; give the folder of a run that was recorded")
    target = folder / FILE
    try:
        replay(files, DashboardService(load_scenario(str(scenario)), target, Live(), paced=False), tell)
    except BaseException:
        target.unlink(missing_ok=True)  # half a drawing would be taken for the whole
        raise
    return target


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m palpate_dashboard.replay DIR")
    try:
        print(main(Path(sys.argv[1])))
    except (OSError, ValueError) as error:
        sys.exit(str(error))
