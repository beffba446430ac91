"""Tests of the service with messages encoded and decoded as on the bus."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from planning_fakes import BASE, SMALL, World, hertz, known

from palpate_bus import messages as msg
from palpate_bus.contract import contract
from palpate_bus.contract.port_check import violations
from palpate_bus.messages import MS, OperatorRequest, SupervisorState, header, nanoseconds
from palpate_bus.messages.codes import Phase, Reason
from palpate_bus.messages.geometry import mesh_message, point_message, wrench_message
from palpate_bus.setpoint import ControlMode, Setpoint
from palpate_bus.testing import HandInbox
from palpate_models.robot import lbr
from palpate_models.scenario.schema import Scenario
from palpate_planning.course import ExamStep
from palpate_planning.examination import ExaminationSequence
from palpate_planning.service import PlanningService, create
from palpate_planning.strokes.plan import PerceivedAbdomen

HOME = np.array(lbr.HOME)
OUTPUTS = {topic.name: topic for topic in contract().outputs("planning")}


def status(t: int, q: np.ndarray, w: np.ndarray, mode: int = msg.RobotStatus.MODE_ACTIVE, reason: str = "") -> Any:
    """Return the robot's status with mean joint positions and F/T reading."""
    zero = np.zeros(7)
    cause = msg.RobotStatus.CAUSE_DEVICE if reason else msg.RobotStatus.CAUSE_NONE
    return msg.RobotStatus(header(t), mode, cause, reason, np.array(q), zero, wrench_message(w), zero, 0, "", zero)


def sent(outbox: Any) -> dict[str, Any]:
    """Return the outbox encoded and decoded; fails if a message does not fit its type or ranges."""
    out = {}
    for name, message in outbox.items():
        topic = OUTPUTS[name]
        out[name] = msg.codec.decode(msg.codec.encode(message, topic.type), topic.type)
        assert not topic.frame or message.header.frame_id == topic.frame
    assert {name for name, topic in OUTPUTS.items() if topic.periodic} <= out.keys()
    return out


class BusWorld(World):
    """The closed loop with messages between world and service."""

    def __init__(self) -> None:
        super().__init__(known(**SMALL))
        self.inbox = HandInbox()
        self.damage: Callable[[Any, Any], None] = lambda surface, targets: None
        """Change of a perceived surface and of the targets on the bus."""
        self.silent = False
        """True while `robot/status` does not arrive."""
        self.states: list[Any] = []
        self.events: list[str] = []

    def _examine(self) -> ExaminationSequence:
        self.service = PlanningService(self.settings)
        return self.service._exam

    def view(self, t: int) -> tuple[Any, Any]:
        """Return the surface and the targets as perception sends them at `t` [ns]."""
        surface = mesh_message(header(t, "world"), self.dome.vertices, triangles=self.dome.triangles)
        points, lines = [point_message(p) for p in self.dome.positions], np.asarray(self.dome.lines, dtype=np.uint32)
        normals = [msg.Vector3(0.0, 0.0, 1.0)] * len(points)
        return surface, msg.PalpationTargets(header(t, "world"), points, normals, lines, 5e-4, 20, 1.0, 0, "")

    def step(self) -> ExamStep:
        inbox, t = self.inbox, self.t
        inbox.events = {}
        X_WI, R_WS = self.kinematics.poses(self.q)
        contact = R_WS.T @ self._touch(X_WI)
        w = np.concatenate((contact + self.weight.weight_S(R_WS) + self.bias, np.zeros(3)))
        inbox.stamps["supervisor/state"] = t
        if not self.silent:
            inbox.put("robot/status", status(t, self.q, w))
        if self._answer_at is not None and t >= self._answer_at:
            self._answer_at = None
            surface, targets = self.view(t)
            self.damage(surface, targets)
            inbox.put("perception/surface", surface).put("perception/targets", targets)
        if self.status.phase is Phase.ASSESS:
            inbox.put("assessment/findings", msg.Findings(header(t, "abdomen"), [], [], True))
        out = dict(self.service.step(t, inbox))
        events = [name for name in out if not OUTPUTS[name].periodic]
        if events or t % (50 * MS) == 0:
            out = sent(out)
            assert not [name for name in ("planning/setpoint", "exam/state") if violations(OUTPUTS[name], out[name])]
        assert {nanoseconds(out[name].header.stamp) for name in ("planning/setpoint", "exam/state")} == {t}
        self.states.append(out["exam/state"])
        self.events += events
        if "planning/camera_trigger" in out:
            assert out["planning/camera_trigger"].frames == self.settings.camera.frames
            self._answer_at = t + 300_000_000
        self._obey(Setpoint.from_message(out["planning/setpoint"]))
        self.t += 10_000_000
        return None  # type: ignore[return-value]


