"""Writer of a rosbag2 folder with MCAP files, in bounded memory and without decoding.

Layout: rosbag2's `metadata.yaml` (version 9, ROS 2 Jazzy) next to `<folder>_0.mcap`, `<folder>_1.mcap` and so on, profile `ros2`,
message encoding `cdr`, schema encoding `ros2msg`; see MCAP's well-known profiles and rosbag2_storage's metadata.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import yaml
from mcap.writer import CompressionType, Writer

from palpate_bus.messages import MS
from palpate_bus.settings import KEPT_EVERY


class BagSizes(NamedTuple):
    """Sizes of chunks and files."""

    chunk_bytes: int = 4 * 1024 * 1024
    """Maximum size of a chunk, which bounds the memory."""
    flush_ns: int = 1_000_000_000
    """Simulated time after which a chunk goes to disk [ns]."""
    file_bytes: int = 1 << 30
    """Size at which a file is completed and the next one begun; a crash does not affect a completed file."""


SIZES: Final = BagSizes()

_INFINITE = {"sec": 9223372036, "nsec": 854775807}
"""RMW_DURATION_INFINITE, as rosbag2 writes it."""


class Channel(NamedTuple):
    """Description of a topic in the file."""

    topic: str
    """ROS 2 name, with its leading slash."""
    type: str
    """Message type, e.g. `sensor_msgs/msg/JointState`."""
    schema: str
    """Definition of the type and of all that it contains, in the ros2msg format."""
    type_hash: str
    """RIHS01 hash of the type."""
    depth: int = 1
    """Depth of the history offered."""
    transient_local: bool = False
    """True for latched topics."""
    kept_every_ms: int = 0
    """Period in which one message is kept; 0 keeps every message."""
    open: bool = False
    """True if it has several senders, each with its own sequence numbers."""

    @property
    def qos(self) -> list[dict[str, Any]]:
        """The offered QoS profile, as rosbag2 9 writes it."""
        return [
            {
                "history": "keep_last",
                "depth": self.depth,
                "reliability": "reliable",
                "durability": "transient_local" if self.transient_local else "volatile",
                "deadline": dict(_INFINITE),
                "lifespan": dict(_INFINITE),
                "liveliness": "automatic",
                "liveliness_lease_duration": dict(_INFINITE),
                "avoid_ros_namespace_conventions": False,
            }
        ]


@dataclass
class Count:
    """Counts of one channel."""

    messages: int = 0
    bytes: int = 0
    missing: int = 0
    """Missing messages, by the gaps in the sequence numbers."""
    last: int = field(default=0, repr=False)
    due: int = field(default=0, repr=False)
    """Stamp [ns] from which the next message is kept."""


@dataclass
class _File:
    """One MCAP file and the stamps [ns] in it."""

    path: Path
    messages: int = 0
    first: int | None = None
    last: int = 0

    def take(self, stamp: int) -> None:
        self.messages += 1
        self.first = stamp if self.first is None else min(self.first, stamp)
        self.last = max(self.last, stamp)


def _extent(*files: _File) -> dict[str, Any]:
    """Return rosbag2's description of the span of the messages in some files."""
    start, end = min((file.first for file in files if file.first is not None), default=0), max(file.last for file in files)
    span = {"starting_time": {"nanoseconds_since_epoch": start}, "duration": {"nanoseconds": end - start}}
    return {**span, "message_count": sum(file.messages for file in files)}


