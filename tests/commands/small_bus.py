"""A bus with a robot that publishes three topics, announced as a run, in this process."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from palpate_bus.contract import MS, contract
from palpate_bus.messages import JointState, String, Vector3, Wrench, WrenchStamped, codec
from palpate_bus.messages.stamps import header
from palpate_bus.runs.announcement import Announcement, Run
from palpate_bus.wire.liveliness import NodeTokens
from palpate_bus.wire.rmw import topic_key
from palpate_bus.wire.transport import Publisher
from palpate_bus.wire.zenoh_config import mesh, session

RULES = contract()
NAMES = [f"lbr_A{i}" for i in range(1, 8)]


def joint_state(t: int) -> Any:
    return JointState(header(t), NAMES, np.linspace(0, 0.6, 7), np.zeros(7), np.zeros(7))


def wrench(t: int) -> Any:
    return WrenchStamped(header(t, "ft_sensor"), Wrench(Vector3(1.0, -2.0, 3.5), Vector3(0.0, 0.0, 0.0)))


class SmallRobot:
    """Publishes `joint_states` and `ft/wrench` with right stamps, as fast as 5 ms a tick of 1 ms lets it, and its description."""

    def __init__(self, bus: zenoh.Session, domain: int) -> None:
        self.bus = bus
        self.domain = domain
        self._tokens = tokens = NodeTokens(bus, "robot", domain)  # withdrawn when nobody holds them
        self._publishers = {}
        for name in ("joint_states", "ft/wrench", "robot_description"):
            topic = RULES.topics[name]
            qos = RULES.qos[topic.qos]
            self._publishers[name] = Publisher(bus, topic_key(topic, domain), qos, tokens.publisher(topic, qos))
        self.spoil = lambda message: message
        """Changes a joint state before it is sent."""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        self._put("robot_description", String("<robot/>"), 1)
        sequence = 0
        while not self._stop.is_set():
            for _ in range(2):
                sequence += 1
                t = (sequence - 1) * MS
                self._put("joint_states", self.spoil(joint_state(t)), sequence)
                self._put("ft/wrench", wrench(t), sequence)
            time.sleep(0.01)

    def _put(self, name: str, message: Any, sequence: int) -> None:
        self._publishers[name].put(codec.encode(message, RULES.topics[name].type), sequence)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()


@contextmanager
def small_bus(folder: Path, domain: int = 0) -> Iterator[SmallRobot]:
    """The robot on a bus of its own, announced."""
    options = mesh(["robot"], folder)["robot"]
    missed = {role: options.listen[0].replace("robot", role) for role in ("control", "tissue")}
    run = Run(name="small", endpoints={"robot": options.listen[0], **missed}, domain=domain)
    with session(options) as bus:
        announcement = Announcement(run)
        robot = SmallRobot(bus, domain)
        robot.start()
        try:
            yield robot
        finally:
            robot.stop()
            announcement.withdraw()
