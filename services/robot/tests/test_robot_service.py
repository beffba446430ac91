"""The service against its contract, and errors of sensors and arm, each by the size that was drawn."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from lbr_bench import Rig as EmulatedRig
from scipy.spatial.transform import Rotation

from palpate_bus import messages as msg
from palpate_bus.contract import contract
from palpate_bus.messages import header
from palpate_bus.messages.codec import encode
from palpate_bus.messages.geometry import vector
from palpate_bus.testing import HandInbox
from palpate_models.numerics.frames import GRAVITY, Array
from palpate_models.robot import lbr
from palpate_models.robot.arm import tool_jacobian, tool_pose, urdf
from palpate_models.scenario.errors import MOMENT_PER_FORCE_M, ArmErrors, DrawnArm, DrawnForce, Errors, ForceErrors, draw_errors
from palpate_models.scenario.load import load_scenario, plant_input
from palpate_models.scenario.schema import Robot, Scenario
from palpate_robot import sensors
from palpate_robot.backends.dart.plant import DartPlant
from palpate_robot.backends.dart.service import create
from palpate_robot.backends.lbr.emulator import Emulator
from palpate_robot.backends.mujoco.plant import MujocoPlant
from palpate_robot.plant import DT
from palpate_robot.sensors import SENSORS, FtSensor, JointSensor
from palpate_robot.service import RobotService

MS = 1_000_000


class Rig:
    """A robot whose command law and tissue are functions of the last tick's outbox."""

    def __init__(self, scenario: Scenario) -> None:
        self.robot: RobotService = create(scenario)
        self.inbox = HandInbox()
        self.t = -MS
        self.outbox: Mapping[str, Any] = {}
        self.status: Any = None

    def command(self, torque: np.ndarray) -> None:
        valid = msg.duration_message(50 * MS)
        self.inbox.messages["control/joint_torque"] = msg.JointTorqueCommand(header(self.t), torque, np.empty(0), valid, "", "")

    def press(self, fx: float, fy: float, fz: float) -> None:
        wrench = msg.Wrench(msg.Vector3(fx, fy, fz), msg.Vector3(0.0, 0.0, 0.0))
        self.inbox.messages["sim/contact_wrench"] = msg.WrenchStamped(header(self.t, "world"), wrench)

    def supervise(self, level: int) -> None:
        state = msg.SupervisorState(
            header(self.t), level, msg.SupervisorState.CAUSE_FORCE, "force 41 N", 0, 41.0, 0.0, 0.0, 0, "", 0.0
        )
        self.inbox.events["supervisor/state"] = [state]

    def tick(self, ticks: int = 1) -> None:
        for _ in range(ticks):
            self.t += MS
            self.outbox = self.robot.step(self.t, self.inbox)
            self.status = self.outbox.get("robot/status", self.status)

    def servo(self, ticks: int, target: np.ndarray = lbr.HOME) -> None:
        """Commands a joint impedance for a while."""
        for _ in range(ticks):
            self.tick()
            state = self.outbox["joint_states"]
            self.command(200.0 * (target - state.position) - 5.0 * state.velocity)

    @property
    def mode(self) -> tuple[int, int]:
        while self.t % (10 * MS):
            self.tick()
        return self.status.mode, self.status.cause


@pytest.fixture
def rig() -> Rig:
    return Rig(Scenario(errors=Errors(level="none")))


def test_sensor_topic_carries_weight_and_bias_until_tared(rig: Rig) -> None:
    readings = []
    for _ in range(400):
        rig.tick()
        readings.append(vector(rig.outbox["ft/wrench"].wrench.force))
    mean = np.mean(readings, axis=0)
    weight = Robot().tool_mass_kg * GRAVITY
    assert abs(mean[2] - weight) < ForceErrors().bias_n + 0.05
    assert np.abs(mean - [0, 0, weight]).max() > 0.01, "a bias is there"
    assert np.std(readings, axis=0) == pytest.approx([ForceErrors().noise_n] * 3, rel=0.2)


