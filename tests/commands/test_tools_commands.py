"""The live commands on the bus of an announced run."""

import json
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
import zenoh
from typer.testing import CliRunner, Result

from palpate.console import CommandGroup
from palpate.live.bus import app as node, missing
from palpate.live.doctor import doctor
from palpate.live.topic import app as topic
from palpate_bus.contract import contract
from palpate_bus.messages import MS, JointState, String, Vector3, Wrench, WrenchStamped, codec, header
from palpate_bus.runs.announcement import Announcement, Run, live_runs
from palpate_bus.wire.liveliness import NodeTokens
from palpate_bus.wire.rmw import topic_key
from palpate_bus.wire.transport import Publisher
from palpate_bus.wire.zenoh_config import mesh, session

RULES = contract()
DOMAIN = 7
ENDPOINT_VARIABLES = ("PALPATE_CONNECT", "PALPATE_ROUTER", "PALPATE_ZENOH_CONFIG")
NAMES = [f"lbr_A{i}" for i in range(1, 8)]


class SmallRobot:
    """Publishes `joint_states` and `ft/wrench` in ticks of 1 ms, one per 5 ms, and its description."""

    def __init__(self, bus: zenoh.Session, endpoint: str) -> None:
        self.bus = bus
        self.given = "--connect", endpoint, "--domain", str(DOMAIN)
        """Options that name the bus, on which a command does not wait for the roles of a run."""
        self.change: Callable[[Any], Any] = lambda message: message
        """Changes a joint state before it is sent."""
        self._tokens = tokens = NodeTokens(bus, "robot", DOMAIN)  # kept, because tokens are withdrawn with their last reference
        self._publishers = {}
        for name in ("joint_states", "ft/wrench", "robot_description"):
            row = RULES.topics[name]
            qos = RULES.qos[row.qos]
            self._publishers[name] = Publisher(bus, topic_key(row, DOMAIN), qos, tokens.publisher(row, qos))
        self.stop = threading.Event()
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _run(self) -> None:
        self._put("robot_description", String("<robot/>"), 1)
        sequence = 0
        while not self.stop.wait(0.01):
            for _ in range(2):
                sequence += 1
                t = (sequence - 1) * MS
                joints = JointState(header(t), NAMES, np.linspace(0, 0.6, 7), np.zeros(7), np.zeros(7))
                wrench = Wrench(Vector3(1.0, -2.0, 3.5), Vector3(0.0, 0.0, 0.0))
                self._put("joint_states", self.change(joints), sequence)
                self._put("ft/wrench", WrenchStamped(header(t, "ft_sensor"), wrench), sequence)

    def _put(self, name: str, message: Any, sequence: int) -> None:
        self._publishers[name].put(codec.encode(message, RULES.topics[name].type), sequence)


tools = typer.Typer(cls=CommandGroup)
tools.add_typer(topic, name="topic")
tools.add_typer(node, name="node")
tools.command("doctor")(doctor)


def run(*words: str) -> Result:
    return CliRunner().invoke(tools, list(words))


def output_of(*words: str) -> Any:
    result = run(*words, "--json")
    assert result.exit_code in (0, 1), result.output
    return json.loads(result.stdout)


@pytest.fixture(scope="module")
def robot() -> Iterator[SmallRobot]:
    """Return a robot on an announced bus; control and tissue of the run do not answer."""
    with tempfile.TemporaryDirectory(prefix="small-") as folder, pytest.MonkeyPatch.context() as patch:
        patch.setenv("PALPATE_RUNS", folder)
        for name in ENDPOINT_VARIABLES:
            patch.delenv(name, raising=False)
        options = mesh(["robot"], Path(folder))["robot"]
        absent = {role: options.listen[0].replace("robot", role) for role in ("control", "tissue")}
        announced = Run(name="small", endpoints={"robot": options.listen[0], **absent}, domain=DOMAIN)
        with session(options) as bus:
            announcement = Announcement(announced)
            small = SmallRobot(bus, options.listen[0])
            yield small
            small.stop.set()
            small.thread.join()
            announcement.withdraw()


def test_topics_of_the_announced_bus(robot: SmallRobot) -> None:
    rows = {row["topic"]: row for row in output_of("topic", "list")}
    assert set(rows) == {"joint_states", "ft/wrench", "robot_description"}
    assert rows["joint_states"]["publishers"] == ["robot"]
    assert all(row["matches_contract"] for row in rows.values())
    assert "joint_states" in run("topic", "list", *robot.given).stdout


