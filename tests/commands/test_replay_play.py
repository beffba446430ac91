"""A recording on a real bus: bytes, sequence numbers, clock, graph; and when it is not played."""

import time
from collections.abc import Iterator
from pathlib import Path
from queue import Empty, SimpleQueue

import pytest
import zenoh
from mcap.writer import Writer
from typer.testing import CliRunner

from palpate.commands import app_for
from palpate.replay.play import Player
from palpate_bus.contract import contract
from palpate_bus.messages import codec
from palpate_bus.messages.stamps import nanoseconds
from palpate_bus.recordings import open_recording
from palpate_bus.wire.liveliness import GraphWatch, NodeTokens
from palpate_bus.wire.rmw import topic_key, unpack
from palpate_bus.wire.zenoh_config import BusOptions, session
from palpate_errors import UserError

CONTROL = Path(__file__).parent / "references" / "control.mcap"
RULES = contract()


@pytest.fixture
def endpoint(tmp_path: Path) -> str:
    return f"unixsock-stream/{tmp_path}/bus.sock"


@pytest.fixture
def listener(endpoint: str) -> Iterator[zenoh.Session]:
    with session(BusOptions(connect=(endpoint,))) as opened:
        yield opened


def heard(queue: "SimpleQueue[zenoh.Sample]", number: int) -> list[zenoh.Sample]:
    samples = []
    try:
        while len(samples) < number:
            samples.append(queue.get(timeout=20))
    except Empty:
        pass
    return samples


def test_every_message_arrives_as_it_was_recorded(endpoint: str, listener: zenoh.Session) -> None:
    recording = open_recording(CONTROL)
    recorded = list(recording.messages(["joint_states"]))
    queue: SimpleQueue[zenoh.Sample] = SimpleQueue()
    clocks: SimpleQueue[zenoh.Sample] = SimpleQueue()
    listener.declare_subscriber(topic_key(RULES.topics["joint_states"], 0), zenoh.handlers.Callback(queue.put, indirect=False))
    listener.declare_subscriber(topic_key(RULES.topics["clock"], 0), zenoh.handlers.Callback(clocks.put, indirect=False))
    watch = GraphWatch(listener, 0)
    with Player(recording, rate=0.5, listen=endpoint) as player:
        deadline = time.monotonic() + 20
        while not listener.info.peers_zid() and time.monotonic() < deadline:
            time.sleep(0.02)
        time.sleep(0.3)  # the subscriptions reach the player
        while not watch.roles() >= {"robot", "planning", "control", "conductor"} and time.monotonic() < deadline:
            watch.changes(0.1)
        begin = time.monotonic()
        player.play()
        assert time.monotonic() - begin >= 2 * recording.last / 1e9
        samples = heard(queue, len(recorded))
        assert [s.payload.to_bytes() for s in samples] == [m.payload for m in recorded]
        assert [unpack(s.attachment.to_bytes())[0] for s in samples] == [m.sequence for m in recorded]
        assert {"robot", "planning", "control", "conductor"} <= watch.roles()
        times = [nanoseconds(codec.decode(s.payload.to_bytes(), RULES.topics["clock"].type).clock) for s in heard(clocks, 10)]
        assert times == [i * 10_000_000 for i in range(10)]
        assert player.sent == sum(recording.counts.values())


def foreign(path: Path, topic: str, kind: str, stamps: tuple[int, ...]) -> Path:
    """Write a recording as other recorders of ROS 2 do."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "other")
        schema = writer.register_schema(kind, "ros2msg", codec.definition(kind).encode())
        channel = writer.register_channel(topic, "cdr", schema)
        for stamp in stamps:
            writer.add_message(channel, stamp, bytes(64), stamp)
        writer.finish()
    return path


def test_a_recording_of_unix_time_begins_at_its_first_message(endpoint: str, tmp_path: Path) -> None:
    stamps = tuple(1_700_000_000_000_000_000 + k * 100_000_000 for k in range(5))
    path = foreign(tmp_path / "a.mcap", "/camera/depth/image_raw", "sensor_msgs/msg/Image", stamps)
    with Player(open_recording(path), rate=10, listen=endpoint) as player:
        player.play()
        assert (player.sent, player.now) == (5, 400_000_000)
    with Player(open_recording(path), rate=10, listen=endpoint) as player:
        player.play(150_000_000, 350_000_000)
        assert (player.sent, player.now) == (3, 300_000_000), "two, and the one before"


@pytest.mark.parametrize(
    ("topic", "stamps", "options", "status", "said"),
    [
        ("/chatter", (5,), (), 2, "no message on a topic of the contract; it has chatter (std_msgs/msg/String, 1 messages)"),
        ("/tf_static", (5,), ("--from", "7"), 2, "--from 7: "),
        ("/joint_states", (0, 10**9), ("--from", "0.3", "--for", "0.1"), 3, "played no message"),
        ("/tf_static", (0, 1_700_000_000_000_000_000), (), 2, "some of them are wrong"),
    ],
)
def test_a_recording_with_nothing_to_play_is_a_failure(
    endpoint: str, tmp_path: Path, topic: str, stamps: tuple[int, ...], options: tuple[str, ...], status: int, said: str
) -> None:
    row = RULES.topics.get(topic[1:])
    path = foreign(tmp_path / "a.mcap", topic, "std_msgs/msg/String" if row is None else row.type, stamps)
    done = CliRunner().invoke(app_for("replay"), ["replay", str(path), "--listen", endpoint, *options])
    assert done.exit_code == status, done.output
    assert said in done.stderr


@pytest.mark.parametrize(
    ("topic", "drive", "said"),
    [
        ("joint_states", True, "robot runs on this bus"),
        ("control/joint_torque", False, "robot would act on control/joint_torque"),
        ("control/joint_torque", True, None),
    ],
)
def test_it_does_not_speak_over_a_living_service_nor_move_one(
    endpoint: str, listener: zenoh.Session, topic: str, drive: bool, said: str | None
) -> None:
    tokens = NodeTokens(listener, "robot", 0)
    if said is None:
        with Player(open_recording(CONTROL), topics=[topic], listen=endpoint, drive=drive) as player:
            player.play()
            assert player.sent > 0
    else:
        with pytest.raises(UserError, match=said):
            Player(open_recording(CONTROL), topics=[topic], listen=endpoint, drive=drive)
    tokens.undeclare()
