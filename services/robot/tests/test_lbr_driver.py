"""The driver on the emulated arm, in simulated time."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from lbr_bench import MS, SCENARIO, Rig, active_rig, driver_on_emulator

from palpate_bus.contract import contract
from palpate_bus.contract.port_check import PortCheck
from palpate_bus.messages import OperatorRequest, RobotStatus, SupervisorState, header, nanoseconds
from palpate_models.numerics.frames import GRAVITY
from palpate_models.robot import lbr
from palpate_models.scenario.load import ScenarioError, load_scenario, plant_input
from palpate_robot.backends.hardware import GravityModel
from palpate_robot.backends.lbr.emulator import Emulator
from palpate_robot.backends.lbr.port import CLOCK_SET_NS, MeasuredLbr


@pytest.fixture
def rig() -> Rig:
    return active_rig()


def test_until_the_session_commands_the_driver_waits_and_says_for_what() -> None:
    rig = Rig()
    rig.tick(100)
    assert rig.status.mode == RobotStatus.MODE_IDLE
    assert "MONITORING" in rig.status.reason
    assert rig.outbox["joint_states"].position == pytest.approx(lbr.HOME, abs=1e-4)


def test_what_the_driver_sends_keeps_the_contract() -> None:
    rig = Rig()
    checks = {topic.name: PortCheck(topic, sends=True) for topic in contract().outputs("robot")}
    sent, reasons = set(), []
    for silent, ticks in ((True, 600), (False, 150), (True, 150)):
        rig.port.silent = silent
        for _ in range(ticks):
            rig.tick(1)
            for name, message in rig.outbox.items():
                checks[name](message, rig.t)
            sent |= rig.outbox.keys()
        reasons.append(rig.status.reason)
    assert sent >= {"joint_states", "robot/status", "sim/tool_state", "sim/link_poses"}
    assert reasons[:2] == ["no LBRState received yet", ""]
    assert "no LBRState for 2" in reasons[2]


def test_positive_torque_turns_a_joint_the_positive_way_and_its_velocity_hardly_lags(rig: Rig) -> None:
    worst = fastest = 0.0
    for joint in range(7):
        rig.target = rig.target + 0.05 * np.eye(7)[joint]
        for _ in range(350):
            rig.tick(1)
            fastest = max(fastest, float(np.abs(rig.plant.v).max()))
            worst = max(worst, float(np.abs(rig.outbox["joint_states"].velocity - rig.plant.v).max()))
        assert rig.outbox["joint_states"].position[joint] == pytest.approx(rig.target[joint], abs=0.03)
        assert rig.plant.q[joint] > lbr.HOME[joint] + 0.02
    assert worst < 0.5 * fastest, "a change of 1 N m/ms is what lags most"


def test_the_overlay_excludes_gravity(rig: Rig) -> None:
    gravity = GravityModel(SCENARIO.robot).at(np.array(lbr.HOME)).gravity
    assert np.abs(gravity).max() > 20.0
    assert np.abs(rig.port.torques[-1]).max() < 1.0
    assert np.abs(rig.plant.q - lbr.HOME).max() < 0.01


def hold_cause(rig: Rig) -> tuple[int, str]:
    assert rig.status.mode == RobotStatus.MODE_SAFE_HOLD
    return rig.status.cause, rig.status.reason


@pytest.mark.parametrize("idle", [False, True])
def test_a_silent_arm_is_reported_and_nothing_is_pushed_on(rig: Rig, idle: bool) -> None:
    if idle:
        rig.commanding = False
        rig.tick(100)
        rig.driver._driver.release(rig.t)
        rig.plant.reset(rig.plant.q, np.array([0.5, 0, 0, 0, 0, 0, 0]))
    rig.target = rig.target + 0.1
    rig.tick(10 if idle else 50)
    assert np.abs(rig.port.torques[-1]).max() > 1
    rig.port.silent = True
    rig.tick(60)
    assert rig.status.mode == (RobotStatus.MODE_IDLE if idle else RobotStatus.MODE_SAFE_HOLD)
    assert rig.status.cause == RobotStatus.CAUSE_DEVICE
    assert not rig.port.torques[-1].any()


def test_a_state_that_fri_does_not_have_holds(rig: Rig) -> None:
    rig.port.spoiled = {"safety_state": 9}
    rig.tick(20)
    assert hold_cause(rig)[0] == RobotStatus.CAUSE_DEVICE
    assert "9" in hold_cause(rig)[1]


def test_states_of_before_a_gap_are_not_in_the_next_mean(rig: Rig) -> None:
    """A late driver skips ticks; positions from 0.1 s apart were averaged and blamed on the joint sensors."""
    rig.tick(5)
    rig.t += 110 * MS
    rig.port.spoiled = {"measured_joint_position": np.array(lbr.HOME) + 0.1}
    rig.tick(6)
    assert rig.t % (10 * MS) == 0
    np.testing.assert_allclose(rig.status.position, np.array(lbr.HOME) + 0.1)


def test_silent_sensor_holds(rig: Rig) -> None:
    rig.port.ft_silent = True
    rig.tick(80)
    assert "no F/T reading" in hold_cause(rig)[1]


def test_without_a_sensor_the_driver_waits_and_reports_it() -> None:
    rig = Rig()
    rig.port.ft_silent = True
    rig.tick(600)
    assert (rig.status.mode, rig.status.cause) == (RobotStatus.MODE_IDLE, RobotStatus.CAUSE_DEVICE)
    assert rig.status.reason == "no F/T reading"


def test_the_weight_of_the_tool_is_added_to_a_wrench_without_it() -> None:
    scenario = load_scenario("clean", ["robot.driver.ft_weight=false"])
    driver, _ = driver_on_emulator(scenario)
    assert np.linalg.norm(driver._wrench_on_sensor(np.zeros(6))[:3]) == pytest.approx(GRAVITY * scenario.robot.tool_mass_kg)


def test_expired_commands_hold_and_the_arm_stands(rig: Rig) -> None:
    rig.target = rig.target + 0.1
    rig.tick(150)
    assert np.abs(rig.plant.v).max() > 0.05
    rig.commanding = False
    rig.tick(500)
    assert hold_cause(rig)[0] == RobotStatus.CAUSE_COMMAND_EXPIRED
    assert np.abs(rig.plant.v).max() < 0.02, "damped, not swinging"
    assert not rig.port.emulator.session.ended


STOPS = {
    "operator/request": OperatorRequest(header(0), OperatorRequest.STOP, "enough"),
    "unknown": OperatorRequest(header(0), 200, "damaged"),
    "supervisor/state": SupervisorState(header(0), 2, 1, "41 N", 0, 41.0, 0.0, 0.0, 0, "", 0.0),
}
RELEASED = SupervisorState(header(0), 0, 0, "", 1, 0.0, 0.0, 0.0, 0, "", 0.0)


@pytest.mark.parametrize("who", STOPS)
def test_stops_hold_and_only_a_later_release_goes_on(rig: Rig, who: str) -> None:
    rig.inbox.events["supervisor/state" if who == "supervisor/state" else "operator/request"] = [STOPS[who]]
    if who != "supervisor/state":
        rig.inbox.events["supervisor/state"] = [RELEASED]
    rig.tick(20)
    wanted = RobotStatus.CAUSE_SUPERVISOR if who == "supervisor/state" else RobotStatus.CAUSE_STOP_REQUESTED
    assert hold_cause(rig)[0] == wanted
    rig.inbox.events["supervisor/state"] = [replace(RELEASED, header=header(rig.t), releases=2)]
    rig.tick(20)
    assert rig.status.mode == RobotStatus.MODE_ACTIVE


@pytest.mark.parametrize(
    ("emulated", "off_rad"), [({"period_ms": 1}, 0.01), ({"period_ms": 5}, 0.01), ({"gravity_error_nm": 1.0}, 0.05)]
)
def test_other_send_periods_and_a_wrong_load_are_carried(emulated: dict[str, Any], off_rad: float) -> None:
    rig = Rig(**emulated)
    rig.tick(900)
    assert rig.status.mode == RobotStatus.MODE_ACTIVE
    assert np.abs(rig.plant.q - lbr.HOME).max() < off_rad


@pytest.mark.parametrize(("name", "value"), [("domain", "-1"), ("ft_sign", "2"), ("domain", "x")])
def test_a_field_of_the_connection_that_cannot_be_is_named(name: str, value: str) -> None:
    with pytest.raises(ScenarioError, match=f"robot.driver.{name}"):
        load_scenario("clean", [f"robot.driver.{name}={value}"])


START = 5_000_000_000


class Stream:
    """States of an arm of which joint 1 turns at 0.5 rad/s, one every 2 ms."""

    def __init__(self) -> None:
        self._state = Emulator(plant_input(load_scenario("clean"))).state(0)
        self._q = np.array(self._state.measured_joint_position)

    def at(self, t: int, stamp: int) -> Any:
        self._state.measured_joint_position = self._q + np.array([0.5, 0, 0, 0, 0, 0, 0]) * t * 1e-9
        self._state.time_stamp_sec, self._state.time_stamp_nano_sec = stamp // 1_000_000_000, stamp % 1_000_000_000
        return self._state


@pytest.fixture
def moving() -> tuple[MeasuredLbr, Stream]:
    arm, stream = MeasuredLbr(), Stream()
    for t in range(0, 100 * MS, 2 * MS):
        assert arm.update(t, stream.at(t, START + t))
    assert arm.v[0] == pytest.approx(0.5, rel=0.01)
    return arm, stream


def test_a_controller_whose_clock_was_set_back_is_still_obeyed(moving: tuple[MeasuredLbr, Stream]) -> None:
    arm, stream = moving
    assert arm.update(100 * MS, stream.at(100 * MS, START - 3_600_000_000_000))
    assert arm.received == 100 * MS
    assert not arm.v.any(), "the time between the two states is not known"
    for t in range(102 * MS, 200 * MS, 2 * MS):
        assert arm.update(t, stream.at(t, START - 3_600_000_000_000 + t - 100 * MS))
    assert arm.v[0] == pytest.approx(0.5, rel=0.01)


@pytest.mark.parametrize("back", [0, 4 * MS, CLOCK_SET_NS - 99 * MS])
def test_a_state_that_was_overtaken_is_passed_over(moving: tuple[MeasuredLbr, Stream], back: int) -> None:
    arm, stream = moving
    q = arm.q.copy()
    assert not arm.update(100 * MS, stream.at(100 * MS, START + 98 * MS - back))
    assert arm.received == 98 * MS
    assert np.array_equal(arm.q, q)


def stamps(rig: Rig, ticks: int, topic: str) -> list[int]:
    """Return the age [ms] of each message of a topic by its own stamp, a tick a message."""
    found = []
    for _ in range(ticks):
        rig.tick(1)
        if topic in rig.outbox and getattr(rig.outbox[topic], "name", True):
            found.append((rig.t - nanoseconds(rig.outbox[topic].header.stamp)) // MS)
    return found


def test_joint_states_carry_the_time_at_which_the_state_was_received() -> None:
    rig = Rig(period_ms=5)
    rig.tick(101)
    assert stamps(rig, 10, "joint_states") == [1, 2, 3, 4, 0] * 2


@pytest.mark.parametrize(("topic", "silent"), [("joint_states", "silent"), ("ft/wrench", "ft_silent")])
def test_what_a_silent_arm_measured_grows_old_and_ceases(topic: str, silent: str) -> None:
    rig = Rig()
    rig.tick(101)
    setattr(rig.port, silent, True)
    assert stamps(rig, 70, topic) == list(range(1, 21)), "a reader sees how old they are, until they are of no joints, or none"