class BagWriter:
    """Writes CDR messages into a rosbag2 folder. An old recording in the folder is replaced.

    Messages are collected in a chunk, which goes to disk when it spans `SIZES.flush_ns` or has `SIZES.chunk_bytes`,
    so that a crash loses at most that span: an MCAP file is readable up to its last complete chunk.
    Not safe for use from several threads at once.
    """

    def __init__(
        self,
        folder: Path,
        channels: Iterable[Channel],
        *,
        run: str = "",
        file_bytes: int = SIZES.file_bytes,
        compression: CompressionType = CompressionType.ZSTD,
    ) -> None:
        """Open `folder` (created, parents included) for `channels` of the run called `run`.

        Raises OSError if it cannot be written.
        """
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self._run = run
        self.metadata_path = folder / "metadata.yaml"
        self.metadata_path.unlink(missing_ok=True)
        for old in folder.glob(f"{folder.name}_*.mcap"):
            old.unlink()
        self.channels = {channel.topic: channel for channel in channels}
        self.counts = {topic: Count() for topic in self.channels}
        self._files: list[_File] = []
        self._flush_at: int | None = None
        self._file_bytes = file_bytes
        self._compression = compression
        self._completed = False
        self._begin_file()

    @property
    def paths(self) -> tuple[Path, ...]:
        """The files, oldest first."""
        return tuple(file.path for file in self._files)

    def _begin_file(self) -> None:
        file = _File(self.folder / f"{self.folder.name}_{len(self._files)}.mcap")
        self._stream = file.path.open("wb")  # if this fails, the earlier files are the recording
        self._file = file
        self._files.append(file)
        self._writer = Writer(self._stream, chunk_size=SIZES.chunk_bytes, compression=self._compression)
        self._writer.start(profile="ros2", library="palpate-recorder")
        self._writer.add_metadata("palpate", {"run": self._run})
        self._ids = self._register()

    def _register(self) -> dict[str, int]:
        """Schemas and channels, all at the start, so that the first chunk has them."""
        schemas: dict[str, int] = {}
        ids: dict[str, int] = {}
        for channel in self.channels.values():
            if channel.type not in schemas:
                schemas[channel.type] = self._writer.register_schema(channel.type, "ros2msg", channel.schema.encode())
            profiles = yaml.safe_dump(channel.qos, sort_keys=False)
            metadata = {"offered_qos_profiles": profiles, "topic_type_hash": channel.type_hash}
            metadata |= {KEPT_EVERY: str(channel.kept_every_ms)} if channel.kept_every_ms else {}
            ids[channel.topic] = self._writer.register_channel(channel.topic, "cdr", schemas[channel.type], metadata)
        return ids

    def write(self, topic: str, payload: bytes | memoryview, stamp: int, sequence: int) -> None:
        """Append a message, stamped `stamp` [ns], unless its channel is not due. Raises KeyError for an unknown topic."""
        count = self.counts[topic]
        if sequence > count.last + 1 and not self.channels[topic].open:
            count.missing += sequence - count.last - 1
        count.last = sequence
        if stamp < count.due:
            return
        if every := self.channels[topic].kept_every_ms:
            count.due = stamp + every * MS
        self._writer.add_message(self._ids[topic], stamp, payload, stamp, sequence & 0xFFFFFFFF)
        count.messages += 1
        count.bytes += len(payload)
        self._file.take(stamp)
        if self._flush_at is None:
            self._flush_at = stamp + SIZES.flush_ns
        elif stamp >= self._flush_at:
            self._writer.flush()  # to the operating system, so that it survives a crash of this process
            self._flush_at = stamp + SIZES.flush_ns
            if self._stream.tell() >= self._file_bytes:
                self._end_file()
                self._begin_file()

    def _end_file(self) -> None:
        self._writer.finish()
        self._stream.close()

    def close(self) -> None:
        """Complete the file with its index and write `metadata.yaml`. A second call does nothing."""
        if self._completed:
            return
        metadata = self.metadata()
        if not self._stream.closed:
            self._writer.add_metadata("rosbag2", {"serialized_metadata": yaml.safe_dump(metadata, sort_keys=False)})
            self._end_file()
        text = yaml.safe_dump({"rosbag2_bagfile_information": metadata}, sort_keys=False)
        temporary = self.metadata_path.with_suffix(".yaml.part")
        temporary.write_text(text, encoding="utf-8")
        temporary.replace(self.metadata_path)
        self._completed = True

    def metadata(self) -> dict[str, Any]:
        """Return rosbag2's description of the recording."""
        return {
            "version": 9,
            "storage_identifier": "mcap",
            "relative_file_paths": [file.path.name for file in self._files],
            **_extent(*self._files),
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": channel.topic,
                        "type": channel.type,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": channel.qos,
                        "type_description_hash": channel.type_hash,
                    },
                    "message_count": self.counts[channel.topic].messages,
                }
                for channel in self.channels.values()
            ],
            "compression_format": "",
            "compression_mode": "",
            "files": [{"path": file.path.name, **_extent(file)} for file in self._files],
            "custom_data": {"run": self._run},
            "ros_distro": "jazzy",
        }
