"""The recorder as a service: it writes the raw messages of every topic that it reads by the contract.

It is an observer whose data does not come through the inbox: the runtime passes the bytes of each message to `record`, so that
no message is decoded or skipped.
"""

import logging
import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from palpate_bus.contract import Contract, Topic, contract
from palpate_bus.messages import codec
from palpate_bus.runs.run_folder import run_of
from palpate_bus.service import Inbox, Outbox, Service
from palpate_bus.settings import RECORDING, Settings
from palpate_models.scenario.schema import Scenario
from palpate_recorder.bag import SIZES, BagWriter, Channel

log = logging.getLogger(__name__)

SPARE_BYTES = 10_000_000
"""Free disk space at which the recording ends; report, page and map need it."""
CHECK_PERIOD_NS = 200_000_000
"""Period of the check of disk space, simulated time."""


def channels(rows: Contract, *, full: bool) -> list[Channel]:
    """Return the channels of all topics that the recorder reads, in contract order; with `full`, of every message."""
    return [
        Channel(
            topic=f"/{topic.name}",
            type=topic.type,
            schema=codec.definition(topic.type),
            type_hash=topic.type_hash,
            depth=rows.qos[topic.qos].depth,
            transient_local=rows.qos[topic.qos].transient_local,
            kept_every_ms=0 if full else topic.record_ms,
            open=topic.open,
        )
        for topic, _ in rows.inputs("recorder")
    ]


class RecorderService(Service):
    """Writes messages into `folder`, a rosbag2 folder."""

    role = "recorder"

    def __init__(self, folder: Path, file_bytes: int = SIZES.file_bytes, *, full: bool = True) -> None:
        """Open the recording, in files of about `file_bytes`, `full` or thinned by the contract's `record_ms`.

        Raises OSError if the folder cannot be written.
        """
        self._bag = BagWriter(folder, channels(contract(), full=full), run=run_of(folder.parent), file_bytes=file_bytes)
        self._names = {topic.name: f"/{topic.name}" for topic, _ in contract().inputs(self.role)}
        self._unexpected = self._unwritten = 0
        self._check_at = 0
        self.trouble = ""
        """Text on why the recording ended early; else empty."""

    def record(self, topic: Topic, payload: bytes, stamp: int, sequence: int) -> None:
        """Write a message: CDR bytes, simulated time [ns] and sequence number.

        The runtime calls it for every message, in any order of topics. Messages of topics that the recorder does not read are
        counted and dropped. A full disk ends the recording, not the run.
        """
        name = self._names.get(topic.name)
        if name is None:
            self._unexpected += 1
            return
        if not self.trouble and stamp >= self._check_at:
            self._check_at = stamp + CHECK_PERIOD_NS
            self._check_room(stamp)
        if self.trouble:
            self._unwritten += 1
            return
        try:
            self._bag.write(name, payload, stamp, sequence)
        except OSError as error:
            self._stop(stamp, f"it cannot be written: {error.strerror}")

    def _check_room(self, stamp: int) -> None:
        try:
            if (left := shutil.disk_usage(self._bag.folder).free) < SPARE_BYTES:
                self._stop(stamp, f"{left / 1e6:.0f} MB are left on its disk, which the report needs")
        except OSError as error:
            self._stop(stamp, f"its folder is lost: {error.strerror}")

    def _stop(self, stamp: int, reason: str) -> None:
        """Complete the recording."""
        self.trouble = f"recorder: the recording ends at {stamp / 1e9:.3f} s: {reason}"
        log.error("%s", self.trouble)
        with suppress(OSError):
            self._bag.close()

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Return no messages; the input comes by `record`."""
        return {}

    def finish(self) -> Mapping[str, Any]:
        """Complete the recording; return its counts."""
        if not self.trouble:
            try:
                self._bag.close()
            except OSError as error:
                self.trouble = f"recorder: the recording is not completed: {error.strerror}"
                log.error("%s", self.trouble)
        counts = self._bag.counts
        return {
            "folder": self._bag.folder.name,
            "files": len(self._bag.paths),
            "file_bytes": sum(path.stat().st_size for path in self._bag.paths if path.is_file()),
            "messages": sum(count.messages for count in counts.values()),
            "message_bytes": sum(count.bytes for count in counts.values()),
            "missing": {topic: count.missing for topic, count in counts.items() if count.missing},
            "unexpected": self._unexpected,
            "unwritten": self._unwritten,
            "trouble": self.trouble,
            "topics": {topic: count.messages for topic, count in counts.items()},
        }


def create(scenario: Scenario) -> RecorderService:
    """Return the recorder of a run; its folder and the size of its files come from the settings `out` and `record_file_mb`.

    Raises BusConfigError if the folder is missing. The scenario is not used.
    """
    del scenario
    settings = Settings.read()
    out = settings.require("out", f"the recorder writes to $PALPATE_OUT/{RECORDING}, so give it the run's folder")
    size = settings.record_file_mb
    return RecorderService(out / RECORDING, SIZES.file_bytes if size is None else size * 10**6, full=settings.record == "full")
