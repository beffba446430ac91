"""MuJoCo's plant against DART's: two engines, two step sizes, one arm."""

from collections.abc import Iterator

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from palpate_models.robot import lbr
from palpate_models.scenario.errors import DrawnArm, Errors, draw_errors
from palpate_models.scenario.schema import Robot
from palpate_robot.backends.dart.plant import DartPlant
from palpate_robot.backends.mujoco.plant import MujocoPlant


def postures(count: int, seed: int = 1) -> np.ndarray:
    """Random postures well above the table."""
    return lbr.HOME + np.random.default_rng(seed).uniform(-0.3, 0.3, (count, 7))


@pytest.mark.parametrize("drawn", [None, draw_errors(Errors(level="poor"), 7).arm], ids=["nominal", "poor"])
def test_poses_twist_and_gravity_are_the_same(drawn: DrawnArm | None) -> None:
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
        np.testing.assert_allclose(dart.link_pose("indenter")[0], poses[-1, :3], atol=1e-9)  # DART's own chain, not our table


def excited(robot: Robot, q: np.ndarray, ticks: int = 400) -> Iterator[tuple[MujocoPlant, DartPlant]]:
    """Both arms under the same torques and the same force at the tool, as strong as in an examination."""
    mujoco, dart = MujocoPlant(robot), DartPlant(robot)
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
