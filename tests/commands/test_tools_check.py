"""The conformance suites: every implementation that we have passes its own, and a spoilt one is caught by name."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from palpate.check.live_rig import LiveRig
from palpate.check.perform import started
from palpate.check.report import ConformanceReport
from palpate.check.rig import RigSettings, ServiceRig
from palpate.check.suites import LASTS_S, SUITES, check
from palpate.check.suites.tissue import STILL
from palpate_bus.implementations import create, names
from palpate_bus.messages import JointTorqueCommand, Point, Pose
from palpate_bus.messages.stamps import NS
from palpate_bus.service import Inbox, Outbox, Service
from palpate_bus.wire.zenoh_config import BusOptions, session
from palpate_models.scenario.load import load_scenario

SCENARIO = load_scenario("clean", STILL)
HARDWARE = {"robot.lbr", "camera.ros", "camera.replay"}
"""By the wall clock only: `palpate check` takes them live; and the replay, whose own tests check it on a recorded plane."""
SLOW = {"robot.mujoco", "supervisor.default", "tissue.elastic"}
IMPLEMENTATIONS = sorted({f"{role}.{name}" for role in SUITES for name in names(role)} - HARDWARE)


def made(name: str) -> Service:
    role, _, choice = name.partition(".")
    return create(role, choice or getattr(SCENARIO.services, role), SCENARIO)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in IMPLEMENTATIONS]
)
def test_an_implementation_of_ours_conforms(name: str) -> None:
    rig = ServiceRig(made(name), RigSettings(SCENARIO))
    report = check(rig)
    assert report.failed == []
    assert rig.t / NS == pytest.approx(LASTS_S[rig.role.name], rel=0.25)
    assert report.passed
    assert len(report.results) > 10


class Spoilt(Service):
    """A service whose outbox is changed before it is sent."""

    def __init__(self, inner: Service, change: Callable[[int, dict[str, Any]], None]) -> None:
        self.role = inner.role  # type: ignore[misc]
        self._inner, self._change = inner, change

    def start(self) -> Outbox:
        return self._inner.start()

    def step(self, t: int, inbox: Inbox) -> Outbox:
        outbox = dict(self._inner.step(t, inbox))
        self._change(t, outbox)
        return outbox


def wrong_effort_sign(t: int, outbox: dict[str, Any]) -> None:
    outbox["joint_states"].effort = -outbox["joint_states"].effort


def wrong_wrench_sign(t: int, outbox: dict[str, Any]) -> None:
    force = outbox["ft/wrench"].wrench.force
    force.x, force.y, force.z = -force.x, -force.y, -force.z


def wrong_frame(t: int, outbox: dict[str, Any]) -> None:
    outbox["ft/wrench"].header.frame_id = "lbr_link_ee"


def every_other(t: int, outbox: dict[str, Any]) -> None:
    if t // 1_000_000 % 2:
        outbox.pop("joint_states")


def never_holds(t: int, outbox: dict[str, Any]) -> None:
    if "robot/status" in outbox:
        outbox["robot/status"].mode = 1


def degrees(t: int, outbox: dict[str, Any]) -> None:
    outbox["joint_states"].position = np.rad2deg(outbox["joint_states"].position)


def pulls(t: int, outbox: dict[str, Any]) -> None:
    force = outbox["sim/contact_wrench"].wrench.force
    force.x, force.y, force.z = -force.x, -force.y, -force.z


def never_expires(t: int, outbox: dict[str, Any]) -> None:
    command = outbox["control/joint_torque"]
    if command.valid_for.nanosec == 0:
        command.valid_for.nanosec = 50_000_000


def wrong_torque_sign(t: int, outbox: dict[str, Any]) -> None:
    command = outbox["control/joint_torque"]
    outbox["control/joint_torque"] = JointTorqueCommand(command.header, -command.torque, command.valid_for, command.problem)


def elsewhere(t: int, outbox: dict[str, Any]) -> None:
    if "truth/patient" in outbox:
        patient = outbox["truth/patient"]
        outbox["truth/patient"] = replace(patient, pose=Pose(Point(0.0, 0.0, 1.0), patient.pose.orientation))


def millimetres(t: int, outbox: dict[str, Any]) -> None:
    image = outbox.get("camera/depth/image_raw")
    if image is not None:
        image.data = (1000 * image.data.view("<f4")).astype("<f4").view(np.uint8)


def inward_normals(t: int, outbox: dict[str, Any]) -> None:
    if "perception/surface" in outbox:
        outbox["perception/surface"].normals = -outbox["perception/surface"].normals


def two_ends(t: int, outbox: dict[str, Any]) -> None:
    if "assessment/findings" in outbox:
        outbox["assessment/findings"] = [outbox["assessment/findings"]] * 2


SPOILT = [
    ("robot", wrong_effort_sign, "effort reports the applied torque"),
    ("robot", wrong_wrench_sign, "ft/wrench shows a push of 10 N with its sign"),
    ("robot", wrong_frame, "ft/wrench: values"),
    ("robot", every_other, "joint_states: rate"),
    ("robot", never_holds, "holds safely when commands cease"),
    ("robot", degrees, "joints within their limits"),
    ("tissue", pulls, "a pressed surface pushes back, outward"),
    ("tissue", elsewhere, "truth/patient: lies where truth/phantom says"),
    ("control", never_expires, "stops commanding when set-points cease"),
    ("control", wrong_torque_sign, "mode CARTESIAN: the torques of stiffness times offset, J^T F"),
    ("camera", millimetres, "a level plane is where it is"),
    ("perception", inward_normals, "with outward normals"),
    ("assessment", two_ends, "final findings once"),
]


QUICKLY_SPOILT = ("control", "perception", "tissue")


@pytest.mark.parametrize(
    ("name", "change", "caught_by"),
    [pytest.param(*row, id=row[1].__name__, marks=[] if row[0] in QUICKLY_SPOILT else [pytest.mark.slow]) for row in SPOILT],
)
def test_a_spoilt_implementation_is_caught(name: str, change: Callable[[int, dict[str, Any]], None], caught_by: str) -> None:
    report = check(ServiceRig(Spoilt(made(name), change), RigSettings(SCENARIO)))
    assert caught_by in [result.name for result in report.failed]


def test_a_robot_is_not_moved_without_consent() -> None:
    rig = ServiceRig(made("robot"), RigSettings(SCENARIO, motion=False))
    report = check(rig)
    assert report.failed == []
    assert any("--motion" in result.got for result in report.results)
    q = np.array([heard.message.position for heard in rig.log["joint_states"]])
    assert np.ptp(q, axis=0).max() < 1e-3


TIMELY = ("rate", "stamps", "within", "sequence")
"""Checks whose verdict depends on how busy this machine is: not asserted here."""


@pytest.mark.slow
@pytest.mark.parametrize("role", ["planning", "camera", "perception"])
def test_a_process_on_a_live_bus_conforms(role: str, tmp_path: Any) -> None:
    where = f"unixsock-stream/{tmp_path}/router.sock"
    settings = RigSettings(SCENARIO, slack_ms=3000)
    report = ConformanceReport(role)
    with session(BusOptions(mode="router", listen=(where,))) as bus:
        rig = LiveRig(bus, role, settings)
        try:
            with started(shlex.join([sys.executable, "-m", "palpate.service", role]), role, settings, where, 0):
                rig.await_implementation(90, report)
                check(rig, report)
                rig.finish(report)
        finally:
            rig.close()
    failed = [result for result in report.failed if not any(word in result.name for word in TIMELY)]
    assert failed == []
    names = {result.name for result in report.results}
    assert {"answers the conductor's hello", "garbage on its inputs does not stop it", "reports FINISHED at the end"} <= names
    assert rig.facts["garbage"] > 0
    assert rig.facts["foreign"] > 0
    assert rig.facts["undecodable"] > 0
