"""Repairs a recording that was truncated by a crash.

    python -m palpate_recorder.recover DIR/recording_mcap

writes `DIR/recording_mcap_recovered`, with all complete chunks of the broken file, an index and `metadata.yaml`.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from itertools import count, takewhile
from operator import attrgetter
from pathlib import Path

import yaml
from mcap.records import Channel as ChannelRecord
from mcap.records import Message, Schema

from palpate_bus.recordings import KEPT_EVERY, RecordedMessage, Recording, complete_records
from palpate_recorder.bag import BagWriter, Channel


def recover(folder: Path) -> Path:
    """Write the complete chunks of the recording `folder` to `<folder>_recovered`; return that folder.

    Raises FileNotFoundError if `folder` holds no recording, ValueError if not even its first chunk is complete.
    """
    paths = _parts(folder)
    names = _channels(paths[0])
    if not names:
        raise ValueError(f"{paths[0]}: broken before the end of its first chunk, nothing to recover")
    bag = BagWriter(folder.with_name(f"{folder.name}_recovered"), names.values())
    for path in paths:  # every file has the same channels, registered in the same order
        for record in complete_records(path):
            if isinstance(record, Message):
                bag.write(names[record.channel_id].topic, record.data, record.log_time, record.sequence)
    bag.close()
    return bag.folder


@dataclass(frozen=True)
class Salvaged(Recording):
    """The complete chunks of a truncated recording, in memory."""

    held: tuple[RecordedMessage, ...] = ()
    """In order of their stamps."""

    def messages(self, topics: Collection[str], begin: int | None = None, end: int | None = None) -> Iterator[RecordedMessage]:
        """See `Recording.messages`."""
        wanted, first, last = frozenset(topics), begin or self.first, self.last if end is None else end
        return (message for message in self.held if message.topic in wanted and first <= message.stamp <= last)


def salvage(folder: Path, topics: Collection[str]) -> Salvaged:
    """Return the complete chunks of some topics of the recording `folder`. Raises as `recover`."""
    paths = _parts(folder)
    names = _channels(paths[0])
    if not names:
        raise ValueError(f"{paths[0]}: broken before the end of its first chunk, nothing to recover")
    wanted = {number: channel.topic[1:] for number, channel in names.items() if channel.topic[1:] in frozenset(topics)}
    records = (record for path in paths for record in complete_records(path) if isinstance(record, Message))
    held = [RecordedMessage(r.log_time, wanted[r.channel_id], r.data, r.sequence) for r in records if r.channel_id in wanted]
    if not held:
        raise ValueError(f"{folder}: holds none of {', '.join(topics)}")
    held.sort(key=attrgetter("stamp"))
    channels = {channel.topic[1:]: channel for channel in names.values()}
    return Salvaged(
        path=folder,
        files=tuple(paths),
        types={name: (channel.type, channel.type_hash) for name, channel in channels.items()},
        counts=dict(Counter(message.topic for message in held)),
        thinned={name: channel.kept_every_ms for name, channel in channels.items() if channel.kept_every_ms},
        first=held[0].stamp,
        last=held[-1].stamp,
        scenario=None,
        held=tuple(held),
    )


def _parts(folder: Path) -> list[Path]:
    """Return the files of a recording. Raises FileNotFoundError if there are none."""
    numbered = (folder / f"{folder.name}_{number}.mcap" for number in count())
    paths = list(takewhile(Path.is_file, numbered))
    if not paths:
        raise FileNotFoundError(f"{folder / folder.name}_0.mcap: no recording there; give the folder that holds the .mcap file")
    return paths


def _channels(path: Path) -> dict[int, Channel]:
    """Return the channels of a file by their ids; they precede its messages."""
    schemas: dict[int, Schema] = {}
    names: dict[int, Channel] = {}
    for record in complete_records(path):
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, ChannelRecord) and record.id not in names:
            names[record.id] = _channel(record, schemas[record.schema_id])
        elif isinstance(record, Message):
            break
    return names


def _channel(record: ChannelRecord, schema: Schema) -> Channel:
    qos = yaml.safe_load(record.metadata["offered_qos_profiles"])[0]
    return Channel(
        topic=record.topic,
        type=schema.name,
        schema=schema.data.decode(),
        type_hash=record.metadata["topic_type_hash"],
        depth=qos["depth"],
        transient_local=qos["durability"] == "transient_local",
        kept_every_ms=int(record.metadata.get(KEPT_EVERY, 0)),
    )


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m palpate_recorder.recover DIR/recording_mcap")
    try:
        print(recover(Path(sys.argv[1])))
    except (OSError, ValueError) as error:
        sys.exit(str(error))
