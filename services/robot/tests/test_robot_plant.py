"""The plant against pinocchio, which shares none of its code, and against what physics demands."""

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

from palpate_models.numerics.gravity import GRAVITY
from palpate_models.robot import lbr
from palpate_models.scenario.schema import Robot
from palpate_robot.backends.dart.plant import DartPlant
from palpate_robot.driver import HOLD_DAMPING
from palpate_robot.plant import DT, END_STOP_MARGIN_RAD, STICK_RADPS

NOTHING = np.zeros(3)
NO_DAMPING = np.zeros(7)
FREE = Robot(joint_damping_nms=0.0, joint_friction_nm=0.0)


def _postures(count: int, seed: int = 1) -> np.ndarray:
    """Random postures well above the table."""
    rng = np.random.default_rng(seed)
    return lbr.HOME + rng.uniform(-0.3, 0.3, (count, 7))


def _model(robot: Robot) -> tuple[pin.Model, pin.Data]:
    model = pin.buildModelFromXML(lbr.urdf(robot))
    model.gravity.linear = np.array([0.0, 0.0, -GRAVITY])
    return model, model.createData()


@pytest.mark.parametrize("link", lbr.LINK_NAMES)
def test_forward_kinematics_agrees_with_pinocchio(link: str) -> None:
    robot = Robot(base_xy_m=(0.05, -0.1), base_yaw_rad=0.3)
    plant = DartPlant(robot)
    model, data = _model(robot)
    for q in _postures(20):
        plant.reset(q)
        pin.framesForwardKinematics(model, data, q)
        p_WL, rotation = plant.link_pose(link)
        X_WL = data.oMf[model.getFrameId(link)]
        np.testing.assert_allclose(p_WL, X_WL.translation, atol=1e-9)
        np.testing.assert_allclose(rotation.to_rotation_matrix(), X_WL.rotation, atol=1e-9)


def test_tool_motion_agrees_with_pinocchio() -> None:
    robot = Robot(base_xy_m=(0.05, -0.1), base_yaw_rad=0.3)
    plant = DartPlant(robot)
    model, data = _model(robot)
    rng = np.random.default_rng(2)
    frame = model.getFrameId("indenter")
    for q in rng.uniform(-2, 2, (200, 7)):  # each part of the quaternion is the largest of some
        v = rng.uniform(-1, 1, 7)
        plant.reset(q, v)
        pin.forwardKinematics(model, data, q, v)
        pin.updateFramePlacements(model, data)
        twist = pin.getFrameVelocity(model, data, frame, pin.LOCAL_WORLD_ALIGNED)
        motion = plant.tool_motion()
        np.testing.assert_allclose(motion[:3], data.oMf[frame].translation, atol=1e-12)
        np.testing.assert_allclose(Rotation.from_quat(motion[3:7]).as_matrix(), data.oMf[frame].rotation, atol=1e-12)
        np.testing.assert_allclose(motion[7:10], twist.linear, atol=1e-12)
        np.testing.assert_allclose(motion[10:], twist.angular, atol=1e-12)


def test_poses_and_weight_are_the_engines() -> None:
    plant = DartPlant(FREE)
    model, data = _model(FREE)
    rng = np.random.default_rng(5)
    for q in rng.uniform(-2, 2, (50, 7)):
        plant.reset(q)
        engine = [plant.link_pose(link) for link in lbr.LINK_NAMES]
        poses = plant.link_poses()
        np.testing.assert_allclose(poses[:, :3], [p for p, _ in engine], atol=1e-12)
        np.testing.assert_allclose(poses[:, 3:], [(r.x(), r.y(), r.z(), r.w()) for _, r in engine], atol=1e-12)
        np.testing.assert_array_equal(plant.tool_motion()[:7], poses[-1])
        np.testing.assert_allclose(plant.gravity_torque(), pin.computeGeneralizedGravity(model, data, q), atol=1e-11)
        np.testing.assert_allclose(plant.gravity_torque(), plant._arm.getGravityForces(), atol=1e-11)


def test_accelerations_agree_with_pinocchio_under_a_tool_wrench() -> None:
    plant = DartPlant(FREE)
    model, data = _model(FREE)
    rng = np.random.default_rng(3)
    frame = model.getFrameId("indenter")
    for q in _postures(10):
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
    plant = DartPlant(robot)
    model, data = _model(robot)
    rng = np.random.default_rng(4)
    for extra in (0.0, 40.0):
        for q in _postures(5):
            v, torque = rng.uniform(-1, 1, 7), rng.uniform(-20, 20, 7)
            v[3] = 0.0
            plant.reset(q, v)
            plant.step(torque, NOTHING, NOTHING, np.full(7, extra))
            D = robot.joint_damping_nms + extra + robot.joint_friction_nm / np.maximum(np.abs(v), STICK_RADPS)
            h = pin.rnea(model, data, q, v, np.zeros(7))
            M = pin.crba(model, data, q)
            M = np.triu(M) + np.triu(M, 1).T
            expected = np.linalg.solve(M + DT * np.diag(D), torque - h - D * v)
            np.testing.assert_allclose(plant.v, v + DT * expected, rtol=1e-9, atol=1e-9)


