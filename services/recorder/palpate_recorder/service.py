"""The recorder as a service: it observes every topic of its rows in the contract and writes the raw messages.

It steps like any other observer, but its data does not come through the inbox: the runtime hands it each message's
bytes as they came, so that nothing is decoded and none is skipped.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from palpate_bus.contract import Contract, Topic, contract
from palpate_bus.messages import codec
from palpate_bus.runs.run_name import run_of
from palpate_bus.service import Inbox, Outbox, Service
from palpate_bus.settings import Settings
from palpate_models.scenario import Scenario
from palpate_recorder.bag import FILE_BYTES, BagWriter, Channel

FOLDER = "recording_mcap"
"""Name of the rosbag2 folder within the folder of the run."""


def channels(rows: Contract, *, full: bool) -> list[Channel]:
    """The channels of all topics that the contract lets the recorder observe, in contract order; `full`: of every message."""
    return [
        Channel(
            topic=f"/{topic.name}",
            type=topic.type,
            schema=codec.definition(topic.type),
            type_hash=topic.type_hash,
            depth=rows.qos[topic.qos].depth,
            transient_local=rows.qos[topic.qos].transient_local,
            kept_every_ms=0 if full else topic.record_ms,
        )
        for topic, _ in rows.inputs("recorder")
    ]


class RecorderService(Service):
    """Writes every message it is given into `folder`, a rosbag2 folder."""

    role = "recorder"

    def __init__(self, folder: Path, file_bytes: int = FILE_BYTES, *, full: bool = True) -> None:
        """Opens the recording, in files of about `file_bytes`, `full` or thinned as the contract's `record_ms` say.

        Raises OSError if the folder cannot be written.
        """
        self._bag = BagWriter(folder, channels(contract(), full=full), run=run_of(folder.parent), file_bytes=file_bytes)
        self._names = {topic.name: f"/{topic.name}" for topic, _ in contract().inputs(self.role)}
        self._unexpected = 0

    def record(self, topic: Topic, payload: bytes, stamp: int, sequence: int) -> None:
        """Takes one message as it was sent: CDR bytes, simulated time [ns] and sequence number.

        The runtime calls it for every message, in any order of topics. A topic that the contract does not give to the
        recorder is counted and left out.
        """
        name = self._names.get(topic.name)
        if name is None:
            self._unexpected += 1
            return
        self._bag.write(name, payload, stamp, sequence)

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Nothing to do: messages come by `record`, and are flushed by their own stamps."""
        return {}

    def finish(self) -> Mapping[str, Any]:
        """Completes the recording; returns what is in it."""
        self._bag.close()
        counts = self._bag.counts
        return {
            "folder": self._bag.folder.name,
            "files": len(self._bag.paths),
            "file_bytes": sum(path.stat().st_size for path in self._bag.paths),
            "messages": sum(count.messages for count in counts.values()),
            "message_bytes": sum(count.bytes for count in counts.values()),
            "missing": {topic: count.missing for topic, count in counts.items() if count.missing},
            "unexpected": self._unexpected,
            "topics": {topic: count.messages for topic, count in counts.items()},
        }


def create(scenario: Scenario) -> RecorderService:
    """The recorder of a run; its folder and the size of its files come from the settings `out` and `record_file_mb`.

    Raises BusConfigError if the folder is missing. The scenario does not matter: the recorder writes what the bus carries.
    """
    del scenario
    settings = Settings.read()
    out = settings.required("out", f"the recorder writes to $PALPATE_OUT/{FOLDER}, so give it the run's folder")
    size = settings.record_file_mb
    return RecorderService(out / FOLDER, FILE_BYTES if size is None else size * 1_000_000, full=settings.record == "full")