def test_an_examination_over_messages() -> None:
    world = BusWorld()
    world.complete()
    assert world.events == ["planning/camera_trigger", "planning/path"] + 3 * ["exam/touches"] + ["exam/correction"]
    assert [s.phase for s in world.states if s.end_tick >= 0] == [Phase.DONE]
    steady = [s for s in world.states if s.steady]
    assert steady
    assert all(s.in_contact and s.phase == Phase.SCAN for s in steady)
    assert [s.depth for s in steady] == pytest.approx([0.010] * len(steady), abs=1e-3)
    assert [s.normal_force for s in steady] == pytest.approx([2.4] * len(steady), rel=0.1)
    facts = world.service.finish()
    assert (facts["phase"], facts["skipped_targets"]) == ("DONE", {})
    assert facts["peak_force_N"] < 4.0


def test_the_first_step_asks_the_arm_for_nothing() -> None:
    out = sent(create(Scenario(robot=BASE)).step(0, HandInbox()))
    assert out["planning/setpoint"].mode == ControlMode.JOINT
    assert not np.any(out["planning/setpoint"].joint_stiffness)
    assert nanoseconds(out["planning/setpoint"].valid_for) == contract().topics["planning/setpoint"].expiry
    assert (out["exam/state"].phase, out["exam/state"].end_tick) == (Phase.HOME, -1)


def test_the_arm_is_held_where_it_was_found() -> None:
    inbox = HandInbox()
    inbox.put("robot/status", status(0, HOME + 0.2, np.zeros(6)))
    setpoint = sent(create(Scenario(robot=BASE)).step(0, inbox))["planning/setpoint"]
    np.testing.assert_allclose(setpoint.joint_position, HOME + 0.2, atol=1e-12)
    assert np.all(setpoint.joint_stiffness > 0)


def test_a_status_without_positions_is_no_measurement() -> None:
    service, inbox, none = PlanningService(known(**SMALL), lockstep=False), HandInbox(), np.zeros(0)
    missing = status(0, none, np.zeros(6), msg.RobotStatus.MODE_IDLE, "no joint states received yet")
    inbox.put("robot/status", replace(missing, velocity=none))
    for t in (0, 6000 * MS):
        out = service.step(t, inbox)
    assert "planning/setpoint" not in out
    assert (out["exam/state"].reason, out["exam/state"].phase) == (Reason.WAITS_FOR_ROBOT, Phase.HOME)
    assert out["exam/state"].message == "the robot is not ready: no joint states received yet"
    inbox.put("robot/status", status(6010 * MS, HOME + 0.2, np.zeros(6)))
    out = sent(service.step(6010 * MS, inbox))
    np.testing.assert_allclose(out["planning/setpoint"].joint_position, HOME + 0.2, atol=1e-12)


def idle(reason: str, mode: int = msg.RobotStatus.MODE_IDLE) -> Any:
    return status(10 * MS, HOME, np.zeros(6), mode, reason)


