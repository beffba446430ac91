"""The recording as others read it: rosbags' Reader, the mcap library with its ROS 2 decoder, and after a crash."""

import errno
import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap.records import Message, Schema
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader

from palpate_bus.contract import contract
from palpate_bus.mcap_records import Gap, RecordingError, complete_records
from palpate_bus.messages import MS, JointState, codec, header
from palpate_bus.messages.geometry import mesh_message
from palpate_bus.recordings import open_recording
from palpate_bus.settings import RECORDING
from palpate_models.scenario.schema import Scenario
from palpate_recorder.recover import recover, salvage
from palpate_recorder.service import RecorderService, channels, create

NAMES = [f"lbr_A{i}" for i in range(1, 8)]
TOPICS = contract().topics


def joint_states(t: int) -> bytes:
    position = np.full(7, t / 1e9)
    return codec.encode(JointState(header(t), NAMES, position, position + 1, position + 2), "sensor_msgs/msg/JointState")


def surface(t: int) -> bytes:
    vertices = np.random.default_rng(t).random(9000, dtype=np.float32)  # does not compress
    vertices[0] = t / 1e9
    mesh = mesh_message(header(t, "world"), vertices.reshape(-1, 3), triangles=np.arange(18000) % 3000)
    return codec.encode(mesh, "palpation_msgs/msg/SurfaceMesh")


@pytest.fixture
def service(tmp_path: Path) -> RecorderService:
    return RecorderService(tmp_path / RECORDING)


def put(service: RecorderService, i: int) -> None:
    service.record(TOPICS["joint_states"], joint_states(i * MS), i * MS, i)