def test_status_carries_the_means_since_the_last_one(rig: Rig) -> None:
    def measured(joints: Any, force: Any, torque: Any) -> list[float]:
        return [*joints.position, *joints.velocity, *vector(force), *vector(torque)]

    rig.tick()
    seen = []
    for _ in range(10):
        rig.servo(1, lbr.HOME + 0.05)
        wrench = rig.outbox["ft/wrench"].wrench
        seen.append(measured(rig.outbox["joint_states"], wrench.force, wrench.torque))
    reported = measured(rig.status, rig.status.wrench.force, rig.status.wrench.torque)
    np.testing.assert_allclose(reported, np.mean(seen, axis=0), atol=1e-12)


def test_a_soft_stop_does_not_hold_the_driver(rig: Rig) -> None:
    rig.servo(50)
    rig.supervise(msg.SupervisorState.LEVEL_SOFT_STOP)
    rig.servo(20)
    assert rig.mode[0] == msg.RobotStatus.MODE_ACTIVE


def test_hard_contact_holds(rig: Rig) -> None:
    rig.servo(50)
    rig.press(0.0, 0.0, 45.0)
    rig.servo(3)
    assert rig.mode == (msg.RobotStatus.MODE_SAFE_HOLD, msg.RobotStatus.CAUSE_FORCE_LIMIT)


def test_in_contact_with_tissue_that_stands_still_it_holds(rig: Rig) -> None:
    rig.servo(50)
    rig.inbox.stamps["sim/contact_wrench"] = rig.t
    rig.servo(150)
    assert rig.mode[0] == msg.RobotStatus.MODE_ACTIVE, "no contact, nothing to be met"
    rig.press(0.0, 0.0, 5.0)
    rig.inbox.stamps["sim/contact_wrench"] = rig.t
    rig.servo(100)
    assert rig.mode[0] == msg.RobotStatus.MODE_ACTIVE
    rig.servo(12)
    assert rig.mode == (msg.RobotStatus.MODE_SAFE_HOLD, msg.RobotStatus.CAUSE_COMMAND_EXPIRED)


def test_a_simulation_that_stood_still_brakes_and_states_the_present(rig: Rig) -> None:
    for k in range(100):
        rig.servo(1, lbr.HOME + 0.0005 * k)
    before = rig.outbox["joint_states"]
    assert np.abs(before.velocity).max() > 0.2
    rig.t += 219 * MS
    rig.servo(1, lbr.HOME + 0.05)
    now = rig.outbox["joint_states"]
    assert rig.mode == (msg.RobotStatus.MODE_SAFE_HOLD, msg.RobotStatus.CAUSE_COMMAND_EXPIRED)
    assert rig.status.culprit == "robot" and np.abs(now.velocity).max() < 0.01
    assert np.abs(now.position - before.position).max() < 0.02
    np.testing.assert_allclose(rig.status.position, now.position, atol=1e-4)


def test_a_controller_that_gives_up_is_obeyed_however_far_its_clock_is_ahead(rig: Rig) -> None:
    rig.servo(50)
    rig.command(np.zeros(7))
    problem = {"header": header(rig.t + 180 * MS), "valid_for": msg.duration_message(0), "problem": "joint_states are 34 ms old"}
    rig.inbox.messages["control/joint_torque"] = replace(rig.inbox.messages["control/joint_torque"], **problem)
    rig.tick(20)
    assert rig.mode == (msg.RobotStatus.MODE_SAFE_HOLD, msg.RobotStatus.CAUSE_COMMAND_EXPIRED)
    assert "joint_states" in rig.status.reason


def test_runaway_command_is_stopped_at_a_limit(rig: Rig) -> None:
    rig.tick()
    while rig.robot.finish()["mode"] != "SAFE_HOLD" and rig.t < 3_000 * MS:
        rig.command(np.array([0, 0, 0, 0, 0, 0, 19.0]))
        rig.tick()
    (hold,) = rig.robot.finish()["holds"]
    assert hold["cause"] in ("VELOCITY_LIMIT", "POSITION_LIMIT")
    rig.tick(300)
    assert np.abs(rig.outbox["joint_states"].velocity).max() < 0.05, "and damped to rest"


