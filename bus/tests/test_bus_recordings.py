"""Recordings of other writers: what is read, what is ignored, and what is refused in one line."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from palpate_bus import mcap_records
from palpate_bus.contract import contract
from palpate_bus.mcap_records import Gap, RecordingError, complete_records
from palpate_bus.messages.typestore import definition, type_hash
from palpate_bus.recordings import open_recording
from palpate_errors import UserError

IMAGE, TOPIC = "sensor_msgs/msg/Image", "camera/depth/image_raw"
BARE = """std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
"""
"""The definition of an image without those of its nested types."""
UNIX = 1_700_000_000_000_000_000
NO_SUMMARY = {"use_statistics": False, "use_summary_offsets": False, "repeat_channels": False, "repeat_schemas": False}


class Described(NamedTuple):
    """A channel as a writer describes it."""

    name: str = IMAGE
    text: str = BARE
    type_hash: str | None = None
    schema: str = "ros2msg"
    encoding: str = "cdr"
    topic: str = f"/{TOPIC}"


def write(path: Path, *channels: Described | None, stamps: tuple[int, ...] = (UNIX, UNIX + 7), **options: Any) -> Path:
    """Write one message per stamp on each channel; None: a channel without a schema."""
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start("ros2", "other")
        for channel in channels:
            if channel is None:
                number = writer.register_channel("/events", "json", 0)
            else:
                schema = writer.register_schema(channel.name, channel.schema, channel.text.encode())
                metadata = {} if channel.type_hash is None else {"topic_type_hash": channel.type_hash}
                number = writer.register_channel(channel.topic, channel.encoding, schema, metadata)
            for stamp in stamps:
                writer.add_message(number, stamp, b"\0" * 64, stamp)
        writer.finish()
    return path


def types_checked(path: Path) -> None:
    open_recording(path).check(contract(), [TOPIC])


@pytest.mark.parametrize(
    "channel",
    [
        Described(),
        Described(text=definition(IMAGE)),
        Described(text=BARE.replace("\n", "\r\n")),
        Described(text="# An image\n\n" + BARE.replace("uint32 step", "uint32 step   # bytes per row")),
        Described(name="sensor_msgs/Image"),
        Described(text=""),
        Described(text="module sensor_msgs {};", schema="ros2idl"),
        Described(type_hash=""),
        Described(type_hash="INVALID"),
        Described(text="", type_hash=type_hash(IMAGE)),
        Described(topic=TOPIC),
    ],
)
def test_the_same_type_is_accepted(tmp_path: Path, channel: Described) -> None:
    types_checked(write(tmp_path / "a.mcap", channel))


@pytest.mark.parametrize(
    ("channel", "found"),
    [
        (Described(name="sensor_msgs/msg/CompressedImage"), "as sensor_msgs/msg/CompressedImage, this"),
        (Described(text=BARE.replace("uint32 width", "uint16 width")), "as sensor_msgs/msg/Image RIHS01_"),
        (Described(text=BARE.replace("width", "columns")), "RIHS01_"),
        (Described(text=BARE + "float32 exposure\n"), "RIHS01_"),
        (Described(text=definition(IMAGE).replace("string frame_id", "uint32 seq\nstring frame_id")), "RIHS01_"),
        (Described(type_hash="RIHS01_" + 64 * "0"), "RIHS01_00"),
        (Described(text="%PDF"), "cannot be parsed"),
        (Described(text=BARE.replace("std_msgs/Header", "other_msgs/Header")), "cannot be parsed"),
        (Described(encoding="json", schema="jsonschema", text="{}"), "in the encoding 'json'"),
        (Described(encoding="ros1", schema="ros1msg"), "in the encoding 'ros1'"),
    ],
)
def test_another_type_is_refused(tmp_path: Path, channel: Described, found: str) -> None:
    with pytest.raises(RecordingError, match=found) as refused:
        types_checked(write(tmp_path / "a.mcap", channel))
    assert TOPIC in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"use_chunking": False},
        {"index_types": IndexType.CHUNK},
        {"index_types": IndexType.NONE, **NO_SUMMARY},
        NO_SUMMARY,
        {"repeat_channels": False},
        {"repeat_schemas": False},
        {"use_statistics": False},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE, "chunk_size": 100},
    ],
)
def test_every_form_of_mcap_is_read(tmp_path: Path, options: dict[str, Any]) -> None:
    other = Described("std_msgs/msg/String", "string data", topic="/chatter")
    recording = open_recording(write(tmp_path / "a.mcap", None, other, Described(), **options))
    assert recording.types.keys() == {TOPIC, "chatter"}  # a channel without a schema is ignored
    assert recording.counts == {TOPIC: 2, "chatter": 2}
    assert (recording.first, recording.last) == (UNIX, UNIX + 7)
    assert [message.stamp for message in recording.messages([TOPIC, "events"])] == [UNIX, UNIX + 7]
    assert [message.stamp for message in recording.messages([TOPIC], begin=UNIX + 1)] == [UNIX + 7]


def test_time_begins_with_the_first_message_of_unix_time(tmp_path: Path) -> None:
    """Other topics do not count: they may have stamps of another clock."""
    path = write(tmp_path / "a.mcap", Described())
    assert open_recording(path).origin([TOPIC]) == UNIX
    assert open_recording(write(path, Described(), stamps=(3, 5))).origin([TOPIC]) == 0


def bag(folder: Path, files: list[str], storage: str = "mcap", mode: str = "") -> Path:
    """Write rosbag2's description of a recording."""
    folder.mkdir(exist_ok=True)
    lines = [f"  storage_identifier: {storage}", f"  compression_mode: {mode!r}", f"  relative_file_paths: {files}"]
    (folder / "metadata.yaml").write_text("\n".join(["rosbag2_bagfile_information:", "  version: 5", *lines]))
    return folder