def test_info_shows_the_row_and_its_endpoints(robot: SmallRobot) -> None:
    facts = output_of("topic", "info", "/ft/wrench")
    assert facts["contract"]["frame"] == "ft_sensor"
    assert [(end["node"], end["kind"]) for end in facts["endpoints"]] == [("robot", "publisher")]
    assert "[N] -200 .. 200" in run("topic", "info", "ft/wrench", *robot.given).stdout


def test_echo_prints_what_is_sent(robot: SmallRobot) -> None:
    received = output_of("topic", "echo", "ft/wrench", "--once")
    assert received["message"]["wrench"]["force"] == {"x": 1.0, "y": -2.0, "z": 3.5}
    text = run("topic", "echo", "ft/wrench", "--once", "--field", "wrench.force").stdout
    assert text == "x: 1.0\ny: -2.0\nz: 3.5\n---\n"
    assert output_of("topic", "echo", "robot_description", "--once")["message"] == {"data": "<robot/>"}, "latched"
    refused = run("topic", "echo", "ft/wrench", "--once", "--field", "wrench.power")
    assert (refused.exit_code, "no 'power' among force, torque" in refused.stderr) == (2, True)


def test_hz_counts_simulated_time(robot: SmallRobot) -> None:
    result = run("topic", "hz", "joint_states", "--seconds", "2.2", "--json")
    row, *_ = (json.loads(line) for line in result.stdout.splitlines())
    assert (row["simulated_hz"], row["contract_hz"]) == (pytest.approx(1000, abs=1), 1000)


def test_nodes_and_missing_roles(robot: SmallRobot) -> None:
    found = output_of("node", "list")
    assert [row["node"] for row in found["nodes"]] == ["robot"]
    assert found["missing"][:2] == ["tissue", "control"]
    assert "search" not in found["missing"], "the run does without it"


def test_doctor_names_each_fault(robot: SmallRobot) -> None:
    def change(message: Any) -> Any:
        message.position[2] = np.nan
        return message

    outdated = RULES.topics["joint_states"].model_copy(update={"type": "geometry_msgs/msg/WrenchStamped"})
    tokens = NodeTokens(robot.bus, "rviz", DOMAIN)
    tokens.subscription(outdated, RULES.qos["control"])
    robot.change = change
    try:
        found = output_of("doctor", "--seconds", "2")
    finally:
        robot.change = lambda message: message
        tokens.undeclare()
    about = {(finding["about"], finding["level"]) for finding in found["findings"]}
    assert {("versions", "ok"), ("endpoints", "warning"), ("roles", "trouble"), ("types", "trouble")} <= about
    kinds = {(v["topic"], v["sender"], v["kind"]) for v in found["violations"]}
    assert ("joint_states", "robot", "not finite") in kinds
    assert ("joint_states", "rviz", "type hash") in kinds
    texts = " ".join(finding["text"] for finding in found["findings"])
    assert all(text in texts for text in ("control is missing", "1 of 3 endpoints answer"))


def test_ctrl_c_ends_a_tool_with_status_0_and_whole_lines(robot: SmallRobot) -> None:
    words = [sys.executable, "-c", "from palpate.live.topic import app; app()", "echo", "joint_states", "--json"]
    tool = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    first = tool.stdout.readline()
    tool.send_signal(signal.SIGINT)
    rest, errors = tool.communicate(timeout=30)
    assert (tool.returncode, errors) == (0, "")
    assert all(json.loads(line) for line in [first, *rest.splitlines()])


def test_a_killed_run_is_not_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PALPATE_RUNS", str(tmp_path))
    code = "from palpate_bus.runs.announcement import *; a = Announcement(Run('x', {})); print('on', flush=True); input()"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout.readline() == "on\n"
        assert [found.name for found in live_runs()] == ["x"]
        child.kill()
    assert live_runs() == []
    assert list(tmp_path.glob("*.json")) == []


def test_only_roles_that_the_run_has_are_missed() -> None:
    observers = [role.name for role in RULES.roles.values() if role.observer]
    assert {"tissue", "search"} & set(missing(RULES, [], None)) == {"tissue"}, "search is optional"
    run = Run("hardware", {"robot": "tcp/127.0.0.1:1", "search": "tcp/127.0.0.1:2"})
    assert set(missing(RULES, [], run)) == {"robot", "search", *observers}
