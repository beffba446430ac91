"""The conformance suites: every implementation passes its own, and a faulty one is named."""

import shlex
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from palpate.check.perform import LiveRig, start_implementation
from palpate.check.rig import RigSettings, ServiceRig
from palpate.check.suites import SUITES, check, control, robot
from palpate.check.suites.tissue import STILL
from palpate_bus.contract.port_check import RefusedMessage
from palpate_bus.implementations import create, kind
from palpate_bus.messages import MS, NS, Point, Pose, RobotStatus, SupervisorState, Vector3, codec, duration_message
from palpate_bus.service import Inbox, Outbox, Service
from palpate_bus.wire.zenoh_config import BusOptions, session
from palpate_models.scenario.load import load_scenario
from palpate_robot.driver import Driver

SCENARIO = load_scenario("clean", STILL)
HARDWARE = {"robot.lbr", "robot.ros2_control", "camera.ros", "camera.replay"}
"""Implementations for wall-clock mode, which `palpate check` checks live, and the replay, which has its own tests."""
SLOW = {"robot.mujoco", "tissue.elastic"}
IMPLEMENTATIONS = sorted({f"{role}.{name}" for role in SUITES for name in kind(role).names()} - HARDWARE)


def made(name: str) -> Service:
    role, _, choice = name.partition(".")
    return create(role, choice or getattr(SCENARIO.services, role), SCENARIO)


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] if n in SLOW else []) for n in IMPLEMENTATIONS])
def test_an_implementation_conforms(name: str) -> None:
    rig = ServiceRig(made(name), RigSettings(SCENARIO))
    report = check(rig)
    assert (report.failed, report.passed) == ([], True)
    assert rig.t / NS == pytest.approx(SUITES[rig.role.name], rel=0.25)
    assert len(report.results) > 10


class Faulty(Service):
    """A service with one topic whose messages are changed, or left out where `change` returns None."""

    def __init__(self, inner: Service, topic: str, change: Callable[[Any], Any]) -> None:
        self.role = inner.role  # type: ignore[misc]
        self._inner, self._topic, self._change = inner, topic, change

    def start(self) -> Outbox:
        return self._inner.start()

    def step(self, t: int, inbox: Inbox) -> Outbox:
        outbox = self._inner.step(t, inbox)
        changed = {topic: self._change(sent) if topic == self._topic else sent for topic, sent in outbox.items()}
        return {topic: sent for topic, sent in changed.items() if sent is not None}


def opposite_force(message: Any) -> Any:
    force = message.wrench.force
    return replace(message, wrench=replace(message.wrench, force=Vector3(-force.x, -force.y, -force.z)))