def sqlite(path: Path) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"SQLite format 3\0" + bytes(99))
    return path


def sqlite_bag(folder: Path) -> Path:
    return bag(sqlite(folder / "bag" / "bag_0.db3").parent, ["bag_0.db3"], "sqlite3")


def cut(folder: Path) -> Path:
    whole = write(folder / "cut.mcap", Described(), stamps=tuple(range(400)), compression=CompressionType.NONE).read_bytes()
    (folder / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    return folder / "cut.mcap"


def cut_bag(folder: Path) -> Path:
    (folder / "bag").mkdir()
    return cut(folder / "bag").parent


def two_files(folder: Path) -> Path:
    return write(write(folder / "a_0.mcap", Described()).with_name("a_1.mcap"), Described()).parent


def file(content: bytes, folder: Path) -> Path:
    (folder / "a.mcap").write_bytes(content)
    return folder / "a.mcap"


ZSTD = zstandard.compress(bytes(99))


@pytest.mark.parametrize(
    ("make", "found"),
    [
        (sqlite_bag, r"bag_0\.db3: is an SQLite bag.*rosbags-convert --src \S+/bag --dst \S+/bag_mcap --dst-storage mcap"),
        (lambda folder: sqlite(folder / "a.db3"), r"SQLite bag.*--src \S+/a\.db3 --dst \S+/a_mcap"),
        (lambda folder: sqlite(folder / "bag" / "a.db3").parent, r"SQLite bag.*--src \S+/bag --dst"),
        (partial(file, b"#ROSBAG V2.0\n" + bytes(99)), "ROS 1 bag.*rosbags-convert"),
        (partial(file, ZSTD), "compressed as a whole.*zstd -d"),
        (lambda folder: bag(folder, [file(ZSTD, folder).name]), "compressed as a whole.*rosbags-convert"),
        (
            lambda folder: bag(folder, [write(folder / "a.mcap", Described()).name], mode="MESSAGE"),
            "compression_mode.*rosbags-conv",
        ),
        (cut, r"cut\.mcap: is unfinished.*palpate_recorder\.recover \S+/cut\.mcap"),
        (cut_bag, r"is unfinished.*palpate_recorder\.recover \S+/bag$"),
        (partial(file, b"\x89MCAP0\r\n"), r"is unfinished.*recover \S+a\.mcap"),
        (two_files, r"2 files but no metadata\.yaml.*palpate_recorder\.recover"),
        (partial(file, b""), "is empty"),
        (partial(file, b"time,depth\n0,1\n" + bytes(99)), r"is not an MCAP file: it begins with b'time,dep'"),
        (lambda folder: bag(folder, ["gone.mcap"]), "lists gone.mcap; expected files that are in its folder"),
        (lambda folder: bag(folder, []), "lists no file"),
        (lambda folder: folder / "nothing", "no recording there"),
    ],
)
def test_what_is_not_a_finished_mcap_file_is_refused_with_what_to_run(
    tmp_path: Path, make: Callable[[Path], Path], found: str
) -> None:
    with pytest.raises(UserError, match=found) as refused:
        open_recording(make(tmp_path))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "text", ["", "[]", "a: {", "rosbag2_bagfile_information:\n  version: 5\n", "rosbag2_bagfile_information: 3"]
)
def test_a_description_that_is_not_one_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "metadata.yaml").write_text(text)
    with pytest.raises(RecordingError, match=r"metadata\.yaml: is not rosbag2's description") as refused:
        open_recording(tmp_path)
    assert "\n" not in str(refused.value)


def test_a_folder_with_one_finished_file_needs_no_description(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", Described())
    assert open_recording(tmp_path).counts == {TOPIC: 2}


def test_two_types_on_a_topic_are_refused(tmp_path: Path) -> None:
    for other in (Described("sensor_msgs/msg/CompressedImage"), Described(encoding="json", schema="jsonschema")):
        with pytest.raises(RecordingError, match=r"as sensor_msgs/msg/Image \(cdr\) and "):
            types_checked(write(tmp_path / "a.mcap", Described(), other))


def test_damage_within_a_finished_file_is_reported_when_it_is_read(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", Described(), stamps=tuple(range(400)))
    content = bytearray(path.read_bytes())
    content[120:400] = bytes(280)
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"damaged; run: python -m palpate_recorder\.recover \S+a\.mcap"):
        list(open_recording(path).messages([TOPIC]))


def test_the_summary_of_a_damaged_file_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "a.mcap", Described(), stamps=tuple(range(4000)), chunk_size=4096, compression=CompressionType.NONE)
    content, read = bytearray(path.read_bytes()), []
    for at in (20_000, 60_000, 100_000):
        content[at] ^= 1
    path.write_bytes(content)
    monkeypatch.setattr(mcap_records, "make_reader", lambda file: read.append(file) or make_reader(file))
    assert sum(isinstance(record, Gap) for record in complete_records(path)) == 3
    assert len(read) == 1
