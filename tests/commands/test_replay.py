"""Replay of recordings: services against committed references, and messages on a bus."""

import json
import time
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue

import pytest
import zenoh
from click.testing import Result
from mcap.writer import Writer
from typer.testing import CliRunner
from waiting import wait_until

from palpate.commands import app_for
from palpate.replay.compare import FieldDifference, Tolerance, TopicResult, as_dict, compare
from palpate.replay.golden import prepare, replay_service, rerun
from palpate.replay.play import Player
from palpate_bus.contract import contract
from palpate_bus.messages import codec, nanoseconds
from palpate_bus.recordings import RecordedMessage, open_recording
from palpate_bus.wire.liveliness import GraphWatch, NodeTokens
from palpate_bus.wire.rmw import topic_key, unpack
from palpate_bus.wire.zenoh_config import BusOptions, session
from palpate_errors import UserError

RULES = contract()
REFERENCES = Path(__file__).parent / "references"
CONTROL = REFERENCES / "control.mcap"
RENEW = (
    "where a message type changed: python tests/commands/make_references.py; "
    "where the service was meant to change: palpate replay {0} --service {1} --update-refs {0}"
)
CHANGED = """
from palpate_{role}.service import create as original

def create(scenario):
    service = original(scenario)
    step = service.step

    def changed(t, inbox):
        out = dict(step(t, inbox))
        {change}
        return out

    service.step = changed
    return service
"""


def changed_service(folder: Path, role: str, change: str) -> str:
    """Write a service whose output differs from ours, and return the option that selects it."""
    file = folder / f"changed_{role}.py"
    file.write_text(CHANGED.format(role=role, change=change), encoding="utf-8")
    return f"{role}={file}"


@pytest.fixture
def weaker(tmp_path: Path) -> str:
    """Return a controller with 1 % less torque."""
    return changed_service(tmp_path, "control", "out['control/joint_torque'].torque[:] *= 0.99")


@pytest.mark.parametrize("role", [role.name for role in RULES.roles.values() if not role.observer])
def test_every_service_agrees_with_its_reference(role: str) -> None:
    path = REFERENCES / f"{role}.mcap"
    results = replay_service(prepare(path, role), Tolerance())
    differing = [(name, found.violations[:3], found.missing, found.extra) for name, found in results.items() if not found.agrees]
    assert not differing, f"{differing}; if this is intended: {RENEW.format(path, role)}"
    assert sum(result.messages for result in results.values()) > 0


TEXTS = ("message", "problem", "reason")
"""Fields with text for people."""


def retold(message: RecordedMessage) -> RecordedMessage:
    """Return the message with another text for people."""
    kind = RULES.topics[message.topic].type
    content = codec.decode(message.payload, kind)
    found = [name for name in TEXTS if isinstance(value := getattr(content, name, None), str) and value]
    return message._replace(payload=codec.encode(replace(content, **dict.fromkeys(found, "another text")), kind))


@pytest.mark.parametrize("role", ["assessment", "search", "supervisor"])
def test_a_service_does_the_same_whatever_the_texts_of_its_inputs_say(role: str) -> None:
    case = prepare(REFERENCES / f"{role}.mcap", role)
    inputs = list(case.recording.messages(case.inputs))
    others = [retold(message) for message in inputs]
    assert others != inputs
    sent = rerun(case.service, RULES, others, case.end)
    results = compare(case.recording.messages(case.outputs, end=case.end), sent, RULES, Tolerance(), case.outputs)
    assert not any(found.missing or found.extra or found.off_time for found in results.values())
    assert not [worst.name for found in results.values() for worst in found.violations if worst.name not in TEXTS]


def palpate_replay(recording: Path, *words: str) -> Result:
    """Run the command in this process."""
    return CliRunner().invoke(app_for("replay"), ["replay", str(recording), *words])


def test_a_weaker_controller_is_detected_unless_the_tolerance_allows_it(weaker: str) -> None:
    done = palpate_replay(CONTROL, "--service", weaker, "--json")
    assert done.exit_code == 3, done.output
    result = json.loads(done.stdout)["control/joint_torque"]
    assert not result["agrees"]
    assert result["worst"][0]["name"] == "torque"
    assert result["worst"][0]["ratio"] > 1
    loose = palpate_replay(CONTROL, "--service", weaker, "--tolerance", "control/joint_torque:torque=2.0")
    assert loose.exit_code == 0, loose.output


