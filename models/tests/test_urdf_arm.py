"""Arms from a URDF agree with pinocchio, what is broken is named; the description of our own arm."""

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import trimesh
import yaml

from palpate_errors import UserError
from palpate_models.robot import arm as robot_arm, lbr
from palpate_models.robot.arm import TOOL, Box, arm_of, boxes, link_names, link_transforms, tool_jacobian, tool_pose, urdf
from palpate_models.robot.chain import Capsule
from palpate_models.robot.fitting import enclosing_capsule, seeds_of
from palpate_models.robot.urdf_arm import read_arm
from palpate_models.robot.visual import VisualMesh, visual_meshes
from palpate_models.scenario.schema import Robot

TWISTS = ("0 0 0", "-1.5708 0 0", "0 1.5708 0", "1.5708 0 0", "0 -1.5708 0.3", "0.2 0 0")
TENSOR = '<inertia ixx="{x}" iyy="{y}" izz="{z}" ixy="0" ixz="0" iyz="0"/>'
INERTIAL = f'<inertial><origin xyz="0 0 0.05"/><mass value="{{m}}"/>{TENSOR}</inertial>'
XACRO = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arm/></robot>'
FIELDS = (
    "flange",
    "flange_rpy_rad",
    "home_rad",
    "urdf",
    "base",
    "base_heigth_m",
    "base_yaw_rad",
    "seeds_rad",
    "lower_rad",
    "hold_damping_nms",
)
GOOD = {"m": 2.0, "x": 0.02, "y": 0.02, "z": 0.01}


def write(folder: Path, *, inertia: dict[str, float] | None = None, **changes: Any) -> str:
    """Return the YAML file of an arm of six joints; `changes` replace parts of its third joint and link, or of the YAML file."""
    given = {"urdf": "arm.urdf", "flange": "tip", "home_rad": [0.0, 0.3, -0.4, 0.2, 0.5, 0.0]} | {
        key: value for key, value in changes.items() if key in FIELDS
    }
    links = ['<link name="link_0"/>']
    for k, rpy in enumerate(TWISTS, start=1):
        odd = k == 3
        mass = INERTIAL.format(**(GOOD | (inertia or {}) if odd else GOOD))
        shape = '<geometry><cylinder radius="0.05" length="0.2"/></geometry>'
        collision = changes.get("collision", shape) if odd else shape
        links.append(
            f'<link name="link_{k}">{changes.get("inertial", mass) if odd else mass}<collision>{collision}</collision></link>'
        )
        limit = changes.get("limit", "") if odd else ""
        limit = limit or '<limit lower="-2.5" upper="2.5" velocity="2" effort="80"/>'
        kind = changes.get("kind", "revolute") if odd else "revolute"
        links.append(
            f'<joint name="joint_{k}" type="{kind}"><parent link="link_{k - 1}"/><child link="link_{k}"/>'
            f'<origin xyz="0.02 0 0.2" rpy="{rpy}"/><axis xyz="0 0 2"/>{limit}</joint>'
        )
    mount = '<parent link="link_6"/><child link="tip"/><origin xyz="0 0 0.1" rpy="0 0.4 0"/>'
    slide = '<parent link="tip"/><child link="gripper"/><limit lower="0" upper="0.1" velocity="1" effort="1"/>'
    light = INERTIAL.format(m=0.01, x=1e-6, y=1e-6, z=1e-6)  # behind the flange: left out
    links.append(f'<link name="tip">{light}</link><joint name="mount" type="fixed">{mount}</joint>')
    links.append(f'<link name="gripper"/><joint name="slide" type="prismatic">{slide}</joint>')
    whole = f'<robot name="arm">{"".join(links)}</robot>'
    (folder / "arm.urdf").write_text(changes.get("text", whole.replace(*changes.get("swap", ("", "")), 1)))
    path = folder / "arm.yaml"
    path.write_text(yaml.safe_dump(given))
    return str(path)