def test_gravity_torque_holds_the_arm_still() -> None:
    plant = DartPlant(FREE)
    for q in _postures(3):
        plant.reset(q)
        for _ in range(300):
            plant.step(plant.gravity_torque(), NOTHING, NOTHING, NO_DAMPING)
        np.testing.assert_allclose(plant.q, q, atol=1e-9)


def test_without_friction_energy_is_conserved_and_with_it_it_decays() -> None:
    v = np.array([0.3, -0.2, 0.4, 0.3, -0.5, 0.4, 0.6])
    energies = {}
    for robot in (FREE, Robot()):
        plant = DartPlant(robot)
        plant.reset(lbr.HOME, v)
        start = plant.kinetic_energy()
        history = []
        for _ in range(200):
            plant.step(plant.gravity_torque(), NOTHING, NOTHING, NO_DAMPING)
            history.append(plant.kinetic_energy() / start)
        energies[robot] = np.array(history)
    assert np.abs(energies[FREE] - 1).max() < 0.01
    assert np.all(np.diff(energies[Robot()]) <= 1e-12)
    assert energies[Robot()][-1] < 0.1


@pytest.mark.parametrize("joint", range(7))
def test_coulomb_friction_sticks_below_its_limit_and_slides_against_it_above(joint: int) -> None:
    robot = Robot(joint_friction_nm=0.5)
    plant = DartPlant(robot, np.zeros(7))
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


def test_slow_motion_is_motion() -> None:
    """2 mrad/s, a millimetre a second at the tool, for seconds, and from rest: nothing falls asleep."""
    robot = Robot(joint_friction_nm=0.0)
    plant = DartPlant(robot)
    push = np.zeros(7)
    for _ in range(1000):
        plant.step(plant.gravity_torque(), NOTHING, NOTHING, NO_DAMPING)
    push[0] = 2e-3 * robot.joint_damping_nms
    for _ in range(2500):
        plant.step(plant.gravity_torque() + push, NOTHING, NOTHING, NO_DAMPING)
    assert plant.v[0] == pytest.approx(2e-3, rel=1e-3)
    assert plant.q[0] == pytest.approx(2e-3 * 2.5, rel=0.05)


def test_end_stop_stops_the_joint() -> None:
    plant = DartPlant(Robot())
    push = np.zeros(7)
    push[6] = 30.0
    for _ in range(1500):
        plant.step(plant.gravity_torque() + push, NOTHING, NOTHING, NO_DAMPING)
    stop = lbr.POSITION_LIMIT[6] + END_STOP_MARGIN_RAD
    assert plant.q[6] == pytest.approx(stop, abs=2e-3)


def test_arm_comes_to_rest_on_the_table_not_in_it() -> None:
    robot = Robot()
    plant = DartPlant(robot, np.deg2rad([0.0, 60.0, 0.0, -60.0, 0.0, 20.0, 0.0]))
    touched = 0
    for _ in range(2500):
        plant.step(NO_DAMPING, NOTHING, NOTHING, NO_DAMPING)  # limp: nothing carries the arm
        touched = max(touched, plant.contacts())
    assert touched > 0
    p_WI, _ = plant.link_pose("indenter")
    if 0.285 < p_WI[0] < 0.835:
        assert p_WI[2] > 0.73 + robot.indenter_radius_m - 2e-3
    wrist, _ = plant.link_pose("lbr_link_7")
    assert wrist[2] > 0.73


def test_hold_stops_a_moving_tool_within_a_millimetre() -> None:
    """Straight down at 30 mm/s, the scan's speed, when the hold begins; no tissue helps to stop it."""
    robot = Robot()
    model, data = _model(robot)
    frame = model.getFrameId("indenter")
    q = np.deg2rad([0.0, 30.0, 0.0, -80.0, 0.0, 70.0, 0.0])
    J = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)
    plant = DartPlant(robot)
    plant.reset(q, np.linalg.pinv(J) @ [0.0, 0.0, -0.03, 0.0, 0.0, 0.0])
    start = plant.tool_motion()
    for _ in range(300):
        plant.step(plant.gravity_torque(), NOTHING, NOTHING, HOLD_DAMPING)
    end = plant.tool_motion()
    assert 0 < start[2] - end[2] < 1e-3
    assert np.abs(plant.v).max() < 1e-3
