"""Readers of recordings: a run's folder, a rosbag2 folder with one or more MCAP files, or a single MCAP file."""

import heapq
import re
import shlex
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path, PurePath
from typing import NamedTuple

from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader

from palpate_bus.contract import Contract, Topic
from palpate_bus.mcap_records import BROKEN, RecordingError, open_file
from palpate_bus.messages import UNIX_NS
from palpate_bus.messages.typestore import CodecError, definition_hash
from palpate_bus.settings import KEPT_EVERY, RECORDING
from palpate_errors import UserError
from palpate_inputs import read_yaml

SCENARIO = "scenario.yaml"
"""Name of the attachment with the scenario of a reference recording."""


class RecordedMessage(NamedTuple):
    """One recorded message."""

    stamp: int
    """Time [ns] at which it was sent: simulated, or Unix time in recordings of other writers."""
    topic: str
    payload: bytes
    sequence: int


class RecordedType(NamedTuple):
    """Type of a recorded topic, as its writer described it."""

    name: str
    type_hash: str = ""
    """RIHS01 hash; empty if the writer stored none, as before ROS 2 Iron."""
    definition: str = ""
    """Text of the .msg file and of the types in it; empty if the writer stored none."""
    encoding: str = "cdr"

    def difference(self, topic: Topic) -> str:
        """Describe how the type differs from the contract's; empty if it does not. Without a hash the definition counts."""
        if self.encoding != "cdr":
            return f"in the encoding {self.encoding!r}, this installation reads 'cdr'"
        found = self.type_hash if self.type_hash.startswith("RIHS01_") else ""
        if self.name == topic.type and not found:
            if not self.definition:
                return ""
            try:
                found = definition_hash(self.name, self.definition)
            except CodecError as error:
                return f"with a definition that cannot be compared: {error}"
        if (self.name, found) == (topic.type, topic.type_hash):
            return ""
        return f"as {self.name} {found}".rstrip() + f", this installation has {topic.type} {topic.type_hash}"


@dataclass(frozen=True)
class Recording:
    """The files of a recording and their channels."""

    path: Path
    files: tuple[Path, ...]
    types: dict[str, RecordedType]
    """Message type by topic (without its leading slash); channels without a schema are left out."""
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
    unindexed: frozenset[Path] = frozenset()
    """Files without a usable index, which are read from beginning to end."""
    damage: tuple[str, ...] = ()
    """Texts of the damaged parts that were skipped."""

    def messages(self, topics: Collection[str], begin: int | None = None, end: int | None = None) -> Iterator[RecordedMessage]:
        """Yield messages of `topics` in order of their stamps, from `begin` to `end` [ns], both included.

        Raises RecordingError if a file is damaged.
        """
        names = [f"/{topic}" for topic in topics] + list(topics)  # other writers leave out the slash
        if not names:
            return
        with ExitStack() as stack:

            def read(file: Path) -> Iterator[RecordedMessage]:
                kind = NonSeekingReader if file in self.unindexed else make_reader
                reader = kind(stack.enter_context(open_file(file)), validate_crcs=True)
                for schema, channel, m in reader.iter_messages(topics=names, starting_at=begin, ending_at=end):
                    if schema is not None:
                        yield RecordedMessage(m.log_time, channel.topic.removeprefix("/"), m.data, m.sequence)

            each = [read(file) for file in self.files]
            try:
                yield from each[0] if len(each) == 1 else heapq.merge(*each, key=attrgetter("stamp"))
            except UserError as error:
                raise RecordingError(f"{self.path}: {error}") from error
            except BROKEN as error:
                broken = self.path if self.path.is_file() else self.files[0].parent
                raise RecordingError(f"{self.path}: is damaged; {_recover(broken)}") from error

    def origin(self, topics: Collection[str]) -> int:
        """Return the stamp [ns] at which the time of `topics` begins: 0 in simulated time, their first stamp in Unix time."""
        first = next(self.messages(topics), None)
        return 0 if first is None or first.stamp < UNIX_NS else first.stamp

    def check(self, contract: Contract, topics: Collection[str], *, whole: bool = True) -> None:
        """Raise RecordingError if a topic was recorded with another type or definition than the contract's.

        With `whole`, also if not every message of a topic was kept.
        """
        for name in topics:
            if whole and name in self.thinned:
                kept = f"only one message of topic {name} per {self.thinned[name]} ms was kept, but all are needed"
                raise RecordingError(f"{self.path}: {kept}; record with --record full")
            if name in self.types and (difference := self.types[name].difference(contract.topics[name])):
                advice = "record again, or replay with the version that recorded it"
                raise RecordingError(f"{self.path}: topic {name} was recorded {difference}; {advice}")