def test_the_tables_agree_with_pinocchio(tmp_path: Path) -> None:
    name = write(tmp_path)
    robot = Robot(arm=name, base_yaw_rad=0.4)
    arm = arm_of(robot)
    whole = pin.buildModelFromUrdf(str(tmp_path / "arm.urdf"))
    theirs = pin.buildReducedModel(whole, [whole.getJointId("slide")], pin.neutral(whole))
    ours = pin.buildModelFromXML(urdf(robot))
    yaw = pin.SE3(pin.utils.rotate("z", 0.4), np.array((*robot.base_xy_m, robot.base_height_m)))
    rng = np.random.default_rng(0)
    for q in rng.uniform(arm.lower_rad, arm.upper_rad, (5, 6)):
        data, other = ours.createData(), theirs.createData()
        pin.framesForwardKinematics(ours, data, q)
        pin.framesForwardKinematics(theirs, other, q)
        tip = yaw * other.oMf[theirs.getFrameId("tip")]
        np.testing.assert_allclose(data.oMf[ours.getFrameId("tip")].homogeneous, tip.homogeneous, atol=1e-9)
        np.testing.assert_allclose(tool_pose(q, robot), data.oMf[ours.getFrameId("indenter")].homogeneous, atol=1e-9)
        J = pin.computeFrameJacobian(ours, data, q, ours.getFrameId("indenter"), pin.LOCAL_WORLD_ALIGNED)
        np.testing.assert_allclose(tool_jacobian(q, robot), J, atol=1e-9)
        heavy = pin.crba(ours, data, q) - pin.crba(theirs, other, q)  # our tool
        assert np.linalg.eigvalsh(heavy).min() > -1e-9
    assert [inertia.mass for inertia in arm.inertias[1:]] == [2.0] * 6


def limit(lower: str = "-1", upper: str = "1", velocity: int = 2, effort: int = 80) -> dict[str, str]:
    return {"limit": f'<limit lower="{lower}" upper="{upper}" velocity="{velocity}" effort="{effort}"/>'}


def shape(text: str) -> dict[str, str]:
    return {"collision": f"<geometry><{text}/></geometry>"}


def swap(old: str, new: str) -> dict[str, tuple[str, str]]:
    return {"swap": (old, new)}


BROKEN: list[tuple[dict[str, Any], str]] = [
    ({"inertia": {"m": 0.0}}, "link link_3: mass is 0 kg"),
    ({"inertial": ""}, "link link_3: no mass"),
    ({"inertia": {"m": 1e-4, "x": 1e-6, "y": 1e-6, "z": 1e-6}}, "link link_3: no mass: 0.0001 kg"),
    ({"inertia": {"z": -0.01}}, "link link_3: inertia is not positive"),
    ({"inertia": {"x": 0.2}}, "link link_3: inertia against the triangle inequality"),
    ({"inertia": {"x": float("nan")}}, "link link_3: ixx is not finite"),
    ({"inertia": {"x": 2e4, "y": 2e4}}, "link link_3: inertia of 2e+04 kg m^2"),
    ({"inertia": {"m": "${m}"}}, "link link_3: value is '${m}'"),
    (shape('mesh filename="no.stl"'), "link link_3: mesh no.stl is not there"),
    (shape('mesh filename="package://example-robot-data/no.stl"'), "mesh package://example-robot-data/no.stl is not there"),
    (shape('mesh filename="arm.urdf"'), "link link_3: mesh arm.urdf cannot be read"),
    (shape('box size="0.1 0 0.1"'), "link link_3: size of its box"),
    (shape('capsule radius="0.1"'), "link link_3: shape capsule"),
    ({"limit": "<unlimited/>"}, "joint joint_3: no limit"),
    (limit("1", "1"), "joint joint_3: its range"),
    (limit("-0.05", "0.05"), "joint joint_3: its range is -0.05 to 0.05 rad, expected more than 0.1 rad"),
    (limit("-123", "60"), "range is -123 to 60 rad: its unit is not"),
    (limit("-inf", "inf"), "joint joint_3: lower is not finite"),
    (limit(velocity=0), "joint joint_3: velocity_radps is 0"),
    (limit(effort=0), "joint joint_3: torque_nm is 0"),
    ({"limit": '<mimic joint="joint_2"/>'}, "joint joint_3: mimics"),
    ({"kind": "prismatic"}, "joint joint_3: is prismatic"),
    ({"kind": "prismatic", "base": "link_0"}, "is prismatic, between link_0 and tip; expected 6 or 7 joints"),
    ({"kind": "fixed"}, "5 joints"),
    ({"flange": "tool"}, "no link 'tool'"),
    ({"base": "gripper"}, "base: no link 'gripper' before tip; it has link_0, link_1"),
    ({"base": "link_1"}, "5 joints from link_1 to tip; expected 6 or 7 joints that turn"),
    ({"home_rad": [0.0, 0.0, 3.0, 0.0, 0.0, 0.0]}, "home_rad: 3.000 of joint_3"),
    ({"home_rad": [0.0, 0.0, 0.0, 0.0]}, "home_rad: expected 6 values, one per joint, not 4"),
    ({"lower_rad": [-1.0]}, "lower_rad: expected 6 values, one per joint, not 1"),
    ({"seeds_rad": [[0.0]]}, "seeds_rad: expected 6 values, one per joint, not 1"),
    (swap('parent link="link_2"', 'parent link="x"'), "joint joint_3: no link 'x' in the file, its parent"),
    (swap('<child link="link_3"/>', ""), "joint joint_3: no link ''"),
    (swap('parent link="link_0"', 'parent link="link_6"'), "link link_6: its joints form a circle"),
    (swap("</robot>", '<link name="x"/></robot>'), "links link_0, x: 2 roots"),
    (swap('child link="gripper"', 'child link="link_3"'), "link link_3: has two joints above it, joint_3 and slide"),
    (swap('<link name="link_0"/>', '<link name="link_0"/>' * 2), "link 'link_0': 2 of this name"),
    (swap('joint name="joint_3"', "joint"), "joint ''"),
    (swap('"0 0 2"', '"0 0 0"'), "joint joint_1: its axis is zero"),
    (swap('"0 0 2"', '"0 1"'), "joint joint_1: xyz is '0 1', expected 3"),
    (swap("0.02 0 0.2", "nan 0 0.2"), "joint joint_1: xyz is not finite"),
    (swap("0.02 0 0.2", "20 0 200"), "joint joint_1: its origin is farther than 2 m"),
    (swap("0 0 0.05", "0 0 50"), "link link_1: its centre of mass is farther than 2 m"),
    (swap('rpy="0 0.4 0"', 'rpy="0 1.6 0"'), "z of tip does not point out of the arm: write `flange"),
]


