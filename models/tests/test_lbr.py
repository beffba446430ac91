"""The URDF against the published figures, read back by pinocchio, and against itself."""

from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest

from palpate_models.robot import lbr
from palpate_models.scenario.schema import Robot


@pytest.fixture(scope="module")
def model() -> pin.Model:
    return pin.buildModelFromXML(lbr.urdf(Robot()))


def test_masses_are_the_published_ones() -> None:
    robot = Robot(tool_mass_kg=0.5)
    inertias = lbr.inertias(robot)
    assert sum(inertias[f"lbr_link_{i}"].mass for i in range(8)) == pytest.approx(23.9, abs=1e-5)
    below_sensor = inertias["ft_sensor"].mass + inertias["indenter"].mass
    assert below_sensor == pytest.approx(robot.tool_mass_kg)
    total = sum(float(link.find("inertial/mass").get("value")) for link in _links(robot) if link.find("inertial"))
    assert total == pytest.approx(23.9 + lbr.FT_SENSOR_MASS_KG + robot.tool_mass_kg, abs=1e-5)


def _links(robot: Robot) -> list[ElementTree.Element]:
    return list(ElementTree.fromstring(lbr.urdf(robot)).iter("link"))


def test_limits_reach_the_reader_of_the_urdf(model: pin.Model) -> None:
    degrees = np.rad2deg(model.upperPositionLimit)
    np.testing.assert_allclose(degrees, [170, 120, 170, 120, 170, 120, 175])
    np.testing.assert_array_equal(model.lowerPositionLimit, -model.upperPositionLimit)
    np.testing.assert_allclose(np.rad2deg(model.velocityLimit), [98, 98, 100, 130, 140, 180, 180])
    np.testing.assert_array_equal(model.effortLimit, [176, 176, 110, 110, 110, 40, 40])


def test_joints_and_links_have_the_names_of_the_ros2_stack(model: pin.Model) -> None:
    assert tuple(model.names)[1:] == lbr.JOINT_NAMES
    assert all(model.existFrame(link) for link in lbr.LINK_NAMES)


def test_upright_arm_has_the_published_height(model: pin.Model) -> None:
    data = model.createData()
    pin.framesForwardKinematics(model, data, np.zeros(7))
    flange = data.oMf[model.getFrameId("lbr_link_ee")]
    # 1.266 m from the base to the flange of an iiwa 7 R800 (340 + 400 + 400 + 126 mm)
    np.testing.assert_allclose(flange.translation, [*Robot().base_xy_m, Robot().base_height_m + 1.266], atol=1e-12)
    indenter = data.oMf[model.getFrameId("indenter")]
    tool = lbr.FLANGE_TO_FT_M + lbr.FT_TO_INDENTER_M
    np.testing.assert_allclose(flange.actInv(indenter).translation, [0.0, 0.0, tool], atol=1e-12)
    np.testing.assert_allclose(flange.rotation, indenter.rotation, atol=1e-12)


def test_base_stands_where_the_scenario_says() -> None:
    robot = Robot(base_xy_m=(0.1, -0.2), base_height_m=0.5, base_yaw_rad=0.7)
    model = pin.buildModelFromXML(lbr.urdf(robot))
    data = model.createData()
    pin.framesForwardKinematics(model, data, np.zeros(7))
    X_WB = data.oMf[model.getFrameId("lbr_link_0")]
    np.testing.assert_allclose(X_WB.translation, [0.1, -0.2, 0.5], atol=1e-12)
    np.testing.assert_allclose(pin.rpy.matrixToRpy(X_WB.rotation), [0.0, 0.0, 0.7], atol=1e-12)


def test_home_is_inside_the_limits_and_points_the_tool_down(model: pin.Model) -> None:
    assert np.all(np.abs(lbr.HOME) < lbr.POSITION_LIMIT - np.deg2rad(10))
    data = model.createData()
    pin.framesForwardKinematics(model, data, lbr.HOME)
    X_WI = data.oMf[model.getFrameId("indenter")]
    np.testing.assert_allclose(X_WI.rotation[:, 2], [0.0, 0.0, -1.0], atol=1e-9)
    assert X_WI.translation[0] < 0.285, "the tool is off the table, out of the camera's view"


def test_inertias_are_physical() -> None:
    for link, inertia in lbr.inertias(Robot()).items():
        (ixx, iyy, izz), (ixy, ixz, iyz) = inertia.diagonal, inertia.products
        principal = np.linalg.eigvalsh([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
        assert principal[0] > 0, link
        assert principal[0] + principal[1] >= principal[2] * (1 - 1e-6), f"{link}: triangle inequality"


def test_urdf_refers_to_no_file_and_shapes_can_be_left_out() -> None:
    text = lbr.urdf(Robot())
    assert "mesh" not in text and "filename" not in text
    bare = lbr.urdf(Robot(), geometry=False)
    assert "geometry" not in bare
    assert bare.count("<inertial>") == text.count("<inertial>") == len(lbr.LINK_NAMES)


def test_collision_primitives_are_the_capsules(model: pin.Model) -> None:
    """Every capsule's cylinder runs from its start to its end."""
    robot = Robot(indenter_radius_m=0.02)
    geometry = pin.buildGeomFromUrdfString(model, lbr.urdf(robot), pin.COLLISION)
    cylinders = [o for o in geometry.geometryObjects if type(o.geometry).__name__ == "Cylinder"]
    capsules = [(link, c) for link, cs in lbr.capsules(robot).items() for c in cs if c.start != c.end]
    assert len(cylinders) == len(capsules)
    for shape, (link, capsule) in zip(cylinders, capsules, strict=True):
        assert shape.name.startswith(link)
        X_JL = model.frames[model.getFrameId(link)].placement
        X_LC = X_JL.actInv(shape.placement)
        half = np.array([0.0, 0.0, shape.geometry.halfLength])
        np.testing.assert_allclose(X_LC.act(-half), capsule.start, atol=1e-9)
        np.testing.assert_allclose(X_LC.act(half), capsule.end, atol=1e-9)
        assert shape.geometry.radius == capsule.radius
    tip = lbr.capsules(robot)["indenter"]
    assert tip == (lbr.Capsule((0, 0, 0), (0, 0, 0), 0.02),)


def test_shared_tables_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="read-only"):
        lbr.HOME[0] = 1.0