def record(service: RecorderService, milliseconds: int) -> None:
    for i in range(milliseconds):
        put(service, i)
        if i % 50 == 0:
            service.record(TOPICS["sim/surface"], surface(i * MS), i * MS, i // 50)


def rows(folder: Path, topic: str = "/joint_states") -> list[tuple[int, bytes]]:
    """Return stamps and payloads of a topic, as rosbags reads them."""
    with Reader(folder) as reader:
        read = [(c.topic, stamp, bytes(data)) for c, stamp, data in reader.messages()]
        assert len(read) == reader.message_count
    return [(stamp, data) for name, stamp, data in read if name == topic]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of 3.9 s."""
    folder = tmp_path_factory.mktemp("whole") / RECORDING
    service = RecorderService(folder)
    record(service, 3900)
    service.finish()
    return folder


def test_every_schema_of_the_contract_parses() -> None:
    """The ROS 2 decoder builds a decoder from the schema text alone, for each observed topic."""
    for channel in channels(contract(), full=True):
        schema = Schema(id=1, name=channel.type, encoding="ros2msg", data=channel.schema.encode())
        assert DecoderFactory().decoder_for("cdr", schema) is not None, channel.topic


def kill(service_folder: Path, to: Path, share: float = 1.0) -> Path:
    """A copy of what the disk holds of an unfinished recording when its process is killed, cut to `share` of it."""
    to.mkdir()
    data = (service_folder / f"{service_folder.name}_0.mcap").read_bytes()
    (to / f"{to.name}_0.mcap").write_bytes(data[: int(len(data) * share)])
    return to


def test_a_crash_loses_at_most_the_last_simulated_second(tmp_path: Path) -> None:
    record(RecorderService(tmp_path / RECORDING, file_bytes=300_000), 2900)  # its process dies here
    shutil.copytree(tmp_path / RECORDING, tmp_path / "crashed")
    stamps = [stamp for stamp, _ in rows(recover(tmp_path / "crashed")[0])]
    assert stamps == [i * MS for i in range(len(stamps))]
    assert len(stamps) >= 1900


def test_a_file_cut_anywhere_is_recovered_up_to_there(whole: Path, tmp_path: Path) -> None:
    counts = [len(rows(recover(kill(whole, tmp_path / f"cut_{share}", share))[0])) for share in (0.3, 0.7, 1.0)]
    assert 0 < counts[0] < counts[1] < counts[2] == 3900


@pytest.mark.parametrize("share", [0.0001, 0.33, 0.62])
def test_reading_continues_after_a_damaged_part(whole: Path, tmp_path: Path, share: float) -> None:
    spoiled = kill(whole, tmp_path / "spoiled")
    file = spoiled / "spoiled_0.mcap"
    sound = list(complete_records(file))
    data = bytearray(file.read_bytes())
    at = int(len(data) * share)
    data[at : at + 2000] = b"\xa5" * 2000
    file.write_bytes(data)
    left = list(complete_records(file))
    gaps = [record for record in left if isinstance(record, Gap)]
    assert len(sound) // 2 < sum(isinstance(record, Message) for record in left) < len(sound)
    assert sum(gap.begin < at + 2000 and gap.begin + gap.size > at for gap in gaps) == len(gaps) in (1, 2)
    assert len(recover(spoiled)[1]) == len(gaps)


def test_salvage_returns_what_recover_writes(whole: Path, tmp_path: Path) -> None:
    crashed = kill(whole, tmp_path / "crashed", 0.7)
    before = sorted(tmp_path.rglob("*"))
    topics = ["joint_states", "sim/surface"]
    salvaged = salvage(crashed, topics)
    assert sorted(tmp_path.rglob("*")) == before
    recovered = open_recording(recover(crashed)[0])
    assert salvaged.types == recovered.types
    for chosen in ((topics,), (topics[:1], 5 * MS, 7 * MS)):
        assert list(salvaged.messages(*chosen)) == list(recovered.messages(*chosen))
    with pytest.raises(ValueError, match="holds none of exam/state"):
        salvage(crashed, ["exam/state"])


@pytest.mark.parametrize("as_folder", [False, True])
def test_the_file_of_another_writer_is_recovered(tmp_path: Path, as_folder: bool) -> None:
    """It has no type hash, qualities of service as ROS 2 Humble writes them or none, and channels that are not of ROS 2."""
    path = tmp_path / "camera" / "camera_0.mcap"
    path.parent.mkdir()
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE, chunk_size=1000)
        writer.start("ros2", "other")
        events = writer.register_channel("/events", "json", 0)
        kind = writer.register_schema("tf2_msgs/TFMessage", "ros2msg", codec.definition("tf2_msgs/msg/TFMessage").encode())
        latched = writer.register_channel("/tf_static", "cdr", kind, {"offered_qos_profiles": "- depth: 7\n  durability: 1\n"})
        writer.add_message(latched, 5, b"tf", 5)
        for stamp in range(100, 200):
            writer.add_message(events, stamp, b"{}", stamp)
        later = writer.register_channel("tf", "cdr", kind)
        for stamp in range(200, 500):
            writer.add_message(later, stamp, b"tf", stamp)
        writer.finish()
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    recovered, _ = recover(path.parent if as_folder else path)
    assert recovered.name == ("camera_recovered" if as_folder else "camera_0_recovered")
    recording = open_recording(recovered)
    recording.check(contract(), ["tf", "tf_static"])
    assert recording.types.keys() == {"tf", "tf_static"}
    assert recording.counts["tf_static"] == 1
    assert 0 < recording.counts["tf"] < 300


def test_recover_reports_errors(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no recording there"):
        recover(tmp_path)
    RecorderService(tmp_path / RECORDING)
    with pytest.raises(ValueError, match="nothing to recover"):
        recover(kill(tmp_path / RECORDING, tmp_path / "empty"))


def test_gaps_in_the_sequence_are_reported(service: RecorderService) -> None:
    for sequence in (0, 1, 5, 6):
        service.record(TOPICS["joint_states"], joint_states(0), sequence * MS, sequence)
    assert service.finish()["missing"] == {"/joint_states": 3}


def test_memory_stays_bounded_by_the_chunk(service: RecorderService, tmp_path: Path) -> None:
    """Large messages go to disk by size, long before a simulated second is over."""
    mesh = mesh_message(header(0), np.random.default_rng(0).random((700_000, 3)))
    payload = codec.encode(mesh, "palpation_msgs/msg/SurfaceMesh")
    for i in range(3):
        service.record(TOPICS["sim/surface"], payload, i, i)
    assert (tmp_path / RECORDING / f"{RECORDING}_0.mcap").stat().st_size > 2 * len(payload)
    service.finish()


def test_a_long_recording_is_split_and_others_read_it_as_one(tmp_path: Path) -> None:
    folder = tmp_path / RECORDING
    service = RecorderService(folder, file_bytes=300_000)
    record(service, 2900)
    facts = service.finish()
    assert facts["files"] >= 3
    assert (facts["messages"], facts["missing"]) == (2958, {})
    metadata = yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert len(metadata["relative_file_paths"]) == facts["files"]
    assert sum(file["message_count"] for file in metadata["files"]) == metadata["message_count"] == facts["messages"]
    with Reader(folder) as reader:
        observed = {f"/{topic.name}" for topic, _ in contract().inputs("recorder")}
        assert {connection.topic for connection in reader.connections} == observed
    assert rows(folder) == [(i * MS, joint_states(i * MS)) for i in range(2900)]
    assert rows(folder, "/sim/surface") == [(i * MS, surface(i * MS)) for i in range(0, 2900, 50)]
    joints = []
    for path in sorted(folder.glob("*.mcap")):  # each file is complete in itself
        with path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
            assert reader.get_header().profile == "ros2"
            decoded = list(reader.iter_decoded_messages())
        joints += [(message, ros) for _, channel, message, ros in decoded if channel.topic == "/joint_states"]
    assert [message.sequence for message, _ in joints] == list(range(2900))
    assert all(ros.position[0] == message.log_time / 1e9 for message, ros in joints)


def test_a_normal_recording_keeps_every_message_but_of_the_topics_that_weigh_most(tmp_path: Path) -> None:
    every = TOPICS["joint_states"].record_ms
    service = RecorderService(tmp_path / RECORDING, full=False)
    for k in range(101):
        put(service, k)
        service.record(TOPICS["robot/status"], b"", k * MS, k + 1)
    facts = service.finish()
    assert facts["topics"]["/joint_states"] == 100 // every + 1
    assert facts["topics"]["/robot/status"] == 101
    assert facts["missing"] == {}
    recording = open_recording(tmp_path / RECORDING)
    assert recording.thinned.keys() == {name for name, topic in TOPICS.items() if topic.record_ms}
    recording.check(contract(), ["robot/status"])
    recording.check(contract(), ["joint_states"], whole=False)
    with pytest.raises(RecordingError, match=r"joint_states.*--record full"):
        recording.check(contract(), ["joint_states"])


def test_finish_twice_and_a_shorter_run_in_the_same_folder(tmp_path: Path) -> None:
    first = RecorderService(tmp_path / RECORDING, file_bytes=50_000)
    record(first, 1500)
    assert first.finish()["files"] > 1
    first.finish()
    second = RecorderService(tmp_path / RECORDING)
    record(second, 5)
    second.finish()
    metadata = yaml.safe_load((tmp_path / RECORDING / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert (metadata["message_count"], metadata["duration"]["nanoseconds"]) == (6, 4 * MS)
    assert [path.name for path in (tmp_path / RECORDING).glob("*.mcap")] == [f"{RECORDING}_0.mcap"]


def test_an_unknown_topic_is_counted_not_written(service: RecorderService) -> None:
    stranger = TOPICS["joint_states"].model_copy(update={"name": "not/ours"})
    service.record(stranger, b"\0\1\0\0", 0, 0)
    facts = service.finish()
    assert (facts["unexpected"], facts["messages"]) == (1, 0)


def test_create_reads_the_run_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PALPATE_OUT", str(tmp_path / "run"))
    create(Scenario()).finish()
    assert (tmp_path / "run" / RECORDING / "metadata.yaml").is_file()
    monkeypatch.delenv("PALPATE_OUT")
    with pytest.raises(ValueError, match="PALPATE_OUT"):
        create(Scenario())


def test_a_disk_that_fills_up_ends_the_recording_whole_and_not_the_run(
    service: RecorderService, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record(service, 1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=9_000_000))
    put(service, 1000)
    put(service, 1001)
    facts = service.finish()
    assert "ends at 1.000 s: 9 MB are left" in facts["trouble"]
    assert facts["unwritten"] == 2
    assert len(rows(tmp_path / RECORDING)) == 1000


def test_a_folder_that_is_lost_ends_the_recording_and_not_the_run(service: RecorderService, tmp_path: Path) -> None:
    record(service, 100)
    shutil.rmtree(tmp_path / RECORDING)
    put(service, 300)
    assert "ends at 0.300 s: its folder is lost" in service.finish()["trouble"]


def test_a_write_error_ends_the_recording_and_not_the_run(service: RecorderService, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk fills up between two checks of its room."""
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    monkeypatch.setattr(service._bag._writer, "add_message", mock.Mock(side_effect=full))
    record(service, 2)
    assert service.finish()["trouble"].endswith("it cannot be written: No space left on device")
