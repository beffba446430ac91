"""The driver of ros2_control on the emulator of each profile, in simulated time."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate_bus.contract import contract
from palpate_bus.contract.port_check import PortCheck
from palpate_bus.messages import JointState, JointTorqueCommand, RobotStatus, WrenchStamped, blank, duration_message, header
from palpate_bus.messages.codes import DriverMode, HoldCause
from palpate_bus.messages.geometry import pose_message, wrench_message
from palpate_bus.testing import HandInbox
from palpate_errors import UserError
from palpate_models.robot.arm import arm_of, tool_pose
from palpate_models.robot.chain import Arm
from palpate_models.robot.urdf_arm import load_arm
from palpate_models.scenario.load import exam_input, load_scenario
from palpate_models.scenario.schema import arm_path
from palpate_robot.backends.ros2_control.port import POSE, FlangePose, Ros2Port, StackStatus
from palpate_robot.backends.ros2_control.profile import profile_of
from palpate_robot.backends.ros2_control.rules import FrankaRules, Sensed, UrRules
from palpate_robot.backends.ros2_control.service import FirstContactCheck, Ros2ControlService, create
from palpate_robot.backends.ros2_control.watchdog import command_of

MS = 1_000_000
WALL_NPM = 2000.0
ARMS = [("panda", "franka"), ("ur5", "ur")]


class Ros2Bench:
    """Driver and emulator; every tick commands zero torque, or that the first joint moves, or presses on a wall at the tool."""

    def __init__(self, arm: str, profile: str, *changes: str) -> None:
        settings = [f"robot.arm={arm}", f"robot.driver.profile={profile}", "robot.driver.emulated=true", *changes]
        self.driver = create(load_scenario("clean", ["services.robot=ros2_control", *settings]))
        self.inbox = HandInbox()
        self.t = -MS
        self.status: Any = None
        self.emulator = self.driver._port.emulator
        self.speed_radps, self.torque_nmps, self.press = 0.0, 0.0, False
        self.peak_n, self.states = 0.0, 0
        self._checks = {topic.name: PortCheck(topic, sends=True) for topic in contract().outputs("robot")}
        self._start: Any = None
        self._wall_m = self._height_m()

    def _height_m(self) -> float:
        return float(self.emulator._plant.tool_motion()[2])

    def tick(self, ticks: int) -> None:
        for _ in range(ticks):
            self.t += MS
            self.emulator.force_W[2] = WALL_NPM * max(self._wall_m - self._height_m(), 0.0)
            self.peak_n = max(self.peak_n, self.emulator.force_W[2])
            outbox = self.driver.step(self.t, self.inbox)
            self.status = outbox.get("robot/status", self.status)
            assert {"joint_states", "ft/wrench", "sim/tool_state"} <= outbox.keys(), "lockstep needs them on every tick"
            for name, message in outbox.items():
                self._checks[name](message, self.t)
            self.states = self.driver._states
            if self._start is None and "joint_states" in outbox:
                self._start, self._begun = outbox["joint_states"].position.copy(), self.t
            if self._start is not None:
                self.inbox.messages["control/joint_torque"] = self._command()

    def _command(self) -> Any:
        values, none = np.zeros(len(self._start)), np.zeros(0)
        elapsed_s = (self.t - self._begun) * 1e-9
        if self.driver._positions:
            values = self._start.copy()
            values[0] += self.speed_radps * elapsed_s
        else:
            values[0] = self.torque_nmps * elapsed_s
        if self.press:
            J = np.array([self.driver._model.external_torque(self._start, axis) for axis in np.eye(6)])
            down = min(elapsed_s, 0.8) * np.array((0.0, 0.0, -1.0, 0.0, 0.0, 0.0))
            values = self._start + np.linalg.pinv(J) @ (0.005 * down) if self.driver._positions else J.T @ (10.0 * down)
        torque, position = (none, values) if self.driver._positions else (values, none)
        return JointTorqueCommand(header(self.t), torque, position, duration_message(50 * MS), "", "")


@pytest.mark.parametrize(("arm", "profile"), ARMS)
def test_the_emulated_arm_takes_commands(arm: str, profile: str) -> None:
    bench = Ros2Bench(arm, profile)
    bench.speed_radps = 0.1
    bench.tick(400)
    assert bench.status.mode == RobotStatus.MODE_ACTIVE, bench.status.reason
    moved = bench.driver._arm.q - bench._start
    assert moved[0] == pytest.approx(0.1 * 0.4 if bench.driver._positions else 0.0, abs=0.02)
    assert np.abs(moved[1:]).max() < 0.01
    external = np.linalg.norm(bench.driver._external_S)
    assert external < 6.0, "the tool's weight is in ft/wrench, whatever the stack reports"


PROVOKED = {
    "force reflex": ("franka", "collision 5", "no joint states"),
    "torque reflex": ("franka", "collision_torque 2", "no joint states"),
    "lost packets": ("franka", "lose 20", "no joint states"),
    "inactive controller of torques": ("franka", "controller 0", "does not follow"),
    "protective stop": ("ur", "protective 5", "the external control program does not run"),
    "pendant": ("ur", "speed 0.5", "speed is scaled to 50 %"),
    "remote control off": ("ur", "remote 0", "the external control program does not run"),
    "inactive controller of positions": ("ur", "controller 0", "does not follow"),
}


@pytest.mark.parametrize(("profile", "event", "reported"), PROVOKED.values(), ids=PROVOKED)
def test_a_rule_ends_a_press_and_is_reported(profile: str, event: str, reported: str) -> None:
    bench = Ros2Bench({p: a for a, p in ARMS}[profile], profile, f'robot.driver.events=["0.15 {event}"]')
    bench.press = "follow" not in reported
    bench.speed_radps, bench.torque_nmps = 0.3, 30.0
    bench.tick(900)
    assert (bench.driver._driver.mode, bench.driver._driver.cause) == (DriverMode.SAFE_HOLD, HoldCause.DEVICE)
    assert reported in bench.driver._driver.reason
    assert bench.peak_n < 15.0
    assert bench.peak_n > 1.0 or not bench.press


@pytest.mark.parametrize(("arm", "profile"), ARMS)
def test_a_wrong_sign_of_the_wrench_is_reported_at_the_first_contact(arm: str, profile: str) -> None:
    right, wrong = Ros2Bench(arm, profile), Ros2Bench(arm, profile, "robot.driver.ft_sign=-1", "robot.driver.ft_weight=false")
    for bench in (right, wrong):
        bench.press = True
        bench.tick(600)
        assert bench.peak_n < 15.0
    assert right.driver._driver.mode is DriverMode.ACTIVE, right.status.reason
    assert right.driver.finish()["first_contact_checked"]
    assert "pulls the tool out" in wrong.driver._driver.reason


def test_a_reflex_lasts_until_recovered_and_the_driver_holds_until_released() -> None:
    bench = Ros2Bench("panda", "franka", 'robot.driver.events=["0.1 lose 20", "0.3 recover 1"]')
    bench.tick(250)
    assert bench.emulator.rules.stopped == "communication_constraints_violation"
    states = bench.states
    bench.tick(40)
    assert bench.states == states
    bench.tick(100)
    assert bench.states > states
    assert bench.driver._driver.held
    bench.driver._driver.release(bench.t)
    bench.tick(50)
    assert bench.driver._driver.mode is DriverMode.ACTIVE


class HandPort(Ros2Port):
    """An arm that is where it is put."""

    def __init__(self, arm: Arm) -> None:
        self.names, self.q, self.running, self.t = list(arm.joint_names), arm.home_rad.copy(), True, 0
        self.silent = False
        self.sent: list[Any] = []
        self.poses: list[Any] = []

    def states(self) -> list[Any]:
        self.t += MS
        return [] if self.silent else [JointState(header(self.t), self.names, self.q, 0.01 + 0 * self.q, 0 * self.q)]

    def wrenches(self) -> list[Any]:
        return [WrenchStamped(header(self.t), wrench_message(np.zeros(6)))]

    def command(self, q: Any, values: Any) -> None:
        self.sent.append(np.array(values))

    def pose(self, X_BU: Any) -> None:
        self.poses.append(X_BU)

    def status(self) -> StackStatus:
        return StackStatus(1.0, self.running)


def by_hand(arm: str, profile: str, *changes: str) -> tuple[Ros2ControlService, HandPort]:
    exam = exam_input(load_scenario("clean", [f"robot.arm={arm}", f"robot.driver.profile={profile}", *changes]))
    port = HandPort(arm_of(exam.robot))
    return Ros2ControlService(exam, port, profile_of(exam.robot)), port


@pytest.mark.parametrize("silent", [False, True])
def test_a_hold_of_an_arm_that_takes_positions_does_not_go_back(silent: bool) -> None:
    bench = Ros2Bench("ur5", "ur")
    bench.speed_radps = 0.5
    bench.tick(400)
    if silent:  # control ends
        last = bench.inbox.messages["control/joint_torque"]
        bench._command = lambda: last  # type: ignore[method-assign]
    else:
        bench.driver._driver.hold(bench.t, HoldCause.STOP_REQUESTED, "stop")
    sent, q = [bench.emulator.command[0]], []
    for _ in range(250):
        bench.tick(1)
        sent.append(bench.emulator.command[0])
        q.append(bench.emulator._plant.q[0])
    assert np.diff(sent).min() > -1e-9
    assert np.diff(sent)[-1] == pytest.approx(0.0, abs=1e-9)
    assert max(q) - q[-1] < 1e-3
    assert bench.driver._driver.held


def test_the_emulated_position_loop_takes_each_command_once() -> None:
    bench, speeds = Ros2Bench("ur5", "ur"), []
    bench.speed_radps = 0.3
    bench.tick(400)
    for _ in range(50):
        bench.tick(1)
        speeds.append(bench.emulator._loop._rd[0])
    assert speeds == pytest.approx([0.3] * 50, abs=1e-3), "one that is taken twice stands every other millisecond"


def test_an_arm_that_was_moved_by_hand_stays_where_it_was_put() -> None:
    driver, port = by_hand("ur5", "ur")
    inbox, t = HandInbox(), 0

    def tick(ticks: int = 30, target: Any = None) -> DriverMode:
        nonlocal t
        for _ in range(ticks):
            t += MS
            if target is not None:
                command = JointTorqueCommand(header(t), np.zeros(0), target, duration_message(50 * MS), "", "")
                inbox.messages["control/joint_torque"] = command
            driver.step(t, inbox)
        return driver._driver.mode

    assert tick(target=port.q) is DriverMode.ACTIVE
    port.running = False
    tick()
    port.q = port.q + 0.3
    assert tick() is DriverMode.SAFE_HOLD
    assert port.sent[-1] == pytest.approx(port.q)
    port.running = True
    tick()
    assert port.sent[-1] == pytest.approx(port.q, abs=1e-3)
    driver._driver.release(t)
    assert tick() is DriverMode.IDLE
    port.q = port.q + 0.3
    driver._driver.hold(t, HoldCause.STOP_REQUESTED, "stop")
    tick()
    assert port.sent[-1] == pytest.approx(port.q, abs=1e-3)


def test_a_cartesian_controller_is_sent_poses_only_and_those_of_its_own_flange(tmp_path: Path) -> None:
    turned = tmp_path / "turned.yaml"
    turned.write_text(arm_path("panda").read_text() + "\nflange_rpy_rad: [0.0, 0.0, 0.7854]\n")
    poses = []
    for arm in ("panda", str(turned)):
        driver, port = by_hand(arm, "franka", "robot.level=setpoint")
        for k in range(5):
            driver.step(k * MS, HandInbox())
        driver.finish()
        assert not port.sent, "its topic takes no torques"
        poses.append(port.poses[-1])
    np.testing.assert_allclose(poses[1], poses[0], atol=1e-6)


def test_a_status_without_states_has_no_positions() -> None:
    driver, port = by_hand("panda", "franka")
    positions = []
    for t in range(0, 400 * MS, MS):
        port.silent = not 100 * MS <= t < 200 * MS
        if status := driver.step(t, HandInbox()).get("robot/status"):
            positions.append(len(status.position))
    assert positions == [0] * 10 + [7] * 11 + [0] * 19


def test_a_cartesian_controller_is_left_without_a_pull() -> None:
    driver, port = by_hand("panda", "franka", "robot.level=setpoint")
    inbox, t, robot = HandInbox(), 0, driver._robot
    X_WI, rest = tool_pose(port.q, robot), FlangePose(robot).at(port.q)

    def tick(ticks: int, planned: bool = True) -> DriverMode:
        nonlocal t
        for _ in range(ticks):
            t += MS
            torque = JointTorqueCommand(header(t), np.full(7, 5.0), np.zeros(0), duration_message(50 * MS), "", "")
            inbox.messages["control/joint_torque"] = torque
            if planned:
                pose, valid = pose_message(X_WI[:3, :3], X_WI[:3, 3] - (0.0, 0.0, 0.02)), duration_message(250 * MS)
                setpoint = replace(blank("palpation_msgs/msg/ImpedanceSetpoint", t, "world"), pose=pose, valid_for=valid)
                inbox.messages["planning/setpoint"] = setpoint
            driver.step(t, inbox)
        return driver._driver.mode

    assert tick(30) is DriverMode.ACTIVE
    assert port.poses[-1][2, 3] == pytest.approx(rest[2, 3] - 0.02)
    assert tick(240, planned=False) is DriverMode.ACTIVE
    assert tick(20, planned=False) is DriverMode.SAFE_HOLD
    assert (driver._driver.cause, driver._driver.culprit) == (HoldCause.COMMAND_EXPIRED, "planning/setpoint")
    driver._driver.release(t)
    assert tick(30) is DriverMode.ACTIVE
    port.silent, sent = True, len(port.poses)
    tick(100)
    np.testing.assert_allclose(port.poses[-1], rest)
    assert len(port.poses) == sent + 1
    assert driver.finish()["peak_torque_nm"] == [0.0] * 7
    kind, command = command_of(robot)
    assert (kind, command(port.q, np.zeros(7)).pose.position.z) == (POSE, pytest.approx(rest[2, 3]))


LATE = {
    "level of the arm": ("ur5", "franka", [], "robot.level: position"),
    "level": ("panda", "franka", ["robot.level=setpoint"], "robot.level: setpoint"),
    "event": ("panda", "franka", ['robot.driver.events=["1 speed 0.5"]'], "robot.driver.events: 'speed 0.5'"),
    "time": ("ur5", "ur", ['robot.driver.events=["soon speed 0.5"]'], "robot.driver.events: 'soon"),
}


@pytest.mark.parametrize(("arm", "profile", "changes", "named"), LATE.values(), ids=LATE)
def test_what_the_emulator_cannot_do_is_refused_at_the_start(arm: str, profile: str, changes: list[str], named: str) -> None:
    with pytest.raises(UserError, match=named):
        Ros2Bench(arm, profile, *changes)


def still(joints: int, force_n: float = 0.0, speed_radps: float = 0.0) -> Sensed:
    return Sensed(np.zeros(joints), np.full(joints, speed_radps), force_n, np.zeros(joints))


def test_a_franka_limits_the_rate_of_torques_or_ends_in_a_reflex_and_keeps_the_last_torque_of_lost_packets() -> None:
    rules, arm = FrankaRules(load_arm("panda")), load_arm("panda")
    applied = np.array([rules.cycle(still(7), np.full(7, 5.0)) for _ in range(8)])
    assert np.diff(applied, axis=0).max() == pytest.approx(1.0)
    assert applied[-1] == pytest.approx(5.0)
    for _ in range(2):  # 20 in a row end it, not 38 of 39
        rules.event("lose 19")
        assert all(np.array_equal(rules.cycle(still(7), np.zeros(7)), applied[-1]) for _ in range(19))
        rules.cycle(still(7), np.full(7, 5.0))
    rules.event("limiter 0")
    assert rules.cycle(still(7), np.full(7, 5.9)) is not None
    assert rules.cycle(still(7), np.full(7, 7.0)) is None
    assert rules.stopped == "controller_torque_discontinuity"
    rules.event("recover 1")
    assert rules.cycle(still(7, speed_radps=float(arm.velocity_radps.max()) + 0.1), np.zeros(7)) is None
    assert rules.stopped == "joint_velocity_violation"


@pytest.mark.parametrize(("settings", "reached_s"), [([], 0.03), (["lookahead 0.2"], 0.2), (["speed 0.5"], 0.06)])
def test_a_ur_follows_with_its_look_ahead_and_slower_at_less_speed(settings: list[str], reached_s: float) -> None:
    rules = UrRules(load_arm("ur5"))
    for event in settings:
        rules.event(event)
    rules.cycle(still(6), np.zeros(6))
    cycles = next(k for k in range(1, 500) if rules.cycle(still(6), np.full(6, 0.01))[0] >= 0.01 * (1 - np.exp(-1)) - 1e-12)
    assert 0.002 * cycles == pytest.approx(reached_s, abs=0.0021)


def test_a_ur_ignores_a_jump_of_the_target_and_is_unlocked_five_seconds_after_a_protective_stop() -> None:
    rules = UrRules(load_arm("ur5"))
    assert rules.cycle(still(6), np.full(6, 0.05)) == pytest.approx(0.0)
    assert rules.cycle(still(6, force_n=60.0), np.zeros(6)) is None
    for seconds, stopped in ((4.9, True), (0.2, False)):
        for _ in range(round(seconds * 500)):
            rules.cycle(still(6), np.zeros(6))
        rules.event("recover 1")
        assert bool(rules.stopped) is stopped
    for event in ("lookahead 0", "speed 1.5", "unknown 1", "speed x"):
        with pytest.raises(UserError, match="expected one of"):
            rules.event(event)


@pytest.mark.parametrize(("push", "wrong"), [((0.0, 0.0, -3.0), False), ((0.0, 0.0, 3.0), True), ((3.0, 0.0, 0.5), False)])
def test_the_first_contact_pushes_the_tool_back(push: tuple[float, float, float], wrong: bool) -> None:
    contact = FirstContactCheck()
    bias = np.array((1.0, -1.0, 2.0))
    assert not any(contact.wrong(t * MS, bias) for t in range(100))
    assert contact.wrong(100 * MS, bias + push) is wrong
    assert contact.passed is (push[2] < 0)
