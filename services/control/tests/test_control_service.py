"""The control service: what it sends before, with, and after set-points."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from palpate_bus import messages as msg
from palpate_bus.messages import MS, blank, header
from palpate_bus.testing import HandInbox
from palpate_control import impedance
from palpate_control.service import ControlService, create
from palpate_models.robot.lbr import HOME, JOINT_NAMES
from palpate_models.scenario.schema import CommandLevel, Robot, Scenario

EXPIRY = 50 * MS


def joints(t: int, q: np.ndarray = HOME, names: tuple[str, ...] = JOINT_NAMES) -> Any:
    return msg.JointState(header(t), list(names), np.array(q, dtype=float), np.zeros(7), np.zeros(7))


def setpoint(t: int, valid: int = 250 * MS, mode: int = msg.ImpedanceSetpoint.MODE_JOINT, **changes: Any) -> Any:
    pose = msg.Pose(msg.Point(0.3, 0.0, 1.5), msg.Quaternion(1.0, 0.0, 0.0, 0.0))
    joints = {"joint_position": np.array(HOME) + 0.1, "joint_velocity": np.zeros(7), "joint_stiffness": np.full(7, 500.0)}
    axes = {"stiffness": np.full(6, 200.0), "damping_ratio": np.full(6, 0.8)}
    fields = {"mode": mode, "pose": pose, "valid_for": msg.duration_message(valid), **axes, **joints, **changes}
    return replace(blank("palpation_msgs/msg/ImpedanceSetpoint", t, "world"), **fields)


def status(t: int) -> Any:
    rest = dict.fromkeys(("velocity", "applied_torque", "measured_torque"), np.zeros(7))
    return replace(blank("palpation_msgs/msg/RobotStatus", t), mode=msg.RobotStatus.MODE_ACTIVE, position=np.array(HOME), **rest)


class Rig:
    """A service with its inbox, ticked by the millisecond with fresh joint states."""

    def __init__(self, level: CommandLevel = CommandLevel.TORQUE) -> None:
        self.service: ControlService = create(Scenario(robot=Robot(level=level)))
        self.positions = level is CommandLevel.POSITION
        self.inbox = HandInbox()
        self.t = 0

    def tick(self, count: int = 1, message: Any = None, **state: Any) -> Any:
        for _ in range(count):
            self.inbox.put("joint_states", message or joints(self.t, **state), self.t)
            if self.positions:
                self.inbox.put("robot/status", status(self.t), self.t)
            outbox = self.service.step(self.t, self.inbox)
            self.t += MS
        assert set(outbox) == {"control/joint_torque"}
        return outbox["control/joint_torque"]

    def send(self, message: Any) -> None:
        self.inbox.put("planning/setpoint", message, self.t)


@pytest.fixture
def rig() -> Rig:
    return Rig()


def valid_for(command: Any) -> int:
    return msg.nanoseconds(command.valid_for)


def test_expired_setpoint_ends_commanding(rig: Rig) -> None:
    rig.send(setpoint(0, valid=100 * MS))
    command = rig.tick(101)
    assert (valid_for(command), command.problem) == (EXPIRY, "")
    command = rig.tick()
    assert (valid_for(command), command.culprit) == (0, "planning/setpoint")
    np.testing.assert_array_equal(command.torque, 0.0)
    assert valid_for(rig.tick(30)) == 0
    assert rig.service.finish()["ticks_without_command"] == 31


def test_a_posture_that_stands_at_a_velocity_is_blamed_on_the_setpoints(rig: Rig) -> None:
    for _ in range(31):  # the last accepted one stands until it expires
        rig.send(setpoint(rig.t, joint_velocity=np.full(7, 0.3)))
        command = rig.tick(10)
    assert (valid_for(command), command.culprit) == (0, "planning/setpoint")
    assert "joint_position stands" in command.problem


@pytest.mark.parametrize("state", [{"names": JOINT_NAMES[::-1]}, {"q": HOME[:6]}], ids=["permuted", "one too few"])
def test_joints_of_another_arm_end_commanding_and_its_setpoints_are_refused(rig: Rig, state: dict[str, Any]) -> None:
    rig.tick()
    rig.send(setpoint(rig.t))
    assert valid_for(rig.tick(5)) > 0
    rig.send(setpoint(rig.t, joint_position=HOME[:6]))
    command = rig.tick(**state)
    assert (valid_for(command), command.culprit) == (0, "joint_states")
    assert rig.service.finish()["setpoints_rejected"] == 1


def test_before_the_first_setpoint_torque_is_zero_and_a_long_wait_is_stated(rig: Rig) -> None:
    for ticks, culprit in ((250, ""), (2, "planning/setpoint")):
        command = rig.tick(ticks)
        assert (valid_for(command), command.culprit) == (EXPIRY, culprit)
        np.testing.assert_array_equal(command.torque, 0.0)


@pytest.mark.parametrize("level", [CommandLevel.TORQUE, CommandLevel.POSITION])
def test_a_cartesian_setpoint_far_from_the_tool_ends_commanding(level: CommandLevel) -> None:
    rig = Rig(level)
    rig.send(setpoint(0, mode=msg.ImpedanceSetpoint.MODE_CARTESIAN))
    command = rig.tick(20)
    assert valid_for(command) == 0
    assert command.culprit == "planning/setpoint"


def test_no_setpoint_outlives_the_contract(rig: Rig) -> None:
    rig.send(setpoint(0, valid=10_000 * MS))
    assert valid_for(rig.tick(251)) == EXPIRY
    assert valid_for(rig.tick()) == 0


def test_commanding_starts_again_from_zero_torque(rig: Rig) -> None:
    rig.send(setpoint(0, valid=20 * MS))
    rig.tick(60)
    rig.send(setpoint(rig.t - 10 * MS))
    command = rig.tick()
    assert valid_for(command) == EXPIRY
    assert 0 < np.abs(command.torque).max() <= 1.0


def test_commands_own_their_arrays(rig: Rig) -> None:
    rig.send(setpoint(0))
    first = rig.tick(5).torque
    kept = first.copy()
    rig.tick(5)
    np.testing.assert_array_equal(first, kept)


def test_while_joint_states_are_stale_the_last_torque_stands_no_longer_than_it_was_valid(rig: Rig) -> None:
    rig.send(setpoint(0))
    last = rig.tick(10).torque
    late = rig.t - MS + 20 * MS
    for ms in (0, 1, 10, 49, 50):
        command = rig.service.step(late + ms * MS, rig.inbox)["control/joint_torque"]
        last = last if ms else command.torque
        assert valid_for(command) == EXPIRY - ms * MS
        assert command.culprit == ("joint_states" if ms else "")
        assert command.torque == pytest.approx(last if ms < 50 else 0.0 * last)


def test_while_joint_states_are_stale_positions_follow_the_setpoints_no_longer_than_they_were_valid() -> None:
    rig = Rig(CommandLevel.POSITION)
    rig.send(setpoint(0))
    last, since = np.array(rig.tick(5).position), rig.t
    for _ in range(100):
        rig.t += MS
        rig.inbox.put("robot/status", status(rig.t), rig.t)
        command = rig.service.step(rig.t, rig.inbox)["control/joint_torque"]
        if valid_for(command) <= 0:
            break
        assert (np.abs(command.position - last) > 0).all()
        last = np.array(command.position)
    assert EXPIRY < rig.t - since < EXPIRY + 25 * MS


@pytest.mark.parametrize("level", [CommandLevel.TORQUE, CommandLevel.POSITION])
def test_joint_states_of_no_joints_are_stale(level: CommandLevel) -> None:
    rig, none = Rig(level), np.zeros(0)
    rig.send(setpoint(0))
    rig.tick(10)
    rest = [rig.tick(message=msg.JointState(header(rig.t), [], none, none, none)) for _ in range(60)]
    assert [valid_for(command) for command in rest] == [max(EXPIRY - (k + 1) * MS, 0) for k in range(60)]
    assert rest[-1].problem == "joint_states: the arm reports none"


def moving(t: int) -> np.ndarray:
    """Joint 1 at 0.8 rad/s from HOME, the others at rest."""
    return np.array(HOME) + 0.8 * 1e-9 * t * np.eye(7)[0]


def peak_on_the_way(delay: int, *, lagging: bool = False) -> float:
    """Maximum torque of joint 1 [N m] while the arm moves as it should and its states arrive `delay` [ns] late after 100 ms.

    They stay away while they would be older than 15 ms. A `lagging` arm takes two ticks for one from then on.
    """
    rig, peak, speed = Rig(), 0.0, 0.8 * np.eye(7)[0]
    for _ in range(300):
        if rig.t % (10 * MS) == 0:
            rig.send(setpoint(rig.t, joint_position=moving(rig.t), joint_velocity=speed, joint_stiffness=np.full(7, 800.0)))
        late = 0 if rig.t < 100 * MS else (rig.t - 100 * MS) // 2 // MS * MS if lagging else delay
        measured = max(rig.t - late, 0)
        if lagging or rig.t - measured <= 15 * MS:
            state = msg.JointState(header(measured), list(JOINT_NAMES), moving(measured), speed, np.zeros(7))
        torque = rig.tick(1, message=state).torque[0]
        peak = max(peak, abs(torque)) if rig.t > 60 * MS else 0.0
    return peak


@pytest.mark.parametrize(("delay", "lagging"), [(15 * MS, False), (0, True)])
def test_late_states_wind_no_spring_up(delay: int, lagging: bool) -> None:
    """15 ms at 0.8 rad/s would be 12 mrad, times 800 N m/rad: 10 N m more. A plant may lag by 100 ms."""
    assert peak_on_the_way(delay, lagging=lagging) < peak_on_the_way(0) + 1.0


def test_a_state_that_comes_again_and_again_winds_no_spring_up(rig: Rig) -> None:
    frozen = msg.JointState(header(0), list(JOINT_NAMES), moving(0), np.zeros(7), np.zeros(7))
    for _ in range(400):
        if rig.t % (10 * MS) == 0:
            rig.send(setpoint(rig.t, joint_position=moving(rig.t)))
        command = rig.tick(1, message=frozen)
    assert not command.torque.any()
    assert (valid_for(command), command.culprit) == (0, "joint_states")


def test_nothing_is_compiled_in_mid_run(rig: Rig) -> None:
    """Arrays as they come from the bus are of the types that the warm-up has compiled for."""
    functions = [f for f in vars(impedance).values() if hasattr(f, "signatures")]
    assert functions
    before = [len(f.signatures) for f in functions]
    for k in range(4):
        mode = msg.ImpedanceSetpoint.MODE_CARTESIAN if k >= 2 else msg.ImpedanceSetpoint.MODE_JOINT
        rig.send(setpoint(rig.t - 10 * MS, mode=mode))
        rig.tick(10)
    assert rig.service.finish()["setpoints"] == 4
    assert [len(f.signatures) for f in functions] == before


@pytest.mark.parametrize(("ahead_ms", "refused"), [(3_600_000, 1), (200, 0)], ids=["far future", "clock set back since"])
def test_a_setpoint_that_is_ahead_holds_up_no_other(rig: Rig, ahead_ms: int, refused: int) -> None:
    rig.send(setpoint(0))
    before = rig.tick(20).torque[0]
    rig.send(setpoint(rig.t + ahead_ms * MS))
    rig.send(setpoint(rig.t, joint_position=np.array(HOME) - 0.1))
    command = rig.tick(40)
    assert rig.service.finish()["setpoints_rejected"] == refused
    assert valid_for(command) == EXPIRY
    assert np.sign(command.torque[0]) == -np.sign(before)
