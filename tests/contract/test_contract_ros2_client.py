"""ROS 2 proven: an independent client of rmw_zenoh's wire finds our services, hears them, and is heard by the robot."""

from __future__ import annotations

import ast
import json
import shlex
import subprocess
import sys
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.check.live_rig import LiveRig
from palpate.check.perform import started
from palpate.check.report import ConformanceReport
from palpate.check.rig import RigSettings
from palpate.check.suites.camera import plane
from palpate.check.suites.robot import quiet
from palpate_bus.contract import contract
from palpate_bus.messages import CameraTrigger, codec
from palpate_bus.messages.stamps import header
from palpate_bus.wire.zenoh_config import BusOptions, free_port, session
from palpate_models.scenario.load import load_scenario

CLIENT = Path(__file__).with_name("ros2_client.py")
RULES = contract()
TYPES = ("sensor_msgs/msg/JointState", "geometry_msgs/msg/WrenchStamped", "sensor_msgs/msg/Image",
         "palpation_msgs/msg/RobotStatus", "palpation_msgs/msg/OperatorRequest")  # fmt: skip


def write_definitions(folder: Path) -> None:
    """What the client would clone otherwise."""
    for name in TYPES:
        for file, text in codec.interface_files(name).items():
            path = folder / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")


def test_the_client_imports_nothing_of_ours() -> None:
    tree = list(ast.walk(ast.parse(CLIENT.read_text(encoding="utf-8"))))
    modules = {alias.name for node in tree if isinstance(node, ast.Import) for alias in node.names}
    modules |= {str(node.module) for node in tree if isinstance(node, ast.ImportFrom)}
    assert not [name for name in modules if name.startswith("palpat")]
    assert "zenoh_ros2_sdk" in modules


@pytest.mark.slow
def test_a_ros_2_user_hears_robot_and_camera_and_stops_the_robot(tmp_path: Path) -> None:
    write_definitions(tmp_path / "definitions")
    port = free_port()
    where = f"tcp/127.0.0.1:{port}"
    settings = RigSettings(load_scenario("clean"), slack_ms=3000)
    with ExitStack() as stack:
        bus = stack.enter_context(session(BusOptions(mode="router", listen=(where,))))
        words = [sys.executable, str(CLIENT), str(port), str(tmp_path / "definitions"), "--seconds", "150"]
        client = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert client.stdout is not None
        lines = [client.stdout.readline()]  # it listens from before the hellos on
        rigs = {}
        for role in ("camera", "robot"):
            rig = rigs[role] = LiveRig(bus, role, settings)
            stack.callback(rig.close)
            stack.enter_context(started(shlex.join([sys.executable, "-m", "palpate.service", role]), role, settings, where, 0))
        for role, rig in rigs.items():
            rig.await_implementation(120, ConformanceReport(role))
        reading = threading.Thread(target=lambda: lines.extend(client.stdout or ()), daemon=True)
        reading.start()
        surface = {"sim/surface": plane(np.array(settings.scenario.camera.look_at_m))}
        while client.poll() is None:
            rigs["camera"].send("planning/camera_trigger", CameraTrigger(header(rigs["camera"].t), 2))
            rigs["camera"].run(0.4, surface)
            rigs["robot"].run(0.4, quiet(rigs["robot"]))
        reading.join()
        errors = client.stderr.read() if client.stderr else ""
    said = [json.loads(line) for line in lines if line.startswith("{")]
    assert client.returncode == 0, (said, errors[-2000:])
    assert "ERROR" not in errors, errors[-2000:]
    heard = {row["heard"]: row for row in said if "heard" in row}
    assert heard["/joint_states"]["names"] == [f"lbr_A{i}" for i in range(1, 8)]
    assert heard["/ft/wrench"]["frame"] == "ft_sensor"
    assert heard["/camera/depth/image_raw"]["size"] == [480, 640]
    graph: dict[str, Any] = next(row for row in said if "topics" in row)
    assert {f"/{topic.name}" for role in ("robot", "camera") for topic in RULES.outputs(role)} <= set(graph["topics"])
    assert graph["publishers"] == ["robot"]
    assert "asked from ROS 2" in next(row["robot"] for row in said if "robot" in row)