FAULTS: dict[str, tuple[str, Callable[[Any], Any], str]] = {
    "robot: effort sign": ("joint_states", lambda m: replace(m, effort=-m.effort), "effort reports the applied torque"),
    "robot: wrench sign": ("ft/wrench", opposite_force, "ft/wrench shows a push of 10 N with its sign"),
    "robot: frame": ("ft/wrench", lambda m: replace(m, header=replace(m.header, frame_id="lbr_link_ee")), "ft/wrench: values"),
    "robot: every other": ("joint_states", lambda m: None if m.header.stamp.nanosec // MS % 2 else m, "joint_states: rate"),
    "robot: never holds": ("robot/status", lambda m: replace(m, mode=1), "holds safely when commands cease"),
    "robot: degrees": ("joint_states", lambda m: replace(m, position=np.rad2deg(m.position)), "joints within their limits"),
    "tissue: pulls": ("sim/contact_wrench", opposite_force, "a pressed surface pushes back, outward"),
    "tissue: elsewhere": (
        "truth/patient",
        lambda m: replace(m, pose=Pose(Point(0.0, 0.0, 1.0), m.pose.orientation)),
        "truth/patient: at the pose of truth/phantom",
    ),
    "control: never expires": (
        "control/joint_torque",
        lambda m: replace(m, valid_for=duration_message(50 * MS)),
        "stops commanding when set-points cease",
    ),
    "control: torque sign": (
        "control/joint_torque",
        lambda m: replace(m, torque=-m.torque),
        "mode CARTESIAN: the torques of stiffness times offset, J^T F, or the positions of the pose",
    ),
    "camera: millimetres": (
        "camera/depth/image_raw",
        lambda m: replace(m, data=(1000 * m.data.view("<f4")).view(np.uint8)),
        "a level plane is where it is",
    ),
    "perception: inward": ("perception/surface", lambda m: replace(m, normals=-m.normals), "with outward normals"),
    "assessment: two ends": ("assessment/findings", lambda m: [m] * 2, "final findings once"),
    "supervisor: half force": ("supervisor/state", lambda m: replace(m, force=m.force / 2), "force is that on the tool"),
    "supervisor: never stops": ("supervisor/state", lambda m: replace(m, level=0, cause=0), "stops for a tool too fast"),
    "supervisor: forgets": (
        "supervisor/state",
        lambda m: replace(m, level=0) if m.cause == SupervisorState.CAUSE_OPERATOR else m,
        "it stays, with the operator's reason",
    ),
    "supervisor: soft only": (
        "supervisor/state",
        lambda m: replace(m, level=min(m.level, 1)),
        "stops for a force over the emergency limit",
    ),
}
FAST = ("control", "perception", "tissue")


@pytest.mark.parametrize(
    "fault", [pytest.param(name, marks=[] if name.startswith(FAST) else [pytest.mark.slow]) for name in FAULTS]
)
def test_a_faulty_implementation_is_named(fault: str) -> None:
    topic, change, named = FAULTS[fault]
    report = check(ServiceRig(Faulty(made(fault.partition(":")[0]), topic, change), RigSettings(SCENARIO)))
    assert named in [result.name for result in report.failed]


def test_a_robot_is_not_moved_without_consent() -> None:
    rig = ServiceRig(made("robot"), RigSettings(SCENARIO, motion=False))
    report = check(rig)
    assert report.failed == []
    assert any("--motion" in result.got for result in report.results)
    q = np.array([logged.message.position for logged in rig.log["joint_states"]])
    assert np.ptp(q, axis=0).max() < 1e-3


def test_a_service_is_fed_through_the_check_of_its_ports() -> None:
    rig = ServiceRig(made("control"), RigSettings(SCENARIO))
    arm = control.Played(rig)
    for q, count in ((np.nan * arm.home, 0), (arm.home, 1)):
        rig.send("joint_states", arm.joints(q)(0))
        assert len(rig._stepper.buffers["joint_states"].pending) == count


class RefusingRig(ServiceRig):
    """A rig whose ports refuse messages that break the contract, as on a live bus."""

    live = True

    def __init__(self, service: Service, settings: RigSettings) -> None:
        super().__init__(service, settings)
        self.torques: list[float] = []
        """Largest torque of each command [N m]."""

    def send(self, topic: str, message: Any) -> None:
        row, buffer = self.contract.topics[topic], self._stepper.buffers[topic]
        if topic == robot.COMMAND and len(message.torque):
            self.torques.append(float(np.max(message.torque)))
        with suppress(RefusedMessage):
            buffer.check(buffer.decode(codec.encode(message, row.type)), self.t)
            super().send(topic, message)


def test_a_live_robot_is_commanded_little_beyond_its_limit_and_may_refuse_it() -> None:
    rig = RefusingRig(made("robot"), RigSettings(SCENARIO, slack_ms=20))
    rig.run(0.1, robot.quiet(rig))
    rig.run(0.7, robot.commanding(rig, np.zeros(robot._arm(rig).joints)))  # longer than the port takes equal commands
    robot._expect_mode(rig, "is active", RobotStatus.MODE_ACTIVE)
    robot._invalid(rig)
    assert len(rig.report.results) == 3
    assert rig.report.failed == []
    (beyond,) = (torque for torque in rig.torques if torque > 10)
    assert 1.0 < beyond / robot._arm(rig).torque_nm[0] < 1.05


def test_a_live_robot_that_applies_what_is_beyond_its_limit_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ServiceRig, "live", True)
    monkeypatch.setattr(Driver, "_torque_fault", lambda *_: None)
    rig = ServiceRig(made("robot"), RigSettings(SCENARIO, slack_ms=20))
    rig.run(0.1, robot.quiet(rig))
    robot._provoke(rig, "a torque", robot.TOUCH.beyond * np.eye(7)[0] * robot._arm(rig).torque_nm, RobotStatus.CAUSE_TORQUE_LIMIT)
    assert [result.name for result in rig.report.failed] == ["a torque makes it hold"]


TIMELY = ("rate", "stamps", "within", "sequence")
"""Checks whose verdict depends on the load of this machine: not asserted here."""


@pytest.mark.slow
@pytest.mark.parametrize("role", ["planning", "camera", "perception"])
def test_a_process_on_a_live_bus_conforms(role: str, tmp_path: Any) -> None:
    where = f"unixsock-stream/{tmp_path}/router.sock"
    settings = RigSettings(SCENARIO, slack_ms=3000)
    with session(BusOptions(mode="router", listen=(where,))) as bus:
        rig = LiveRig(bus, role, settings)
        try:
            with start_implementation(shlex.join([sys.executable, "-m", "palpate.service", role]), role, settings, where, 0):
                rig.await_implementation(90)
                report = check(rig)
                rig.finish()
        finally:
            rig.close()
    assert [result for result in report.failed if not any(word in result.name for word in TIMELY)] == []
    checked = {result.name for result in report.results}
    assert {"answers the conductor's hello", "garbage on its inputs does not stop it", "reports FINISHED at the end"} <= checked
    assert all(rig.facts[kind] > 0 for kind in ("garbage", "foreign", "undecodable"))
