"""Draws a run again from the recorder's MCAP file, without simulating it again.

python -m palpate_dashboard.replay DIR            # writes DIR/recording.rrd from DIR/recording_mcap and DIR/exam.yaml
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

from mcap.reader import make_reader
from palpate_bus import codec
from palpate_bus.codec import Message
from palpate_bus.contract import contract
from palpate_models.load import load_scenario

from palpate_dashboard.service import FILE, DashboardService
from palpate_dashboard.sinks import Live


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


def messages(path: Path) -> Iterator[tuple[int, str, bytes]]:
    """Time [ns], topic and payload of what the dashboard observes, in order of time. Raises OSError, McapError."""
    topics = [f"/{topic.name}" for topic, _ in contract().inputs("dashboard")]
    with path.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages(topics=topics):
            yield message.log_time, channel.topic.removeprefix("/"), message.data


def replay(recording: Path, service: DashboardService) -> None:
    """Steps `service` through the messages of an MCAP file, every period of its role, and finishes it."""
    period = contract().roles[service.role].period
    inbox = RecordedInbox()
    for tick, group in groupby(messages(recording), key=lambda item: -(-item[0] // period)):
        for stamp, topic, payload in group:
            inbox.put(topic, payload, stamp)
        service.step(tick * period, inbox)
    service.finish()


def main(folder: Path) -> Path:
    """Draws the run in `folder` again; returns the file. Raises FileNotFoundError naming what is missing."""
    recording = folder / "recording_mcap" / "recording_mcap_0.mcap"
    scenario = folder / "exam.yaml"
    for needed in (recording, scenario):
        if not needed.is_file():
            raise FileNotFoundError(f"{needed}: not there; give the folder of a run that was recorded")
    replay(recording, DashboardService(load_scenario(str(scenario)), folder / FILE, Live(), paced=False))
    return folder / FILE


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m palpate_dashboard.replay DIR")
    try:
        print(main(Path(sys.argv[1])))
    except (OSError, ValueError) as error:
        sys.exit(str(error))