def _recover(path: Path) -> str:
    return f"run: python -m palpate_recorder.recover {shlex.quote(str(path))}"


def _convert(path: Path) -> str:
    path = path if path.name else path.resolve()
    source, target = shlex.quote(str(path)), shlex.quote(str(path.with_name(f"{path.stem}_mcap")))
    return f"run: rosbags-convert --src {source} --dst {target} --dst-storage mcap"


def _unreadable(file: Path, path: Path) -> RecordingError:
    """Return the error for a file that is not a complete MCAP file. `path`: its recording."""
    with open_file(file) as stream:
        head = stream.read(16)
    if not head:
        return RecordingError(f"{file}: is empty, so nothing was recorded")
    for begin, kind in ((b"SQLite format 3", "an SQLite bag"), (b"#ROSBAG", "a ROS 1 bag")):
        if head.startswith(begin):
            return RecordingError(f"{file}: is {kind}, expected MCAP; {_convert(path)}")
    if head.startswith(b"\x28\xb5\x2f\xfd"):
        remedy = _convert(path) if path != file else f"run: zstd -d {shlex.quote(str(file))}"
        return RecordingError(f"{file}: is compressed as a whole, expected MCAP; {remedy}")
    if not head.startswith(b"\x89MCAP"):
        return RecordingError(f"{file}: is not an MCAP file: it begins with {head[:8]!r}")
    return RecordingError(f"{file}: is unfinished: still being written, cut off, or its recorder was killed; {_recover(path)}")


def recorded_files(path: Path) -> tuple[Path, tuple[Path, ...]]:
    """Return the file or folder of a recording and its files."""
    if path.is_file():
        return path, (path,)
    folder = path / RECORDING if (path / RECORDING).is_dir() else path
    metadata = folder / "metadata.yaml"
    if metadata.is_file():
        return folder, _list_files(metadata)
    found = sorted(folder.glob("*.mcap")) or sorted(folder.glob("*.db3"))
    if not found:
        raise RecordingError(f"{path}: no recording there; give a run's folder, a rosbag2 folder or an .mcap file")
    if len(found) > 1:
        raise RecordingError(f"{folder}: has {len(found)} files but no metadata.yaml: it was not completed; {_recover(folder)}")
    return folder, tuple(found)


def _list_files(metadata: Path) -> tuple[Path, ...]:
    """Return the files that rosbag2's description of a recording lists."""
    try:
        info = read_yaml(metadata, RecordingError)["rosbag2_bagfile_information"]
        names = [PurePath(name) for name in info["relative_file_paths"]]
        files = tuple(metadata.parent / name for name in names)
        compression = str(info.get("compression_mode") or "").lower()
    except (RecordingError, LookupError, TypeError, AttributeError) as error:
        reason = str(error).partition("\n")[0]
        raise RecordingError(f"{metadata}: is not rosbag2's description ({reason}); give its .mcap file") from error
    if compression == "message":
        raise RecordingError(f"{metadata}: compression_mode = message, expected none or chunks; {_convert(metadata.parent)}")
    for name, file in zip(names, files, strict=True):
        if name.is_absolute() or ".." in name.parts or not file.is_file():
            raise RecordingError(f"{metadata}: lists {name}; expected files that are in its folder")
    if not files:
        raise RecordingError(f"{metadata}: lists no file")
    return files