def test_a_difference_of_texts_is_null_in_json() -> None:
    texts, finite = (FieldDifference(name, 0, "a", "b", off, 1.0) for name, off in (("text", float("inf")), ("number", 2.0)))
    row = as_dict(TopicResult("robot/state", worst={"number": finite, "text": texts}))
    assert [(d["name"], d["deviation"], d["ratio"]) for d in row["worst"]] == [("text", None, None), ("number", 2.0, 2.0)]
    json.dumps(row, allow_nan=False)


def test_a_silent_service_is_detected(tmp_path: Path) -> None:
    silent = prepare(REFERENCES / "assessment.mcap", changed_service(tmp_path, "assessment", "out = {}"))
    samples = replay_service(silent, Tolerance())["assessment/samples"]
    assert samples.missing > 0
    assert not samples.agrees


def test_a_renewed_reference_agrees_with_the_changed_service(tmp_path: Path, weaker: str) -> None:
    new = tmp_path / "weaker.mcap"
    assert palpate_replay(CONTROL, "--service", weaker, "--update-refs", str(new)).exit_code == 0
    assert [palpate_replay(new, "--service", service).exit_code for service in (weaker, "control")] == [0, 3]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--service tisue", "allowed are robot, tissue"),
        ("--service tissue=none_such", "winkler"),
        ("--service tissue=no_such_file.py", "no_such_file.py"),
        ("--service camera", "no message of camera to compare with"),
        ("--service control --tolerance x", "--tolerance x"),
        ("--service control --tolerance nothing:torque=1", "no topic 'nothing'"),
        ("--topic nothing", "nothing"),
        ("--update-refs new.mcap", "--update-refs needs --service"),
        ("--service control --for 5", "--for is for a recording that is played"),
        ("--service control --update-refs new.mcap --json", "--json cannot be combined with --update-refs"),
    ],
)
def test_bad_input_ends_with_status_2_and_names_the_fault(words: str, said: str) -> None:
    done = palpate_replay(CONTROL, *words.split())
    assert done.exit_code == 2, done.output
    assert said in " ".join(done.stderr.replace("│", " ").split())


@pytest.fixture
def endpoint(tmp_path: Path) -> str:
    return f"unixsock-stream/{tmp_path}/bus.sock"


@pytest.fixture
def listener(endpoint: str) -> Iterator[zenoh.Session]:
    with session(BusOptions(connect=(endpoint,))) as opened:
        yield opened


def test_every_message_arrives_as_it_was_recorded(endpoint: str, listener: zenoh.Session) -> None:
    recording = open_recording(CONTROL)
    recorded = list(recording.messages(["joint_states"]))
    queues: dict[str, SimpleQueue[zenoh.Sample]] = {name: SimpleQueue() for name in ("joint_states", "clock")}
    for name, queue in queues.items():
        listener.declare_subscriber(topic_key(RULES.topics[name], 0), zenoh.handlers.Callback(queue.put, indirect=False))
    watch, roles = GraphWatch(listener, 0), {"robot", "planning", "control", "conductor"}
    with Player(recording, rate=0.5, listen=endpoint) as player:
        assert wait_until(listener.info.peers_zid)
        time.sleep(0.3)  # the subscriptions reach the player
        assert wait_until(lambda: watch.changes() == [] and watch.roles() >= roles)
        begin = time.monotonic()
        player.play()
        assert time.monotonic() - begin >= 2 * recording.last / 1e9
        samples = [queues["joint_states"].get(timeout=20) for _ in recorded]
        assert [s.payload.to_bytes() for s in samples] == [m.payload for m in recorded]
        assert [unpack(s.attachment.to_bytes())[0] for s in samples] == [m.sequence for m in recorded]
        assert roles <= watch.roles()
        clock = [queues["clock"].get(timeout=20) for _ in range(10)]
        clocks = [codec.decode(s.payload.to_bytes(), RULES.topics["clock"].type) for s in clock]
        assert [nanoseconds(message.clock) for message in clocks] == [i * 10_000_000 for i in range(10)]
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
        ("/chatter", (5,), (), 2, "no message on a topic of the contract; it has chatter (std_msgs/msg/String)"),
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
    done = palpate_replay(path, "--listen", endpoint, *options)
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
def test_a_live_service_is_not_imitated_and_moved_only_on_request(
    endpoint: str, listener: zenoh.Session, topic: str, drive: bool, said: str | None
) -> None:
    tokens = NodeTokens(listener, "robot", 0)
    played = nullcontext() if said is None else pytest.raises(UserError, match=said)
    with played, Player(open_recording(CONTROL), topics=[topic], listen=endpoint, drive=drive) as player:
        player.play()
        assert player.sent > 0
    tokens.undeclare()