def test_held_arm_yields_to_tissue_so_the_force_falls(rig: Rig) -> None:
    """A spring under the indenter: from the hold on, the force never rises above what it was, and falls."""
    stiffness = 1000.0
    rig.servo(20)
    rest = rig.outbox["sim/tool_state"].pose.position.z + 0.005  # so 5 N at once
    forces = []
    for tick in range(1500):
        forces.append(stiffness * max(0.0, rest - rig.outbox["sim/tool_state"].pose.position.z))
        rig.press(0.0, 0.0, forces[-1])
        if tick == 200:
            rig.inbox.gone.add("control")
        rig.servo(1)
    held = np.array(forces[202:])
    assert rig.mode == (msg.RobotStatus.MODE_SAFE_HOLD, msg.RobotStatus.CAUSE_COMMANDER_LOST)
    assert held.max() <= forces[201] + 0.02
    assert held[-1] < 0.8 * held[0]


def test_runs_are_identical_to_the_bit_and_seeds_differ() -> None:
    def run(seed: int) -> list[bytes]:
        rig = Rig(Scenario(seed=seed))
        sent = []
        for _ in range(120):
            rig.press(0.5, 0.0, 2.0)
            rig.servo(1, lbr.HOME + 0.01)
            sent += [encode(m, contract().topics[name].type) for name, m in rig.outbox.items()]
        return sent

    assert run(7) == run(7)
    assert run(7) != run(8)


def test_outbox_is_not_changed_by_later_steps(rig: Rig) -> None:
    def encoded() -> list[bytes]:
        return [encode(message, contract().topics[name].type) for name, message in sent.items()]

    rig.servo(5)
    sent = rig.outbox
    before = encoded()
    rig.press(1.0, 2.0, 3.0)
    rig.servo(50, lbr.HOME + 0.1)
    assert encoded() == before


QUIET: dict[str, float] = {"noise_n": 0.0, "noise_nm": 0.0, "bias_n": 0.0, "bias_nm": 0.0}
STILL: dict[str, float] = {"position_noise_rad": 0.0, "velocity_noise_radps": 0.0}
NOTHING = np.zeros(3)
WRENCH = (3.0, -4.0, -12.0, 0.3, -0.2, 0.1)
PLANTS = (DartPlant, MujocoPlant)


def force(seed: int = 0, **given: float) -> DrawnForce:
    return draw_errors(Errors(level="none", force=ForceErrors(**{**QUIET, **given})), seed).force


def arm(seed: int = 0, **given: float) -> DrawnArm:
    return draw_errors(Errors(level="none", arm=ArmErrors(**{**STILL, **given})), seed).arm


def readings(drawn: DrawnForce, n: int, period_s: float = DT, seed: int = 1, wrench: Any = (0.0,) * 6) -> Array:
    """Shape (n, 6)."""
    sensor = FtSensor(drawn, rng(seed), period_s)
    return np.array([sensor.read(wrench) for _ in range(n)])


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))


def test_white_noise_and_bias_have_the_size_that_is_said() -> None:
    drawn = force(noise_n=0.1, noise_nm=0.01, bias_n=2.0, bias_nm=0.2)
    found = readings(drawn, 5000)
    np.testing.assert_allclose(found.std(axis=0), [0.1] * 3 + [0.01] * 3, rtol=0.05)
    np.testing.assert_allclose(found.mean(axis=0), drawn.bias, atol=0.01)
    white = found - drawn.bias
    lag_one = (white[1:] * white[:-1]).mean(axis=0) / white.var(axis=0)
    assert np.abs(lag_one).max() < 0.06


def test_gain_and_cross_talk_appear_in_readings() -> None:
    np.testing.assert_array_equal(readings(force(), 3, wrench=WRENCH), [WRENCH] * 3)
    drawn = force(gain=0.05, cross_talk=0.02)
    (found,) = readings(drawn, 1, wrench=WRENCH)
    np.testing.assert_allclose(found, drawn.sensitivity @ WRENCH)
    assert abs(found[2] - WRENCH[2]) > 0.05