@pytest.mark.parametrize(("changes", "named"), BROKEN, ids=lambda item: item if isinstance(item, str) else "")
def test_what_is_broken_is_named(tmp_path: Path, changes: dict[str, Any], named: str) -> None:
    (tmp_path / "example-robot-data").mkdir()
    arm, faults = read_arm(write(tmp_path, **changes))
    assert arm is None
    assert any(named in fault for fault in faults), faults


@pytest.mark.parametrize(
    ("changes", "faults"),
    [
        ({"limit": "<unlimited/>"}, ["lower", "upper", "velocity", "effort"]),
        ({"inertia": {"m": -1.0}}, ["mass is -1 kg"]),
        ({"inertia": {"m": 0.0}}, ["mass is 0 kg"]),
    ],
)
def test_a_fault_is_named_once(tmp_path: Path, changes: dict[str, Any], faults: list[str]) -> None:
    found = read_arm(write(tmp_path, **changes))[1]
    assert [[named for named in faults if named in fault] for fault in found] == [[named] for named in faults]


def test_a_mesh_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "link.stl").open("wb") as mesh:
        mesh.truncate(70 << 20)
    _, faults = read_arm(write(tmp_path, **shape('mesh filename="link.stl"')))
    assert faults == ["link link_3: mesh link.stl: 70 MB; allowed are 64 (PALPATE_BOUNDS=document_mb=...)"]


@pytest.mark.parametrize(
    ("scale", "named"),
    [
        ("", "its unit is not metres; give a scale in the URDF"),
        (' scale="0.001 0.001 0.001"', None),
        (' scale="2 2 2"', "change its scale, 2 2 2"),
    ],
)
def test_a_mesh_in_millimetres_is_named(tmp_path: Path, scale: str, named: str | None) -> None:
    import trimesh

    trimesh.creation.box((80.0, 80.0, 200.0)).export(tmp_path / "link.stl")
    _, faults = read_arm(write(tmp_path, **shape(f'mesh filename="link.stl"{scale}')))
    assert faults == [] if named is None else named in faults[0]


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"text": "<robot"}, "arm.urdf: not XML in UTF-8 or the encoding that it declares"),
        ({"text": "<sdf/>"}, "its root element is sdf"),
        ({"text": XACRO}, "has xacro elements"),
        ({"urdf": "other.urdf"}, r"arm\.yaml: urdf: .*other\.urdf: no such file"),
        ({"base_heigth_m": 1}, r"base_heigth_m = 1: unknown field\. Did you mean base_height_m\?"),
        ({"hold_damping_nms": [-40.0] * 6}, r"hold_damping_nms\.0 = -40"),
        ({"base_yaw_rad": -90}, r"base_yaw_rad = -90: expected greater than or equal to -6\.3 \(in radians\)"),
    ],
)
def test_a_file_that_cannot_be_read_is_named(tmp_path: Path, changes: dict[str, Any], named: str) -> None:
    with pytest.raises(UserError, match=named):
        read_arm(write(tmp_path, **changes))