@dataclass
class _Contents:
    """Contents of one file, by channel id."""

    schemas: dict[int, Schema]
    channels: dict[int, Channel]
    counts: dict[int, int]
    stamps: tuple[int, ...]
    """Earliest and latest stamp [ns]; empty without a message."""
    scenario: str | None
    indexed: bool


def _contents(file: Path) -> _Contents:
    """Return what a file has, by its summary, or read from beginning to end if that is missing or incomplete."""
    with open_file(file) as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        scenario = next((a.data.decode() for a in reader.iter_attachments() if a.name == SCENARIO), None)
        if summary is not None and (statistics := summary.statistics) is not None:
            known = all(channel.schema_id in (0, *summary.schemas) for channel in summary.channels.values())
            counts = statistics.channel_message_counts
            if known and counts.keys() <= summary.channels.keys() and sum(counts.values()) == statistics.message_count:
                stamps = (statistics.message_start_time, statistics.message_end_time) if statistics.message_count else ()
                return _Contents(summary.schemas, summary.channels, counts, stamps, scenario, indexed=True)
        stream.seek(0)
        found = _Contents({}, {}, Counter(), (), scenario, indexed=False)
        for record in StreamReader(stream).records:
            if isinstance(record, Schema):
                found.schemas[record.id] = record
            elif isinstance(record, Channel):
                found.channels[record.id] = record
            elif isinstance(record, Message):
                found.counts[record.channel_id] += 1
                found.stamps = (min((*found.stamps, record.log_time)), max((*found.stamps, record.log_time)))
        return found


def open_recording(path: Path) -> Recording:
    """Open a recording and read its metadata. Raises RecordingError."""
    where, files = recorded_files(path)
    types: dict[str, RecordedType] = {}
    counts: Counter[str] = Counter()
    thinned: dict[str, int] = {}
    stamps: list[int] = []
    scenario = None
    unindexed = set()
    for file in files:
        try:
            contents = _contents(file)
        except OSError as error:
            if not file.stat().st_size or error.filename is None:  # too short for its footer
                raise _unreadable(file, where) from error
            raise RecordingError(f"{file}: {error.strerror}") from error
        except UserError as error:
            raise RecordingError(f"{file}: {error}") from error
        except BROKEN as error:
            raise _unreadable(file, where) from error
        stamps += contents.stamps
        scenario = contents.scenario or scenario
        if not contents.indexed:
            unindexed.add(file)
        for channel in contents.channels.values():
            schema = contents.schemas.get(channel.schema_id)
            if schema is None:
                continue
            topic, kind = channel.topic.removeprefix("/"), recorded_type(channel, schema)
            earlier = types.get(topic, kind)
            if (earlier.name, earlier.encoding) != (kind.name, kind.encoding):
                kind = RecordedType(f"{earlier.name} ({earlier.encoding}) and {kind.name} ({kind.encoding})")
            types[topic] = kind
            if every := kept_every_ms(channel):
                thinned[topic] = every
            counts[topic] += contents.counts.get(channel.id, 0)
    if not stamps:
        raise RecordingError(f"{path}: holds no message")
    return Recording(path, files, types, dict(counts), thinned, min(stamps), max(stamps), scenario, frozenset(unindexed))


def kept_every_ms(channel: Channel) -> int:
    """Return the period in which one message of a channel was kept [ms]; 0 if all were, or if the text is not a number."""
    text = channel.metadata.get(KEPT_EVERY, "")
    return int(text) if re.fullmatch(r"[0-9]{1,9}", text) else 0


def recorded_type(channel: Channel, schema: Schema) -> RecordedType:
    """Return the type of a channel."""
    definition = schema.data.decode(errors="replace") if schema.encoding == "ros2msg" else ""
    package, _, name = schema.name.rpartition("/")  # some writers leave out msg
    full = schema.name if "/" in package else f"{package}/msg/{name}"
    return RecordedType(full, channel.metadata.get("topic_type_hash", ""), definition, channel.message_encoding)