SOFT_STOP = SupervisorState(header(10 * MS), SupervisorState.LEVEL_SOFT_STOP, 2, "depth 27 mm", 0, 9.0, 0.027, 0.0, 0, "", 9.0)
CAUSES = {
    "hold": ("robot/status", idle("force 41 N", msg.RobotStatus.MODE_SAFE_HOLD), Reason.ROBOT_HOLD),
    "not ready": ("robot/status", idle("MONITORING_READY"), Reason.ROBOT_NOT_READY),
    "idle again": ("robot/status", idle(""), Reason.ROBOT_NOT_READY),
    "operator": ("operator/request", OperatorRequest(header(10 * MS), OperatorRequest.STOP, "enough"), Reason.OPERATOR_STOP),
    "soft stop": ("supervisor/state", SOFT_STOP, Reason.SOFT_STOP),
}


def after(topic: str, message: Any) -> Any:
    """Return the state of an examination under way after a message, or after the loss of a role if there is none."""
    service, inbox = create(Scenario(robot=BASE)), HandInbox()
    inbox.put("robot/status", status(0, HOME, np.zeros(6)))
    for t in (0, 10 * MS):
        service.step(t, inbox)
    if message is None:
        inbox.gone.add(topic)
    else:
        inbox.receive({topic: message})
    return sent(service.step(20 * MS, inbox))["exam/state"]


@pytest.mark.parametrize(("topic", "message", "reason"), CAUSES.values(), ids=CAUSES)
def test_holds_and_stops_wait(topic: str, message: Any, reason: Reason) -> None:
    state = after(topic, message)
    assert (state.reason, state.phase, state.end_tick) == (reason, Phase.HELD, -1)


def test_a_lost_robot_aborts() -> None:
    state = after("robot", None)
    assert (state.reason, state.phase, state.end_tick) == (Reason.SERVICE_LOST, Phase.ABORTED, 1020 * MS)


def test_nothing_is_pressed_without_measurements() -> None:
    world = BusWorld()
    world.force = hertz(25.0)
    world.run(lambda: world.pressed > 5.0)
    pressed, world.silent = [world.pressed], True
    for _ in range(25):
        world.step()
        pressed.append(world.pressed)
    assert (*world.end, world.status.cause.culprit) == (Phase.HELD, Reason.ROBOT_NOT_READY, "robot/status")
    assert pressed[-1] < max(pressed) < pressed[0] + 4.0
    world.silent = False
    world.step()
    assert world.end == (Phase.RETRACT, Reason.NONE)


def test_targets_are_used_with_their_own_surface_alone() -> None:
    world, inbox = BusWorld(), HandInbox()
    for t in (0, 10 * MS):
        surface, targets = world.view(t)
        assert world.service._new_surface(inbox.receive({"perception/targets": targets})) is None
        assert isinstance(world.service._new_surface(inbox.receive({"perception/surface": surface})), PerceivedAbdomen)


def test_a_supervisor_that_never_sent_anything_is_lost() -> None:
    service, inbox = PlanningService(known(**SMALL)), HandInbox()
    ends = []
    for t in (0, 1200 * MS, 1300 * MS):
        inbox.put("robot/status", status(t, HOME, np.zeros(6)))
        ends.append(sent(service.step(t, inbox))["exam/state"])
    assert [(end.phase, end.culprit) for end in ends[1:]] == [(Phase.LOOK, ""), (Phase.ABORTED, "supervisor/state")]


@pytest.mark.parametrize("coincident", [False, True])
def test_a_damaged_surface_and_coincident_targets_cause_a_new_scan(coincident: bool) -> None:
    world, looks = BusWorld(), []

    def damage(surface: Any, targets: Any) -> None:
        looks.append(surface)
        if len(looks) == 1 and coincident:
            targets.positions[1] = targets.positions[0]
        elif len(looks) == 1:
            surface.triangles[7] = 4294967269

    world.damage = damage
    world.run_to(Phase.INDENT)
    assert len(looks) == 2