@pytest.mark.parametrize("encoding", ["latin-1", "utf-16"])
def test_a_urdf_is_read_in_the_encoding_that_it_declares(tmp_path: Path, encoding: str) -> None:
    name = write(tmp_path)
    text = (tmp_path / "arm.urdf").read_text().replace('name="arm"', 'name="Ärm"')
    (tmp_path / "arm.urdf").write_bytes(f"<?xml version='1.0' encoding='{encoding}'?>{text}".encode(encoding))
    assert read_arm(name)[1] == []


def test_a_urdf_in_place_of_its_yaml_file_is_named(tmp_path: Path) -> None:
    write(tmp_path)
    with pytest.raises(UserError, match=r"arm\.urdf: is a URDF; expected the path of a YAML file .*`urdf: arm.urdf` and `flange"):
        read_arm(str(tmp_path / "arm.urdf"))


def test_an_arm_of_a_larger_robot_begins_at_its_base(tmp_path: Path) -> None:
    """A lift before its base and the mount of a second arm are left out."""
    lift = '<joint name="lift" type="prismatic"><parent link="trunk"/><child link="link_0"/></joint>'
    mount = '<joint name="other" type="fixed"><parent link="trunk"/><child link="mount"/></joint>'
    body = f'<link name="trunk">{INERTIAL.format(**GOOD)}</link><link name="mount"/>{lift}{mount}</robot>'
    for folder in ("alone", "part", "whole"):
        (tmp_path / folder).mkdir()
    alone, _ = read_arm(write(tmp_path / "alone"))
    part, faults = read_arm(write(tmp_path / "part", base="link_0", **swap("</robot>", body)))
    assert alone is not None
    assert part is not None, faults
    assert (part.link_names, part.inertias) == (alone.link_names, alone.inertias)
    np.testing.assert_array_equal(part.origin_m, alone.origin_m)
    assert "write `base: LINK`" in read_arm(write(tmp_path / "whole", **swap("</robot>", body)))[1][0]


def test_a_home_posture_is_found(tmp_path: Path) -> None:
    arm, faults = read_arm(write(tmp_path, home_rad=None))
    assert arm is not None, faults
    assert arm.posture(arm.home_rad)[1] == pytest.approx([0.0, 0.0, -1.0], abs=0.05)
    assert ((arm.lower_rad < arm.home_rad) & (arm.home_rad < arm.upper_rad)).all()


def test_a_link_without_a_shape_is_not_drawn(tmp_path: Path) -> None:
    """The camera could not merge its empty mesh."""
    meshes = visual_meshes(Robot(arm=write(tmp_path, collision="")))
    assert "link_3" not in meshes
    assert all(meshes.values())


def test_a_flange_that_stands_aside_is_right_if_the_file_says_so(tmp_path: Path) -> None:
    path = write(tmp_path, **swap('rpy="0 0.4 0"', 'rpy="0 1.6 0"'), flange_rpy_rad=[0.0, 0.0, 0.0])
    assert not any("z of tip" in fault for fault in read_arm(path)[1])


def test_inverse_kinematics_starts_from_several_postures(tmp_path: Path) -> None:
    """From home alone TIAGo's arm reached 5 of 18 targets in a place where it reaches all."""
    arm, faults = read_arm(write(tmp_path))
    assert arm is not None, faults
    assert seeds_of(arm)[0] == tuple(arm.home_rad)
    assert len(seeds_of(arm)) > 1
    built_in, _ = read_arm("ur5")
    assert built_in is not None
    assert seeds_of(built_in) == (tuple(built_in.home_rad),)


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