@pytest.fixture
def short_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Slow errors are drawn every tenth reading, to save readings."""
    monkeypatch.setattr(sensors, "SENSORS", SENSORS._replace(block=10))


@pytest.mark.usefixtures("short_blocks")
def test_tares_differ_by_the_wander_and_it_forgets() -> None:
    size = force(tare_n=0.3, tare_s=500.0)
    tares = np.array([readings(size, 1, seed=seed)[0] for seed in range(400)])
    np.testing.assert_allclose(tares.std(axis=0), 0.3 * np.repeat((1.0, MOMENT_PER_FORCE_M), 3), rtol=0.15)
    path = readings(size, 30_000, period_s=1.0)[::100] / np.repeat((1.0, MOMENT_PER_FORCE_M), 3)  # every 100 s
    lags = [np.mean(path[lag:] * path[:-lag]) / np.mean(path**2) for lag in (1, 5, 30)]
    np.testing.assert_allclose(lags, np.exp(np.array((-0.2, -1.0, -6.0))), atol=0.12)


@pytest.mark.usefixtures("short_blocks")
def test_a_walk_grows_with_the_root_of_time() -> None:
    paths = [readings(force(walk_n=0.2), 513, period_s=60 / 128, seed=seed)[:, :3] for seed in range(40)]
    np.testing.assert_allclose(np.std(paths, axis=(0, 2))[[128, 512]], (0.2, 0.4), rtol=0.2)


def test_a_sensor_warms_up_to_its_end_and_no_farther() -> None:
    drawn = force(warm_up_n=2.0, warm_up_s=5.0)
    path = readings(drawn, 6000, period_s=0.01)
    np.testing.assert_allclose(path[500], drawn.warm_up * (1 - np.exp(-1)), rtol=1e-3)
    np.testing.assert_allclose(path[-1], drawn.warm_up, rtol=1e-3)
    assert np.abs(drawn.warm_up[:3]).max() > 0.3


def test_zero_elasticity_and_ripple_appear_in_measured_positions() -> None:
    q, v, torque = np.array(lbr.HOME), np.linspace(0.1, 0.4, 7), np.linspace(-30.0, 30.0, 7)
    drawn = arm(zero_rad=0.002)
    assert np.abs(drawn.zero_rad).min() > 1e-5
    np.testing.assert_allclose(JointSensor(drawn, rng(), q, torque).q - q, drawn.zero_rad, atol=1e-15)
    soft = JointSensor(arm(compliance_radpnm=1e-4), rng(), q, torque)
    np.testing.assert_allclose(soft.q - q, 1e-4 * torque, atol=1e-12)
    for _ in range(round(SENSORS.settling_s / DT)):
        soft.update(q, v, np.zeros(7))
    np.testing.assert_allclose(soft.q - q, 1e-4 * torque * np.exp(-1), rtol=0.05)
    phase = np.linspace(0.0, 2 * np.pi / SENSORS.ripples, 50)
    rough = JointSensor(arm(ripple_rad=1e-4), rng(), q, torque)
    ripples = []
    for turn in phase:
        rough.update(q + turn, v, torque)
        ripples.append(rough.q - q - turn)
    np.testing.assert_allclose(np.abs(ripples).max(axis=0), 1e-4, rtol=0.01)
    np.testing.assert_allclose(np.mean(ripples[:-1], axis=0), 0.0, atol=1e-6)


def test_measured_velocity_is_the_derivative_of_measured_position() -> None:
    joints = JointSensor(arm(compliance_radpnm=1e-4, ripple_rad=1e-4), rng(), np.array(lbr.HOME), np.zeros(7))
    v = np.linspace(0.02, 0.05, 7)
    path = []
    for k in range(1, 300):
        joints.update(lbr.HOME + v * k * DT, v, np.full(7, 20.0 * np.sin(0.01 * k)))
        path.append((joints.q, joints.v))
    q, speed = np.array(path).transpose(1, 0, 2)
    np.testing.assert_allclose(np.diff(q, axis=0) / DT, speed[1:], atol=1e-4)
    assert np.abs(speed - v).max() > 1e-3


@pytest.mark.parametrize("plant", PLANTS)
def test_the_tool_is_elsewhere_by_what_the_lengths_are_wrong(plant: Any) -> None:
    """To first order each joint's origin moves the tool as it is turned by the joints before it."""
    drawn = arm(length_m=0.001)
    true, nominal = plant(Robot(), drawn=drawn), plant(Robot(), arm())
    moved = true.tool_motion()[:3] - nominal.tool_motion()[:3]
    turns = Rotation.from_quat(nominal.link_poses()[:7, 3:]).as_matrix()
    expected = sum(turn @ error for turn, error in zip(turns, drawn.origin_m, strict=True))
    np.testing.assert_allclose(moved, expected, atol=1e-9)
    assert 0.5e-3 < np.linalg.norm(moved) < 10e-3


