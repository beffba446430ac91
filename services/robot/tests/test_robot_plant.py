"""The plants: DART against pinocchio, which shares none of its code, MuJoCo against DART, and the loop that follows positions."""

from collections.abc import Iterator

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

from palpate_bus.messages import NS
from palpate_bus.messages.codes import DriverMode, HoldCause
from palpate_models.numerics.frames import GRAVITY
from palpate_models.robot import arm as robot_arm, lbr
from palpate_models.robot.arm import TOOL, link_names, tool_jacobian, urdf
from palpate_models.robot.lbr import ARM, HOME
from palpate_models.scenario.errors import DrawnArm, Errors, draw_errors
from palpate_models.scenario.schema import Robot
from palpate_robot.backends.dart.plant import CLEARANCE, DartPlant
from palpate_robot.backends.mujoco.plant import MujocoPlant
from palpate_robot.driver import Command, Driver
from palpate_robot.plant import DT, END_STOP_MARGIN_RAD, STICK_RADPS, Plant
from palpate_robot.position_loop import TUNING, PositionLoop

LINKS = link_names(Robot())
NOTHING, NO_DAMPING = np.zeros(3), np.zeros(7)
NOMINAL = draw_errors(Errors(level="none"), 0).arm
FREE = Robot(joint_damping_nms=0.0, joint_friction_nm=0.0)

OVER_TABLE = np.deg2rad([0.0, 60.0, 0.0, -60.0, 0.0, 20.0, 0.0])


def _model(robot: Robot) -> tuple[pin.Model, pin.Data]:
    model = pin.buildModelFromXML(urdf(robot))
    model.gravity.linear = np.array([0.0, 0.0, -GRAVITY])
    return model, model.createData()


def test_motion_poses_and_weight_agree_with_pinocchio_and_the_engine() -> None:
    robot = Robot(base_xy_m=(0.05, -0.1), base_yaw_rad=0.3)
    plant = DartPlant(robot, NOMINAL)
    model, data = _model(robot)
    rng = np.random.default_rng(2)
    frame = model.getFrameId("indenter")
    for q in rng.uniform(-2, 2, (100, 7)):  # each part of the quaternion is the largest of some
        v = rng.uniform(-1, 1, 7)
        plant.reset(q, v)
        pin.forwardKinematics(model, data, q, v)
        pin.updateFramePlacements(model, data)
        twist, X_WI = pin.getFrameVelocity(model, data, frame, pin.LOCAL_WORLD_ALIGNED), data.oMf[frame]
        motion, poses = plant.tool_motion(), plant.link_poses()
        np.testing.assert_allclose(motion[:3], X_WI.translation, atol=1e-12)
        np.testing.assert_allclose(Rotation.from_quat(motion[3:7]).as_matrix(), X_WI.rotation, atol=1e-12)
        np.testing.assert_allclose(motion[7:], twist.vector, atol=1e-12)
        np.testing.assert_array_equal(motion[:7], poses[-1])
        engine = [plant._links[link].getTransform() for link in LINKS]
        turns = [X_WL.quaternion() for X_WL in engine]
        np.testing.assert_allclose(poses[:, :3], [X_WL.translation() for X_WL in engine], atol=1e-12)
        np.testing.assert_allclose(poses[:, 3:], [(r.x(), r.y(), r.z(), r.w()) for r in turns], atol=1e-12)
        np.testing.assert_allclose(plant.gravity_torque(), pin.computeGeneralizedGravity(model, data, q), atol=1e-11)


