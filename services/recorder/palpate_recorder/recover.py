"""Repairs a recording that was truncated by a crash, or is damaged.

    python -m palpate_recorder.recover DIR/recording_mcap

writes `DIR/recording_mcap_recovered`, with all complete chunks of the broken files, an index and `metadata.yaml`; damaged
parts are listed, with status 1. It accepts recordings of other programs too, as a folder or a single file (its ROS 2 topics).
"""

import sys
from collections import Counter, deque
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

from mcap.records import Channel as ChannelRecord, Message, Schema

from palpate_bus.mcap_records import Gap, complete_records
from palpate_bus.messages import NS
from palpate_bus.recordings import RecordedMessage, RecordedType, Recording, kept_every_ms, recorded_type
from palpate_inputs import InputError, parse_yaml
from palpate_recorder.bag import BagWriter, Channel


def recover(path: Path) -> tuple[Path, tuple[str, ...]]:
    """Write the complete chunks of the recording `path` to the folder `<path>_recovered`; return that folder, and what is lost.

    Raises FileNotFoundError if there is no recording, ValueError if not even its first chunk is complete.
    """
    broken = _Broken(path)
    deque(broken.messages(), maxlen=0)  # the writer needs all channels first
    name = path.stem if path.is_file() else path.name
    bag = BagWriter(path.with_name(f"{name}_recovered"), broken.channels_read().values())
    for channel, message in broken.messages():
        bag.write(channel.topic, message.data, message.log_time, message.sequence)
    bag.close()
    return bag.folder, broken.damage


@dataclass(frozen=True)
class Salvaged(Recording):
    """The complete chunks of a truncated recording, in memory."""

    held: tuple[RecordedMessage, ...] = ()
    """Messages in order of their stamps."""

    def messages(self, topics: Collection[str], begin: int | None = None, end: int | None = None) -> Iterator[RecordedMessage]:
        """See `Recording.messages`."""
        wanted, first, last = frozenset(topics), begin or self.first, self.last if end is None else end
        return (message for message in self.held if message.topic in wanted and first <= message.stamp <= last)


def salvage(folder: Path, topics: Collection[str]) -> Salvaged:
    """Return the messages of some topics in the complete chunks of the recording `folder`.

    Raises FileNotFoundError if there is no recording, ValueError if none of the topics is in a complete chunk.
    """
    broken, wanted = _Broken(folder), frozenset(f"/{topic}" for topic in topics)
    found = [(channel.topic, record) for channel, record in broken.messages() if channel.topic in wanted]
    held = [RecordedMessage(record.log_time, topic[1:], record.data, record.sequence) for topic, record in found]
    channels = {name[1:]: channel for name, channel in broken.channels_read().items()}
    if not held:
        raise ValueError(f"{folder}: holds none of {', '.join(topics)}")
    held.sort(key=attrgetter("stamp"))
    types = {name: RecordedType(channel.type, channel.type_hash, channel.schema) for name, channel in channels.items()}
    thinned = {name: channel.kept_every_ms for name, channel in channels.items() if channel.kept_every_ms}
    counts = dict(Counter(message.topic for message in held))
    span, files = (held[0].stamp, held[-1].stamp), tuple(broken.files)
    return Salvaged(folder, files, types, counts, thinned, *span, scenario=None, held=tuple(held), damage=broken.damage)


class _Broken:
    """The files of a truncated recording, oldest first, and their channels."""

    def __init__(self, path: Path) -> None:
        """`path`: a folder or a file. Raises FileNotFoundError without one."""
        self.files = [path] if path.is_file() else sorted(path.glob("*.mcap"), key=_number)
        if not self.files:
            raise FileNotFoundError(f"{path}: no recording there; give an .mcap file, or the folder that holds it")
        self._channels: dict[str, Channel] = {}
        self.damage: tuple[str, ...] = ()
        """Texts of the damaged parts, after `messages`."""

    def channels_read(self) -> dict[str, Channel]:
        """Return the ROS 2 channels read so far, by topic: iterate over `messages` first. Raises ValueError if there are none."""
        if not self._channels:
            raise ValueError(f"{self.files[0]}: broken before the end of its first chunk, nothing to recover")
        return self._channels

    def messages(self) -> Iterator[tuple[Channel, Message]]:
        """Yield the complete ROS 2 messages with their channels, in file order."""
        damage = []
        for file in self.files:
            schemas: dict[int, Schema] = {}
            channels: dict[int, Channel] = {}
            reached = 0
            for record in complete_records(file):
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, ChannelRecord) and record.message_encoding == "cdr" and record.schema_id in schemas:
                    channel = _channel(record, schemas[record.schema_id])
                    channels[record.id] = self._channels.setdefault(channel.topic, channel)
                elif isinstance(record, Message) and record.channel_id in channels:
                    reached = max(reached, record.log_time)
                    yield channels[record.channel_id], record
                elif isinstance(record, Gap):
                    where = f"{file.name}, bytes {record.begin} to {record.begin + record.size}"
                    damage.append(f"{where}: damaged; what was recorded next after {reached / NS:.1f} s is lost")
        self.damage = tuple(damage)


def _number(path: Path) -> tuple[int, str]:
    """Return the number at the end of a file's name, by which long recordings are ordered."""
    number = path.stem.rpartition("_")[2]
    return (int(number) if number.isdecimal() else 0, path.name)


def _channel(record: ChannelRecord, schema: Schema) -> Channel:
    kind = recorded_type(record, schema)
    profile = _offered_qos(record)
    return Channel(
        topic=f"/{record.topic.removeprefix('/')}",
        type=kind.name,
        schema=kind.definition,
        type_hash=kind.type_hash,
        depth=depth if isinstance(depth := profile.get("depth"), int) else 1,
        transient_local=profile.get("durability") in ("transient_local", 1),  # 1: as before ROS 2 Jazzy
        kept_every_ms=kept_every_ms(record),
    )


def _offered_qos(record: ChannelRecord) -> dict[str, Any]:
    """Return the first quality of service that a channel was offered with; empty if that is not known."""
    with suppress(InputError, LookupError, TypeError, ValueError):
        return dict(parse_yaml(record.metadata.get("offered_qos_profiles", ""), record.topic)[0])
    return {}


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m palpate_recorder.recover FOLDER_OR_FILE")
    try:
        folder, damage = recover(Path(sys.argv[1]))
    except (OSError, ValueError) as error:
        sys.exit(str(error))
    print(folder)
    sys.exit("\n".join(damage) or None)