@pytest.mark.parametrize("plant", PLANTS)
def test_the_sensor_feels_the_true_tool_and_the_controller_carries_the_nominal_one(plant: Any) -> None:
    drawn, weights, carried = arm(tool_mass=0.3, seed=3), [], []
    assert abs(drawn.tool_mass - 1) > 0.05
    for one in (plant(Robot(), drawn), plant(Robot(), arm())):
        for _ in range(3):
            one.step(one.gravity_torque(), NOTHING, NOTHING, np.full(7, 1e6))
        weights.append(one.sensor_wrench()[2] / (Robot().tool_mass_kg * GRAVITY))
        carried.append(one.gravity_torque())
    assert weights == pytest.approx([drawn.tool_mass, 1.0], abs=6e-3)
    np.testing.assert_allclose(*carried, atol=1e-3)


@pytest.mark.parametrize("plant", PLANTS)
def test_friction_is_that_of_the_true_arm(plant: Any) -> None:
    """A steady turn of A1 under a torque: speed = (torque - Coulomb) / viscous."""
    drawn = arm(friction=0.4, damping=0.4, seed=2)
    one = plant(Robot(joint_friction_nm=2.0, joint_damping_nms=20.0), drawn=drawn)
    torque, lock = 6.0 * np.eye(7)[0], np.array([0.0, *[1e6] * 6])
    for _ in range(1500):
        one.step(one.gravity_torque() + torque, NOTHING, NOTHING, lock)
    expected = (6.0 - 2.0 * drawn.friction[0]) / (20.0 * drawn.damping[0])
    assert one.v[0] == pytest.approx(expected, rel=0.01)
    assert abs(expected / (4.0 / 20.0) - 1) > 0.05


def test_the_service_measures_another_tool_pose_than_the_true_one_and_reports_the_nominal_arm() -> None:
    """The pose computed from joint_states and robot_description is off by the drawn errors; without them it is exact."""
    found = []
    for errors in ("none", "poor"):
        scenario = Scenario(seed=5, errors=Errors(level=errors))  # type: ignore[arg-type]
        service = create(scenario)
        assert service.start()["robot_description"].data == urdf(scenario.robot)
        sent = service.step(0, HandInbox())
        reported = tool_pose(sent["joint_states"].position, scenario.robot)[:3, 3]
        found.append(np.linalg.norm(reported - vector(sent["sim/tool_state"].pose.position)))
    assert found[0] < 1e-5
    drawn = draw_errors(Errors(level="poor"), 5).arm
    lengths = DartPlant(Robot(), drawn=drawn).tool_motion()[:3] - DartPlant(Robot(), arm()).tool_motion()[:3]
    sag = 1e-4 * DartPlant(Robot(), arm()).gravity_torque()
    turned = tool_jacobian(np.array(lbr.HOME), Robot())[:3] @ (drawn.zero_rad + sag)
    assert found[1] == pytest.approx(np.linalg.norm(lengths - turned), abs=0.4e-3)
    assert found[1] > 1e-3


def test_the_emulated_arm_has_the_errors_and_the_driver_does_not_know_them() -> None:
    scenario = load_scenario("poor_errors", seed=2)
    drawn = draw_errors(scenario.errors, 2)
    emulator = Emulator(plant_input(scenario))
    state, tool = emulator.state(0), emulator.tool(0)
    reported = tool_pose(np.array(state.measured_joint_position), scenario.robot)[:3, 3]
    assert np.linalg.norm(reported - vector(tool.pose.position)) > 1e-3
    off = np.array(state.measured_joint_position) - lbr.HOME
    np.testing.assert_allclose(off, drawn.arm.zero_rad, atol=1e-4 * 60 + 3e-4)
    expected = drawn.force.bias[2] + drawn.arm.tool_mass * scenario.robot.tool_mass_kg * GRAVITY
    assert emulator.wrench(0).wrench.force.z == pytest.approx(expected, abs=1.5)
    assert EmulatedRig().driver.start()["robot_description"].data == urdf(scenario.robot)
