"""Golden replay: every service against its committed reference, and references that find out a changed service."""

import json
from pathlib import Path

import pytest
import typer
from click.testing import Result
from mcap.writer import Writer
from typer.testing import CliRunner

from palpate.replay.command import replay
from palpate.replay.compare import Tolerance
from palpate.replay.golden import prepare, replay_service
from palpate_bus.contract import contract
from palpate_bus.recordings import RecordingError, open_recording
from palpate_plugins import PluginError

REFERENCES = Path(__file__).parent / "references"
CHANGED = Path(__file__).parent
ROLES = [role.name for role in contract().roles.values() if not role.observer]
RENEW = (
    "where a message type changed: python tests/commands/make_references.py; "
    "where the service was meant to change: palpate replay {0} --service {1} --update-refs {0}"
)


@pytest.mark.parametrize("role", ROLES)
def test_every_service_still_answers_as_its_reference_says(role: str) -> None:
    path = REFERENCES / f"{role}.mcap"
    results = replay_service(prepare(path, role), Tolerance())
    differing = [
        (name, result.violations[:3], result.missing, result.extra) for name, result in results.items() if not result.agrees
    ]
    assert not differing, f"{differing}; if this is intended: {RENEW.format(path, role)}"
    assert sum(result.messages for result in results.values()) > 0


def palpate_replay(*words: str) -> Result:
    """The command, in this process."""
    app = typer.Typer()
    app.command()(replay)
    return CliRunner().invoke(app, words)


@pytest.fixture(autouse=True)
def changed_services(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parent))


def test_a_controller_that_is_a_hundredth_weaker_is_found_out() -> None:
    done = palpate_replay(str(REFERENCES / "control.mcap"), "--service", f"control={CHANGED}/replay_weaker.py", "--json")
    assert done.exit_code == 3, done.output
    result = json.loads(done.stdout)["control/joint_torque"]
    assert not result["agrees"]
    assert result["worst"][0]["name"] == "torque"
    assert result["worst"][0]["ratio"] > 1
    loose = ("--tolerance", "control/joint_torque:torque=2.0")
    assert (
        palpate_replay(str(REFERENCES / "control.mcap"), "--service", f"control={CHANGED}/replay_weaker.py", *loose).exit_code
        == 0
    )


def test_a_service_that_falls_silent_is_found_out() -> None:
    results = replay_service(prepare(REFERENCES / "assessment.mcap", f"assessment={CHANGED}/replay_silent.py"), Tolerance())
    assert results["assessment/samples"].missing > 0
    assert not results["assessment/samples"].agrees


def test_renewing_a_reference_makes_the_changed_service_agree(tmp_path: Path) -> None:
    new = tmp_path / "weaker.mcap"
    choice = ("--service", f"control={CHANGED}/replay_weaker.py")
    assert palpate_replay(str(REFERENCES / "control.mcap"), *choice, "--update-refs", str(new)).exit_code == 0
    assert palpate_replay(str(new), *choice).exit_code == 0
    assert palpate_replay(str(new), "--service", "control").exit_code == 3


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--service", "tisue"), "services are robot, tissue"),
        (("--service", "tissue=none_such"), "winkler"),
        (("--service", "tissue=no_such_file.py"), "no_such_file.py"),
        (("--service", "camera"), "nothing that camera sent"),
        (("--service", "control", "--tolerance", "x"), "--tolerance x"),
        (("--service", "control", "--tolerance", "nothing:torque=1"), "no topic 'nothing'"),
        (("--topic", "nothing"), "nothing"),
        (("--update-refs", "new.mcap"), "--update-refs goes with --service"),
        (("--service", "control", "--for", "5"), "--for is for a recording that is played"),
        (("--service", "control", "--update-refs", "new.mcap", "--json"), "--json cannot be combined with --update-refs"),
    ],
)
def test_bad_input_ends_with_status_2_and_says_what_is_wrong(words: tuple[str, ...], said: str) -> None:
    done = palpate_replay(str(REFERENCES / "control.mcap"), *words)
    assert done.exit_code == 2, done.output
    assert said in done.stderr


def test_files_that_are_no_recording_are_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no recording there"):
        open_recording(tmp_path)
    broken = tmp_path / "broken.mcap"
    broken.write_bytes((REFERENCES / "control.mcap").read_bytes()[:5000])
    with pytest.raises(RecordingError, match=r"broken\.mcap"):
        open_recording(broken)


def test_a_recording_with_another_definition_is_refused_with_both_hashes(tmp_path: Path) -> None:
    file = tmp_path / "old.mcap"
    with file.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        schema = writer.register_schema("palpation_msgs/msg/JointTorqueCommand", "ros2msg", b"float64 x")
        channel = writer.register_channel("/control/joint_torque", "cdr", schema, {"topic_type_hash": "RIHS01_old"})
        writer.add_message(channel, 0, b"\0\1\0\0", 0, 1)
        writer.finish()
    with pytest.raises(RecordingError, match="RIHS01_old"):
        open_recording(file).check(contract(), ["control/joint_torque"])


def test_only_services_are_run_again() -> None:
    with pytest.raises(PluginError, match="dashboard"):
        prepare(REFERENCES / "control.mcap", "dashboard")
