"""Two that command one arm: the driver notices, and nobody's commands hide another's."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lbr_bench import MS, Rig, active_rig

from palpate_bus.messages import RobotStatus, SupervisorState
from palpate_bus.messages.stamps import header
from palpate_bus.wire.ros_node import RosNode
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_models.scenario.schema import LbrConnection
from palpate_robot.backends.lbr.port import TORQUE_COMMAND, LBRTorqueCommand, ZenohPort
from palpate_robot.backends.lbr.service import TAKE_OVER


@pytest.fixture
def rig() -> Rig:
    return active_rig()


def release(rig: Rig) -> None:
    state: Any = SupervisorState(
        **{**dict.fromkeys(SupervisorState.__dataclass_fields__, 0), "header": header(rig.t), "releases": 1}
    )
    rig.inbox.events["supervisor/state"] = [state]
    rig.tick(20)


def test_a_driver_that_wakes_and_hears_the_watchdog_holds(rig: Rig) -> None:
    rig.port.commanded_by = [b"watchdog"] * 16
    rig.tick(20)
    assert rig.status.mode == RobotStatus.MODE_SAFE_HOLD
    assert rig.status.cause == RobotStatus.CAUSE_DEVICE
    assert rig.status.reason == "another process, likely the watchdog, commands the arm"
    assert np.abs(rig.port.torques[-1]).max() < 0.5, "damping alone"


def test_a_release_lasts_only_when_nobody_else_commands(rig: Rig) -> None:
    rig.port.commanded_by = [b"watchdog"]
    rig.tick(20)
    release(rig)
    assert rig.status.mode == RobotStatus.MODE_ACTIVE
    rig.port.commanded_by = [b"watchdog"]
    rig.tick(20)
    assert rig.status.mode == RobotStatus.MODE_SAFE_HOLD


def test_a_new_driver_takes_over_from_a_watchdog_that_still_commands() -> None:
    rig = Rig()
    for _ in range(TAKE_OVER // MS // 2):
        rig.port.commanded_by = [b"watchdog"]
        rig.tick(1)
    rig.tick(600)
    assert rig.status.mode == RobotStatus.MODE_ACTIVE, rig.status.reason


def heard(port: Any, count: int) -> list[bytes]:
    found: list[bytes] = []
    begin = time.monotonic()
    while len(found) < count and time.monotonic() - begin < 20.0:
        found += port()
        time.sleep(0.005)
    return found


def test_over_zenoh_the_sender_of_every_command_is_told(tmp_path: Path) -> None:
    endpoint = f"unixsock-stream/{tmp_path}/lbr.sock"
    node = RosNode("watchdog", 0, BusOptions(listen=(endpoint,)))
    topic, command = "lbr/command/torque", LBRTorqueCommand(np.zeros(7), np.zeros(7))
    commands = node.subscription(topic, TORQUE_COMMAND)
    watchdog, new = node.publisher(topic, TORQUE_COMMAND), node.publisher(topic, TORQUE_COMMAND)
    port = ZenohPort(LbrConnection(router=endpoint))
    try:
        begin = time.monotonic()
        while not (first := port.rivals()) and time.monotonic() - begin < 20.0:
            watchdog.publish(command)
            port.command(np.zeros(7), np.zeros(7))
            time.sleep(0.005)
        assert set(first) == {watchdog.gid}, "the port's own commands are not those of another"
        driver = (set(heard(lambda: commands.others(watchdog.gid), 1))).pop()
        time.sleep(0.2)
        commands.take()
        for publisher in (watchdog, new, watchdog):
            publisher.publish(command)
        assert heard(lambda: commands.others(watchdog.gid), 1) == [new.gid], "not hidden by the newer one of the watchdog"
        assert len({driver, new.gid, watchdog.gid}) == 3
    finally:
        port.close()
        node.close()
