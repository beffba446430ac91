"""Readers of recordings: a run's folder, a rosbag2 folder with one or more MCAP files, or a single MCAP file."""

from __future__ import annotations

import heapq
import struct
from collections.abc import Collection, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import yaml
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from zstandard import ZstdError

from palpate_bus.contract import Contract
from palpate_bus.settings import RECORDING
from palpate_errors import UserError

KEPT_EVERY = "kept_every_ms"
"""Metadata of a channel: period [ms] in which one message was kept."""
SCENARIO = "scenario.yaml"
"""Name of the attachment with the scenario of a reference recording."""


class RecordingError(UserError):
    """A recording that cannot be used. Names file, topic, what was found and what is needed."""


class RecordedMessage(NamedTuple):
    """One recorded message."""

    stamp: int
    """Simulated time [ns] of the tick that sent it."""
    topic: str
    payload: bytes
    sequence: int


@dataclass(frozen=True)
class Recording:
    """The files of a recording and their channels."""

    path: Path
    files: tuple[Path, ...]
    types: dict[str, tuple[str, str]]
    """Message type and RIHS01 hash by topic (without its leading slash)."""
    counts: dict[str, int]
    """Messages by topic."""
    thinned: dict[str, int]
    """Topics of which one message per period [ms] was kept."""
    first: int
    """Earliest stamp [ns]."""
    last: int
    """Latest stamp [ns]."""
    scenario: str | None
    """Scenario as YAML, if the file has one."""

    def messages(self, topics: Collection[str], begin: int | None = None, end: int | None = None) -> Iterator[RecordedMessage]:
        """Yield messages of `topics` in order of their stamps, from `begin` to `end` [ns], both included.

        Raises RecordingError if a file is truncated.
        """
        names = [f"/{topic}" for topic in topics]
        if not names:
            return
        with ExitStack() as stack:
            streams = [stack.enter_context(file.open("rb")) for file in self.files]
            readers = [make_reader(stream).iter_messages(topics=names, starting_at=begin, ending_at=end) for stream in streams]
            each = [
                (RecordedMessage(m.log_time, channel.topic[1:], m.data, m.sequence) for _, channel, m in reader)
                for reader in readers
            ]
            try:
                yield from each[0] if len(each) == 1 else heapq.merge(*each, key=attrgetter("stamp"))
            except (McapError, EOFError, struct.error, ZstdError) as error:
                raise RecordingError(f"{self.path}: truncated: {error!r}; {_RECOVER}") from error

    def check(self, rules: Contract, topics: Collection[str], *, whole: bool = True) -> None:
        """Raise RecordingError if a topic was recorded with another type or definition than the contract's.

        With `whole`, also if not every message of a topic was kept.
        """
        for name in topics:
            if whole and name in self.thinned:
                raise RecordingError(
                    f"{self.path}: only one message of topic {name} per {self.thinned[name]} ms was kept, but all are needed; "
                    "record with --record full"
                )
            row, recorded = rules.topics[name], self.types.get(name)
            if recorded is not None and recorded != (row.type, row.type_hash):
                raise RecordingError(
                    f"{self.path}: topic {name} was recorded as {recorded[0]} {recorded[1]}, "
                    f"this installation has {row.type} {row.type_hash}; record again, or replay with the version that recorded it"
                )


_RECOVER = "if its recorder was killed, first: python -m palpate_recorder.recover FOLDER"


def _files(path: Path) -> tuple[Path, ...]:
    if path.is_file():
        return (path,)
    folder = path / RECORDING if (path / RECORDING).is_dir() else path
    metadata = folder / "metadata.yaml"
    if metadata.is_file():
        info = yaml.safe_load(metadata.read_text(encoding="utf-8"))["rosbag2_bagfile_information"]
        return tuple(folder / name for name in info["relative_file_paths"])
    found = sorted(folder.glob("*.mcap")) if folder.is_dir() else []
    if not found:
        raise RecordingError(f"{path}: no recording there; give a run's folder, a rosbag2 folder or an .mcap file")
    raise RecordingError(f"{folder}: has no metadata.yaml, so it was not completed; {_RECOVER}")


def open_recording(path: Path) -> Recording:
    """Open a recording and read its metadata. Raises RecordingError."""
    files = _files(path)
    types: dict[str, tuple[str, str]] = {}
    counts: dict[str, int] = {}
    thinned: dict[str, int] = {}
    first: list[int] = []
    last: list[int] = []
    scenario = None
    for file in files:
        try:
            with file.open("rb") as stream:
                reader = make_reader(stream)
                summary = reader.get_summary()
                if summary is None or summary.statistics is None:
                    raise RecordingError(f"{file}: has no summary; {_RECOVER}")
                for attachment in reader.iter_attachments():
                    if attachment.name == SCENARIO:
                        scenario = attachment.data.decode()
        except (McapError, EOFError, struct.error, OSError) as error:
            raise RecordingError(f"{file}: cannot be read as MCAP: {error!r}; {_RECOVER}") from error
        if summary.statistics.message_count:
            first.append(summary.statistics.message_start_time)
            last.append(summary.statistics.message_end_time)
        for channel in summary.channels.values():
            topic = channel.topic.removeprefix("/")
            types[topic] = (summary.schemas[channel.schema_id].name, channel.metadata.get("topic_type_hash", ""))
            if every := int(channel.metadata.get(KEPT_EVERY, 0)):
                thinned[topic] = every
            counts[topic] = counts.get(topic, 0) + summary.statistics.channel_message_counts.get(channel.id, 0)
    if not first:
        raise RecordingError(f"{path}: holds no message")
    return Recording(path, files, types, counts, thinned, min(first), max(last), scenario)


BROKEN = (McapError, EOFError, RuntimeError, ValueError, ZstdError, struct.error)
"""Errors at the end of a truncated file: a short record, a chunk that does not decompress, a wrong checksum."""


def complete_records(path: Path) -> Iterator[object]:
    """Yield schemas, channels and messages of an MCAP file, up to its end or to where it is truncated. Raises OSError."""
    with path.open("rb") as stream, suppress(*BROKEN):
        yield from StreamReader(stream, validate_crcs=True).records
