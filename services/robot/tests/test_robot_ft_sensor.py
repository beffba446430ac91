"""The F/T reading: the tool's weight in any orientation, contact's sign, inertia, and the sensor's errors."""

import numpy as np
import pinocchio as pin
import pytest

from palpate_models.numerics.gravity import GRAVITY
from palpate_models.robot import lbr
from palpate_models.scenario.schema import Robot
from palpate_robot.backends.dart.plant import DT, DartPlant

NOTHING = np.zeros(3)
ROBOT = Robot(tool_mass_kg=0.6)


def _settle(plant: DartPlant, force: np.ndarray = NOTHING, moment: np.ndarray = NOTHING) -> np.ndarray:
    """The true wrench at the sensor with the arm held still."""
    for _ in range(3):
        plant.step(plant.gravity_torque(), force, moment, np.full(7, 1e6))
    return np.array(plant.sensor_wrench())


def _centre_of_mass(robot: Robot) -> np.ndarray:
    """Centre of mass of what is below the sensor, in its frame [m]."""
    inertias = lbr.inertias(robot)
    standoff, sphere = inertias["ft_sensor"], inertias["indenter"]
    at = np.array([0.0, 0.0, lbr.FT_TO_INDENTER_M])
    moment = standoff.mass * np.array(standoff.com) + sphere.mass * (np.array(sphere.com) + at)
    return np.asarray(moment / (standoff.mass + sphere.mass))


@pytest.mark.parametrize("seed", range(6))
def test_static_reading_is_the_tools_weight(seed: int) -> None:
    rng = np.random.default_rng(seed)
    plant = DartPlant(ROBOT, lbr.HOME + rng.uniform(-0.3, 0.3, 7))
    wrench = _settle(plant)
    R_WS = plant.link_pose("ft_sensor")[1].to_rotation_matrix()
    weight_S = R_WS.T @ [0.0, 0.0, -ROBOT.tool_mass_kg * GRAVITY]
    np.testing.assert_allclose(wrench[:3], weight_S, atol=1e-3)
    np.testing.assert_allclose(wrench[3:], np.cross(_centre_of_mass(ROBOT), weight_S), atol=1e-4)


def test_reading_is_right_before_the_first_step() -> None:
    wrench = DartPlant(ROBOT).sensor_wrench()
    np.testing.assert_allclose(wrench, [0.0, 0.0, ROBOT.tool_mass_kg * GRAVITY, 0.0, 0.0, 0.0], atol=1e-9)


def test_press_from_below_pushes_along_minus_z_of_the_sensor() -> None:
    """HOME holds the tool straight down; tissue presses the sphere upwards, so into the flange: -z of the sensor."""
    plant = DartPlant(ROBOT)
    free = _settle(plant)
    pressed = _settle(plant, force=np.array([0.0, 0.0, 5.0]))
    np.testing.assert_allclose((pressed - free)[:3], [0.0, 0.0, -5.0], atol=0.01)


def test_sideways_force_has_the_lever_of_the_standoff() -> None:
    plant = DartPlant(ROBOT)
    free = _settle(plant)
    force_W = np.array([0.0, 3.0, 0.0])  # HOME turns the tool by pi about y, so y of the sensor is y of world
    pushed = _settle(plant, force=force_W, moment=np.array([0.0, 0.02, 0.0])) - free
    np.testing.assert_allclose(pushed[:3], [0.0, 3.0, 0.0], atol=0.01)
    np.testing.assert_allclose(pushed[3:], [-3.0 * lbr.FT_TO_INDENTER_M, 0.02, 0.0], atol=1e-3)


def test_moving_tool_reads_weight_contact_and_inertia() -> None:
    """Newton and Euler for the body below the sensor, from pinocchio, along a motion of the plant."""
    plant = DartPlant(ROBOT, lbr.HOME)
    model = pin.buildModelFromXML(lbr.urdf(ROBOT, geometry=False))
    data = model.createData()
    frame = model.getFrameId("ft_sensor")
    inertias = lbr.inertias(ROBOT)
    X_SI = pin.SE3(np.eye(3), np.array([0.0, 0.0, lbr.FT_TO_INDENTER_M]))
    spatial = {
        link: pin.Inertia(i.mass, np.array(i.com), np.diag(i.diagonal))
        for link, i in inertias.items()
        if link in ("ft_sensor", "indenter")
    }
    tool = spatial["ft_sensor"] + spatial["indenter"].se3Action(X_SI)
    rng = np.random.default_rng(5)
    plant.reset(lbr.HOME, rng.uniform(-0.5, 0.5, 7))
    for _ in range(20):
        q, v = plant.q, plant.v
        force, moment = rng.uniform(-10, 10, 3), rng.uniform(-0.5, 0.5, 3)
        plant.step(plant.gravity_torque() + rng.uniform(-30, 30, 7), force, moment, np.zeros(7))
        a = (plant.v - v) / DT
        pin.forwardKinematics(model, data, q, v, a)
        pin.updateFramePlacements(model, data)
        X_WS = data.oMf[frame]
        V = pin.getFrameVelocity(model, data, frame)
        A = pin.getFrameAcceleration(model, data, frame)
        A.linear -= X_WS.rotation.T @ [0.0, 0.0, -GRAVITY]
        needed = tool * A + V.cross(tool * V)
        contact_I = pin.Force(X_WS.rotation.T @ force, X_WS.rotation.T @ moment)
        expected = X_SI.act(contact_I) - needed
        np.testing.assert_allclose(plant.sensor_wrench(), expected.vector, atol=1e-8)