def test_accelerations_agree_with_pinocchio_under_a_tool_wrench() -> None:
    plant = DartPlant(FREE, NOMINAL)
    model, data = _model(FREE)
    rng = np.random.default_rng(3)
    frame = model.getFrameId("indenter")
    for q in postures(10):
        v, torque = rng.uniform(-1, 1, 7), rng.uniform(-20, 20, 7)
        force, moment = rng.uniform(-20, 20, 3), rng.uniform(-1, 1, 3)
        plant.reset(q, v)
        plant.step(torque, force, moment, NO_DAMPING)
        J = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)
        expected = pin.aba(model, data, q, v, torque + J.T @ np.concatenate((force, moment)))
        np.testing.assert_allclose(plant.v, v + DT * expected, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(plant.q, q + DT * plant.v, rtol=1e-12, atol=1e-12)


def test_friction_is_implicit() -> None:
    """(M + dt D) a = tau - h - D v is stable whatever D; explicit, 10 N m s/rad on a wrist of 5e-4 kg m^2 is not."""
    robot = Robot(joint_friction_nm=0.2)
    plant = DartPlant(robot, NOMINAL)
    model, data = _model(robot)
    rng = np.random.default_rng(4)
    for extra in (0.0, 40.0):
        for q in postures(5):
            v, torque = rng.uniform(-1, 1, 7), rng.uniform(-20, 20, 7)
            v[3] = 0.0
            plant.reset(q, v)
            plant.step(torque, NOTHING, NOTHING, np.full(7, extra))
            D = robot.joint_damping_nms + extra + robot.joint_friction_nm / np.maximum(np.abs(v), STICK_RADPS)
            h = pin.rnea(model, data, q, v, np.zeros(7))
            M = np.triu(pin.crba(model, data, q))
            expected = np.linalg.solve(M + np.triu(M, 1).T + DT * np.diag(D), torque - h - D * v)
            np.testing.assert_allclose(plant.v, v + DT * expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("joint", [0, 3, 6])
def test_coulomb_friction_sticks_below_its_limit_and_slides_against_it_above(joint: int) -> None:
    robot = Robot(joint_friction_nm=0.5)
    plant = DartPlant(robot, NOMINAL)
    push = np.zeros(7)
    for torque, speed in ((0.25, None), (1.5, (1.5 - 0.5) / robot.joint_damping_nms)):
        push[joint] = torque
        plant.reset(np.zeros(7))  # upright: no joint's motion moves the weight much
        for _ in range(1000):
            plant.step(plant.gravity_torque() + push, NOTHING, NOTHING, NO_DAMPING)
        if speed is None:
            assert abs(plant.v[joint]) < STICK_RADPS
        else:
            assert plant.v[joint] == pytest.approx(speed, rel=0.15)


@pytest.mark.parametrize(("make", "bounce_rad"), [(DartPlant, 2e-3), (MujocoPlant, 8e-3)])
def test_end_stop_stops_the_joint(make: type[Plant], bounce_rad: float) -> None:
    """75 % of A7's torque limit pushes on; MuJoCo's stop is soft."""
    plant = make(Robot(), NOMINAL)
    push = np.zeros(7)
    push[6] = 30.0
    for _ in range(1500):
        plant.step(plant.gravity_torque() + push, NOTHING, NOTHING, NO_DAMPING)
    stop = lbr.POSITION_LIMIT[6] + END_STOP_MARGIN_RAD
    assert plant.q[6] == pytest.approx(stop, abs=bounce_rad)


def contacts(plant: Plant) -> int:
    """Return the number of contact points with table or base in the last step."""
    return plant._data.ncon if isinstance(plant, MujocoPlant) else plant._world.getLastCollisionResult().getNumContacts()


@pytest.mark.parametrize("make", [DartPlant, MujocoPlant])
def test_arm_comes_to_rest_on_the_table_not_in_it(make: type[Plant]) -> None:
    plant = make(Robot(), NOMINAL, OVER_TABLE)
    touched = 0
    for _ in range(2500):
        plant.step(NO_DAMPING, NOTHING, NOTHING, NO_DAMPING)  # limp: nothing carries the arm
        touched = max(touched, contacts(plant))
    assert touched > 0
    assert plant.link_poses()[LINKS.index("lbr_link_7"), 2] > 0.73


def test_hold_stops_a_moving_tool_within_a_millimetre() -> None:
    """Straight down at 30 mm/s, the scan's speed, when the hold begins; no tissue helps to stop it."""
    q = np.deg2rad([0.0, 30.0, 0.0, -80.0, 0.0, 70.0, 0.0])
    plant = DartPlant(Robot(), NOMINAL)
    plant.reset(q, np.linalg.pinv(tool_jacobian(q, Robot())) @ [0.0, 0.0, -0.03, 0.0, 0.0, 0.0])
    start = plant.tool_motion()
    for _ in range(300):
        plant.step(plant.gravity_torque(), NOTHING, NOTHING, ARM.hold_damping_nms)
    assert 0 < start[2] - plant.tool_motion()[2] < 1e-3
    assert np.abs(plant.v).max() < 1e-3


ROBOT = Robot(tool_mass_kg=0.6)


def _settle(plant: Plant, force: np.ndarray = NOTHING, moment: np.ndarray = NOTHING) -> np.ndarray:
    """Return the true wrench at the sensor with the arm held still."""
    for _ in range(3):
        plant.step(plant.gravity_torque(), force, moment, np.full(7, 1e6))
    return np.array(plant.sensor_wrench())


@pytest.mark.parametrize("make", [DartPlant, MujocoPlant])
def test_reading_is_right_before_the_first_step(make: type[Plant]) -> None:
    wrench = make(ROBOT, NOMINAL).sensor_wrench()
    np.testing.assert_allclose(wrench, [0.0, 0.0, ROBOT.tool_mass_kg * GRAVITY, 0.0, 0.0, 0.0], atol=1e-9)


@pytest.mark.parametrize(("make", "error_n"), [(DartPlant, 0.01), (MujocoPlant, 0.1)])
def test_press_from_below_pushes_along_minus_z_of_the_sensor(make: type[Plant], error_n: float) -> None:
    """HOME holds the tool straight down; tissue presses the sphere upwards, so into the flange: -z of the sensor."""
    plant = make(ROBOT, NOMINAL)
    free = _settle(plant)
    pressed = _settle(plant, force=np.array([0.0, 0.0, 5.0]))
    np.testing.assert_allclose((pressed - free)[:3], [0.0, 0.0, -5.0], atol=error_n)


def test_moving_tool_reads_weight_contact_and_inertia() -> None:
    """Newton and Euler for the body below the sensor, from pinocchio, along a motion of the plant."""
    plant = DartPlant(ROBOT, NOMINAL)
    model, data = _model(ROBOT)
    frame = model.getFrameId("ft_sensor")
    X_SI = pin.SE3(np.eye(3), np.array([0.0, 0.0, TOOL.ft_to_indenter_m]))
    bodies = {name: pin.Inertia(i.mass, np.array(i.com), np.diag(i.diagonal)) for name, i in robot_arm.inertias(ROBOT).items()}
    tool = bodies["ft_sensor"] + bodies["indenter"].se3Action(X_SI)
    rng = np.random.default_rng(5)
    plant.reset(lbr.HOME, rng.uniform(-0.5, 0.5, 7))
    for _ in range(20):
        q, v = plant.q, plant.v
        force, moment = rng.uniform(-10, 10, 3), rng.uniform(-0.5, 0.5, 3)
        plant.step(plant.gravity_torque() + rng.uniform(-30, 30, 7), force, moment, np.zeros(7))
        pin.forwardKinematics(model, data, q, v, (plant.v - v) / DT)
        pin.updateFramePlacements(model, data)
        R_WS = data.oMf[frame].rotation
        V, A = pin.getFrameVelocity(model, data, frame), pin.getFrameAcceleration(model, data, frame)
        A.linear -= R_WS.T @ [0.0, 0.0, -GRAVITY]
        expected = X_SI.act(pin.Force(R_WS.T @ force, R_WS.T @ moment)) - (tool * A + V.cross(tool * V))
        np.testing.assert_allclose(plant.sensor_wrench(), expected.vector, atol=1e-8)


class Thorough(DartPlant):
    """Looks for contacts at every step."""

    def _is_clear(self) -> bool:
        return False


@pytest.mark.parametrize(("start", "carried", "touches"), [(lbr.HOME, 1.0, False), (OVER_TABLE, 0.0, True)])
def test_the_same_to_the_bit(start: np.ndarray, carried: float, touches: bool) -> None:
    """An arm that swings in the air, and a limp one that falls onto the table."""
    quick, thorough = DartPlant(Robot(), NOMINAL, start), Thorough(Robot(), NOMINAL, start)
    rng = np.random.default_rng(2)
    free = touched = 0
    for k in range(2500):
        torque = carried * (quick.gravity_torque() + 4 * np.sin(0.003 * k + np.arange(7.0)))
        force, damping = rng.normal(size=3), np.full(7, 3.0)
        quick.step(torque, force, NOTHING, damping)
        thorough.step(torque, force, NOTHING, damping)
        free += quick._free_travel > CLEARANCE.min_rad
        touched += contacts(thorough) > 0
        assert contacts(thorough) == (contacts(quick) if quick._free_travel <= CLEARANCE.min_rad else 0)
        np.testing.assert_array_equal(quick.q, thorough.q)
        np.testing.assert_array_equal(quick.v, thorough.v)
        np.testing.assert_array_equal(quick.sensor_wrench(), thorough.sensor_wrench())
    assert bool(touched) is touches
    assert free > 100, "the test shall see steps without a search"


def postures(count: int, seed: int = 1) -> np.ndarray:
    """Random postures well above the table."""
    return lbr.HOME + np.random.default_rng(seed).uniform(-0.3, 0.3, (count, 7))


@pytest.mark.parametrize("drawn", [NOMINAL, draw_errors(Errors(level="poor"), 7).arm], ids=["nominal", "poor"])
def test_poses_twist_and_gravity_are_the_same(drawn: DrawnArm) -> None:
    robot, rng = Robot(base_xy_m=(0.05, -0.1), base_yaw_rad=0.3), np.random.default_rng(2)
    mujoco, dart = (plant(robot, drawn=drawn) for plant in (MujocoPlant, DartPlant))
    for q in postures(10):
        v = rng.uniform(-1, 1, 7)
        mujoco.reset(q, v)
        dart.reset(q, v)
        poses, poses_dart = mujoco.link_poses(), dart.link_poses()
        np.testing.assert_allclose(poses[:, :3], poses_dart[:, :3], atol=1e-9)
        turns, turns_dart = (Rotation.from_quat(found[:, 3:]).as_matrix() for found in (poses, poses_dart))
        np.testing.assert_allclose(turns, turns_dart, atol=1e-9)
        np.testing.assert_array_equal(mujoco.tool_motion()[:7], poses[-1])
        np.testing.assert_allclose(mujoco.tool_motion()[7:], dart.tool_motion()[7:], atol=1e-9)
        np.testing.assert_allclose(mujoco.gravity_torque(), dart.gravity_torque(), atol=1e-6)
        own = dart._links["indenter"].getTransform().translation()  # DART's own chain, not our table
        np.testing.assert_allclose(own, poses[-1, :3], atol=1e-9)


def excited(robot: Robot, q: np.ndarray, ticks: int = 400) -> Iterator[tuple[MujocoPlant, DartPlant]]:
    """Both arms under the same torques and the same force at the tool, as strong as in an examination."""
    mujoco, dart = MujocoPlant(robot, NOMINAL), DartPlant(robot, NOMINAL)
    mujoco.reset(q)
    dart.reset(q)
    strength = np.array([20.0, 20.0, 15.0, 15.0, 6.0, 4.0, 2.0])
    for tick in range(ticks):
        torque = strength * np.sin(tick / 30 + np.arange(7))
        force = np.array([3.0, -2.0, 15.0]) * np.sin(tick / 50)
        for plant in (mujoco, dart):
            plant.step(plant.gravity_torque() + torque, force, np.array([0.1, 0.2, 0.05]), np.zeros(7))
        yield mujoco, dart


@pytest.mark.parametrize(("friction", "part"), [(0.0, 1.0), (Robot().joint_friction_nm, 0.95)])
def test_forced_response_agrees_while_the_tool_moves_centimetres(friction: float, part: float) -> None:
    """The difference is half a millisecond of motion. Where a joint turns round, friction jumps, one step earlier or later."""
    positions, errors, readings = [], [], []
    for mujoco, dart in excited(Robot(joint_friction_nm=friction), postures(1, seed=3)[0]):
        p, p_dart = mujoco.tool_motion()[:3], dart.tool_motion()[:3]
        positions.append(p)
        errors.append(np.linalg.norm(p - p_dart))
        readings.append((mujoco.sensor_wrench(), dart.sensor_wrench()))
    assert np.ptp(positions, axis=0).max() > 0.02
    assert np.max(errors) < 2e-4
    mujoco_read, dart_read = np.array(readings[50:]).transpose(1, 0, 2)
    difference = np.quantile(np.abs(mujoco_read - dart_read), part, axis=0)
    assert np.ptp(dart_read, axis=0)[:3].max() > 20
    assert difference[:3].max() < 0.2, "N, of the F/T sensor, while the tool is accelerated"
    assert difference[3:].max() < 0.02, "N m"


MS = 1_000_000
STILL = np.zeros(7)


class Arm:
    """A plant that follows positions."""

    def __init__(self, plant: type) -> None:
        self.plant = plant(Robot(), NOMINAL)
        self.loop = PositionLoop(ARM, self.plant.q)

    def step(self, command: np.ndarray | None, force_W: np.ndarray | None = None, age: int = 0) -> np.ndarray:
        gravity = self.plant.gravity_torque()
        torque = self.loop.torque(command, self.plant.q, self.plant.v, gravity, age)
        assert (np.abs(torque + gravity - self.loop.damping * self.plant.v) <= ARM.torque_nm + 1e-9).all()
        self.plant.step(gravity + torque, force_W, np.zeros(3), self.loop.damping)
        return self.plant.q - HOME


@pytest.mark.parametrize("plant", [DartPlant, MujocoPlant])
def test_a_ramp_is_followed_after_the_latency(plant: type) -> None:
    arm, speed = Arm(plant), 0.3
    for k in range(500):
        moved = arm.step(HOME + speed * k * DT)
    np.testing.assert_allclose(moved, speed * (499 * DT - TUNING.latency_ns / NS), atol=1.5e-3)
    assert np.abs(arm.plant.v - speed).max() < 0.02


def test_late_and_missed_commands_do_not_jerk_it() -> None:
    """By the wall clock commands come late, in bursts, and not all of them."""
    arm, speed, ages = Arm(DartPlant), 0.3, np.random.default_rng(1)
    newest = 0
    for k in range(500):
        if k - newest > ages.integers(1, 12):
            newest = k
        arm.step(HOME + speed * newest * DT, age=(k - newest) * MS)
        if k > 200:
            assert np.abs(arm.plant.v - speed).max() < 0.02


def test_an_arm_that_falls_behind_its_commands_keeps_their_speed() -> None:
    """By the wall clock the simulation falls behind control, here at half its pace."""
    arm, speed = Arm(DartPlant), 0.3
    for k in range(380):
        newest = k + max(k - 200, 0)
        arm.step(HOME + speed * newest * DT, age=(k - newest) * MS)
        if k > 200:
            assert np.abs(arm.plant.v - speed).max() < 0.02


@pytest.mark.parametrize("plant", [DartPlant, MujocoPlant])
def test_a_load_hardly_moves_it(plant: type) -> None:
    arm = Arm(plant)
    for _ in range(400):
        moved = arm.step(HOME, np.array((0.0, 0.0, 15.0)))
    assert 1e-5 < np.abs(moved).max() < 1e-3


def test_without_commands_it_stops_within_its_acceleration() -> None:
    arm = Arm(DartPlant)
    for k in range(300):
        before = arm.step(HOME + 0.5 * k * DT)
    for _ in range(300):
        after = arm.step(None)
    assert np.abs(arm.plant.v).max() < 2e-3
    braking = 0.5**2 / (2 * TUNING.acceleration_factor * ARM.acceleration_radps2)
    np.testing.assert_allclose(after - before, braking, atol=0.01)


def test_the_largest_jump_that_the_driver_takes_is_followed_within_the_limits() -> None:
    arm, jump = Arm(DartPlant), 0.02
    for _ in range(400):
        moved = arm.step(HOME + jump)
        assert (np.abs(arm.plant.v) <= 1.05 * ARM.velocity_radps).all()
        assert (moved < 1.5 * jump).all()
    np.testing.assert_allclose(moved, jump, atol=1e-3)


@pytest.mark.parametrize(
    ("wanted", "cause"),
    [
        (HOME + 0.5, HoldCause.INVALID_COMMAND),
        (np.where(np.arange(7) == 2, np.nan, HOME), HoldCause.INVALID_COMMAND),
        (np.where(np.arange(7) == 2, 4.0, HOME), HoldCause.POSITION_LIMIT),
        (np.zeros(0), HoldCause.INVALID_COMMAND),
    ],
)
def test_the_driver_refuses_positions_that_cannot_be(wanted: np.ndarray, cause: HoldCause) -> None:
    driver = Driver(ARM, 40.0, positions=True)
    update = {"q": HOME, "v": STILL, "gravity": STILL, "force": 0.0, "lost": False}
    np.testing.assert_array_equal(driver.update(MS, command=Command(HOME + 0.01, MS, 50 * MS), **update), HOME + 0.01)
    driver.update(2 * MS, command=Command(wanted, 2 * MS, 50 * MS), **update)
    assert (driver.mode, driver.cause) == (DriverMode.SAFE_HOLD, cause)
