"""Description of the robot: frames, limits, inertias, collision and visual meshes."""

import numpy as np
import pinocchio as pin
import pytest
import trimesh

from palpate_models.robot import arm as robot_arm, lbr
from palpate_models.robot.arm import TOOL, link_names, link_transforms, tool_pose, urdf
from palpate_models.robot.chain import Capsule
from palpate_models.robot.fitting import enclosing_capsule
from palpate_models.robot.table import Box, boxes
from palpate_models.robot.visual import VisualMesh, visual_meshes
from palpate_models.scenario.schema import Robot

LINKS = link_names(Robot())


@pytest.fixture(scope="module")
def model() -> pin.Model:
    return pin.buildModelFromXML(urdf(Robot()))


def test_upright_arm_has_the_published_height(model: pin.Model) -> None:
    data = model.createData()
    pin.framesForwardKinematics(model, data, np.zeros(7))
    flange = data.oMf[model.getFrameId("lbr_link_ee")]
    # 1.266 m from the base to the flange of an iiwa 7 R800 (340 + 400 + 400 + 126 mm)
    np.testing.assert_allclose(flange.translation, [*Robot().base_xy_m, Robot().base_height_m + 1.266], atol=1e-12)
    indenter = data.oMf[model.getFrameId("indenter")]
    tool = TOOL.flange_to_ft_m + TOOL.ft_to_indenter_m
    np.testing.assert_allclose(flange.actInv(indenter).translation, [0.0, 0.0, tool], atol=1e-12)
    np.testing.assert_allclose(flange.rotation, indenter.rotation, atol=1e-12)


def test_home_is_inside_the_limits_and_points_the_tool_down(model: pin.Model) -> None:
    assert np.all(np.abs(lbr.HOME) < lbr.POSITION_LIMIT - np.deg2rad(10))
    data = model.createData()
    pin.framesForwardKinematics(model, data, lbr.HOME)
    X_WI = data.oMf[model.getFrameId("indenter")]
    np.testing.assert_allclose(X_WI.rotation[:, 2], [0.0, 0.0, -1.0], atol=1e-9)
    assert X_WI.translation[0] < 0.285, "the tool is off the table, out of the camera's view"


def test_urdf_refers_to_no_file_and_shapes_can_be_left_out() -> None:
    text = urdf(Robot())
    assert "mesh" not in text and "filename" not in text
    bare = urdf(Robot(), geometry=False)
    assert "geometry" not in bare
    assert bare.count("<inertial>") == text.count("<inertial>") == len(LINKS)


def test_collision_primitives_are_the_capsules(model: pin.Model) -> None:
    """Every capsule's cylinder runs from its start to its end."""
    robot = Robot(indenter_radius_m=0.02)
    geometry = pin.buildGeomFromUrdfString(model, urdf(robot), pin.COLLISION)
    cylinders = [o for o in geometry.geometryObjects if type(o.geometry).__name__ == "Cylinder"]
    capsules = [(link, c) for link, cs in robot_arm.capsules(robot).items() for c in cs if c.start != c.end]
    assert len(cylinders) == len(capsules)
    for shape, (link, capsule) in zip(cylinders, capsules, strict=True):
        assert shape.name.startswith(link)
        X_JL = model.frames[model.getFrameId(link)].placement
        X_LC = X_JL.actInv(shape.placement)
        half = np.array([0.0, 0.0, shape.geometry.halfLength])
        np.testing.assert_allclose(X_LC.act(-half), capsule.start, atol=1e-9)
        np.testing.assert_allclose(X_LC.act(half), capsule.end, atol=1e-9)
        assert shape.geometry.radius == capsule.radius
    tip = robot_arm.capsules(robot)["indenter"]
    assert tip == (Capsule((0, 0, 0), (0, 0, 0), 0.02),)


ROBOT = Robot(base_yaw_rad=0.3)


@pytest.mark.parametrize("q", [lbr.HOME, np.linspace(-1, 1, 7), np.full(7, 0.4)])
def test_every_link_is_where_the_urdf_has_it(q: np.ndarray) -> None:
    model = pin.buildModelFromXML(urdf(ROBOT))
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    X = np.eye(4)
    for parent, child, X_PC in link_transforms(q, ROBOT):
        assert parent == "world" or model.existFrame(parent)
        X = X @ X_PC
        np.testing.assert_allclose(X, data.oMf[model.getFrameId(child)].homogeneous, atol=1e-9)
    np.testing.assert_allclose(X, tool_pose(q, ROBOT))


def _corners(box: Box) -> np.ndarray:
    signs = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, -1).T
    return signs * box.size @ box.X_WB[:3, :3].T + box.X_WB[:3, 3]


def test_base_carries_the_robot_and_clears_the_table() -> None:
    robot = Robot(base_xy_m=(0.02, 0.3), base_height_m=0.6, base_yaw_rad=0.1)
    base = next(box for box in boxes(robot) if box.name == "robot_base")
    corners = _corners(base)
    assert corners[:, 2].min() == pytest.approx(0.0)
    assert corners[:, 2].max() == pytest.approx(robot.base_height_m)
    np.testing.assert_allclose(corners.mean(axis=0)[:2], robot.base_xy_m)
    assert corners[:, 0].max() < 0.285


@pytest.fixture(scope="module")
def meshes() -> dict[str, list[VisualMesh]]:
    return visual_meshes(Robot())


def test_meshes_are_closed_and_face_outward(meshes: dict[str, list[VisualMesh]]) -> None:
    for link, parts in meshes.items():
        for part in parts:
            body = trimesh.Trimesh(part.vertices, part.triangles)  # merges the doubled vertices of closed ends
            assert body.is_watertight and body.is_winding_consistent, link
            assert body.volume > 0, link
            assert all(0 <= value <= 1 for value in part.rgba)


def _outside(points: np.ndarray, capsules: tuple[Capsule, ...]) -> float:
    """Distance of the farthest point outside all capsules [m]."""
    distances = []
    for capsule in capsules:
        start, axis = np.array(capsule.start), np.subtract(capsule.end, capsule.start)
        share = np.clip((points - start) @ axis / max(axis @ axis, 1e-12), 0.0, 1.0)
        distances.append(np.linalg.norm(points - start - share[:, None] * axis, axis=1) - capsule.radius)
    return float(np.min(distances, axis=0).max())


def test_a_fitted_capsule_encloses_its_points() -> None:
    rng = np.random.default_rng(1)
    for scale in rng.uniform(0.02, 0.5, (20, 3)):
        points = rng.standard_normal((200, 3)) * scale + rng.uniform(-1, 1, 3)
        assert _outside(points, (enclosing_capsule(points),)) < 1e-9


@pytest.mark.parametrize("link", LINKS[1:8])
def test_collision_capsules_enclose_the_housing(link: str, meshes: dict[str, list[VisualMesh]]) -> None:
    points = np.concatenate([part.vertices for part in meshes[link]])
    assert _outside(points, robot_arm.capsules(Robot())[link]) < 0.005
