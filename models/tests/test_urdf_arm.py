"""Arms from a URDF: the tables agree with pinocchio, and what is broken is named with its link or joint."""

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import yaml

from palpate_errors import UserError
from palpate_models.robot.arm import arm_of, tool_jacobian, tool_pose, urdf
from palpate_models.robot.fitting import enclosing_capsule, seeds_of
from palpate_models.robot.urdf_arm import read_arm
from palpate_models.robot.visual import visual_meshes
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


BROKEN = {
    "mass of zero": ({"inertia": {"m": 0.0}}, "link link_3: mass is 0 kg"),
    "no mass": ({"inertial": ""}, "link link_3: no mass"),
    "negative inertia": ({"inertia": {"z": -0.01}}, "link link_3: inertia is not positive"),
    "triangle": ({"inertia": {"x": 0.2}}, "link link_3: inertia against the triangle inequality"),
    "not a number": ({"inertia": {"x": float("nan")}}, "link link_3: ixx is not finite"),
    "no mesh": ({"collision": '<geometry><mesh filename="no.stl"/></geometry>'}, "link link_3: mesh no.stl is not there"),
    "no mesh in a package that is there": (
        {"collision": '<geometry><mesh filename="package://example-robot-data/no.stl"/></geometry>'},
        "link link_3: mesh package://example-robot-data/no.stl is not there",
    ),
    "no limits": ({"limit": "<unlimited/>"}, "joint joint_3: no limit"),
    "empty range": ({"limit": '<limit lower="1" upper="1" velocity="2" effort="80"/>'}, "joint joint_3: its range"),
    "range within the margins": (
        {"limit": '<limit lower="-0.05" upper="0.05" velocity="2" effort="80"/>'},
        "joint joint_3: its range is -0.05 to 0.05 rad, expected more than 0.1 rad",
    ),
    "no speed": ({"limit": '<limit lower="-1" upper="1" velocity="0" effort="80"/>'}, "joint joint_3: velocity_radps is 0"),
    "no torque": ({"limit": '<limit lower="-1" upper="1" velocity="2" effort="0"/>'}, "joint joint_3: torque_nm is 0"),
    "slides": ({"kind": "prismatic"}, "joint joint_3: is prismatic"),
    "one joint less": ({"kind": "fixed"}, "5 joints"),
    "no flange": ({"flange": "tool"}, "no link 'tool'"),
    "home outside": ({"home_rad": [0.0, 0.0, 3.0, 0.0, 0.0, 0.0]}, "home_rad: 3.000 of joint_3"),
    "unknown parent": (
        {"swap": ('parent link="link_2"', 'parent link="x"')},
        "joint joint_3: no link 'x' in the file, its parent",
    ),
    "no child": ({"swap": ('<child link="link_3"/>', "")}, "joint joint_3: no link ''"),
    "loop": ({"swap": ('parent link="link_0"', 'parent link="link_6"')}, "link link_6: its joints form a circle"),
    "two roots": ({"swap": ("</robot>", '<link name="x"/></robot>')}, "links link_0, x: 2 roots"),
    "two joints above": (
        {"swap": ('child link="gripper"', 'child link="link_3"')},
        "link link_3: has two joints above it, joint_3 and slide",
    ),
    "name twice": ({"swap": ('<link name="link_0"/>', '<link name="link_0"/>' * 2)}, "link 'link_0': 2 of this name"),
    "joint without name": ({"swap": ('joint name="joint_3"', "joint")}, "joint ''"),
    "mimic": ({"limit": '<mimic joint="joint_2"/>'}, "joint joint_3: mimics"),
    "axis": ({"swap": ('"0 0 2"', '"0 0 0"')}, "joint joint_1: its axis is zero"),
    "axis without z": ({"swap": ('"0 0 2"', '"0 1"')}, "joint joint_1: xyz is '0 1', expected 3"),
    "origin": ({"swap": ("0.02 0 0.2", "nan 0 0.2")}, "joint joint_1: xyz is not finite"),
    "millimetres": ({"swap": ("0.02 0 0.2", "20 0 200")}, "joint joint_1: its origin is farther than 2 m"),
    "centre of mass": ({"swap": ("0 0 0.05", "0 0 50")}, "link link_1: its centre of mass is farther than 2 m"),
    "xacro left": ({"inertia": {"m": "${m}"}}, "link link_3: value is '${m}'"),
    "unit of inertia": ({"inertia": {"x": 2e4, "y": 2e4}}, "link link_3: inertia of 2e+04 kg m^2"),
    "endless range": (
        {"limit": '<limit lower="-inf" upper="inf" velocity="2" effort="80"/>'},
        "joint joint_3: lower is not finite",
    ),
    "no size": ({"collision": '<geometry><box size="0.1 0 0.1"/></geometry>'}, "link link_3: size of its box"),
    "shape": ({"collision": '<geometry><capsule radius="0.1"/></geometry>'}, "link link_3: shape capsule"),
    "not a mesh": (
        {"collision": '<geometry><mesh filename="arm.urdf"/></geometry>'},
        "link link_3: mesh arm.urdf cannot be read",
    ),
    "no base": ({"base": "gripper"}, "base: no link 'gripper' before tip; it has link_0, link_1"),
    "base too far": ({"base": "link_1"}, "5 joints from link_1 to tip; expected 6 or 7 joints that turn"),
    "short home": ({"home_rad": [0.0, 0.0, 0.0, 0.0]}, "home_rad: expected 6 values, one per joint, not 4"),
    "one limit": ({"lower_rad": [-1.0]}, "lower_rad: expected 6 values, one per joint, not 1"),
    "short seed": ({"seeds_rad": [[0.0]]}, "seeds_rad: expected 6 values, one per joint, not 1"),
    "degrees": (
        {"limit": '<limit lower="-123" upper="60" velocity="2" effort="80"/>'},
        "range is -123 to 60 rad: its unit is not",
    ),
    "no inertial but of a screw": ({"inertia": {"m": 1e-4, "x": 1e-6, "y": 1e-6, "z": 1e-6}}, "link link_3: no mass: 0.0001 kg"),
    "slides behind a base": (
        {"kind": "prismatic", "base": "link_0"},
        "is prismatic, between link_0 and tip; expected 6 or 7 joints",
    ),
    "flange that points aside": (
        {"swap": ('rpy="0 0.4 0"', 'rpy="0 1.6 0"')},
        "z of tip does not point out of the arm: write `flange",
    ),
}


@pytest.mark.parametrize(("changes", "named"), BROKEN.values(), ids=BROKEN)
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
    assert len(found) == len(faults), found
    assert all(named in fault for named, fault in zip(faults, found, strict=True)), found


def test_a_mesh_in_millimetres_is_named(tmp_path: Path) -> None:
    import trimesh

    trimesh.creation.box((80.0, 80.0, 200.0)).export(tmp_path / "link.stl")
    mesh = '<geometry><mesh filename="link.stl"{}/></geometry>'
    _, faults = read_arm(write(tmp_path, collision=mesh.format("")))
    assert "its unit is not metres; give a scale in the URDF" in faults[0]
    for folder in ("scaled", "twice"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "link.stl").write_bytes((tmp_path / "link.stl").read_bytes())
    assert read_arm(write(tmp_path / "scaled", collision=mesh.format(' scale="0.001 0.001 0.001"')))[1] == []
    twice = read_arm(write(tmp_path / "twice", collision=mesh.format(' scale="2 2 2"')))
    assert "change its scale, 2 2 2, in the URDF" in twice[1][0]


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"text": "<robot"}, "not a URDF"),
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


def test_a_urdf_in_place_of_its_yaml_file_is_named(tmp_path: Path) -> None:
    write(tmp_path)
    with pytest.raises(UserError, match=r"arm\.urdf: is a URDF; expected the path of a YAML file .*`urdf: arm.urdf` and `flange"):
        read_arm(str(tmp_path / "arm.urdf"))


def test_an_arm_of_a_larger_robot_begins_at_its_base(tmp_path: Path) -> None:
    """A lift before its base and the mount of a second arm are left out."""
    lift = '<joint name="lift" type="prismatic"><parent link="trunk"/><child link="link_0"/></joint>'
    mount = '<joint name="other" type="fixed"><parent link="trunk"/><child link="mount"/></joint>'
    body = f'<link name="trunk">{INERTIAL.format(**GOOD)}</link><link name="mount"/>{lift}{mount}'
    swap = {"swap": ("</robot>", f"{body}</robot>")}
    for folder in ("alone", "part", "whole"):
        (tmp_path / folder).mkdir()
    alone, _ = read_arm(write(tmp_path / "alone"))
    part, faults = read_arm(write(tmp_path / "part", base="link_0", **swap))
    assert alone is not None
    assert part is not None, faults
    assert (part.link_names, part.inertias) == (alone.link_names, alone.inertias)
    np.testing.assert_array_equal(part.origin_m, alone.origin_m)
    assert "write `base: LINK`" in read_arm(write(tmp_path / "whole", **swap))[1][0]


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
    aside = ('rpy="0 0.4 0"', 'rpy="0 1.6 0"')
    assert not any("z of tip" in fault for fault in read_arm(write(tmp_path, swap=aside, flange_rpy_rad=[0.0, 0.0, 0.0]))[1])


def test_inverse_kinematics_starts_from_several_postures(tmp_path: Path) -> None:
    """From home alone TIAGo's arm reached 5 of 18 targets in a place where it reaches all."""
    arm, faults = read_arm(write(tmp_path))
    assert arm is not None, faults
    assert seeds_of(arm)[0] == tuple(arm.home_rad)
    assert len(seeds_of(arm)) > 1
    assert seeds_of(read_arm("ur5")[0]) == (tuple(read_arm("ur5")[0].home_rad),)  # type: ignore[arg-type, union-attr]


def test_a_capsule_encloses_its_points() -> None:
    rng = np.random.default_rng(1)
    for scale in rng.uniform(0.02, 0.5, (20, 3)):
        points = rng.standard_normal((200, 3)) * scale + rng.uniform(-1, 1, 3)
        capsule = enclosing_capsule(points)
        start, end = np.array(capsule.start), np.array(capsule.end)
        axis = end - start
        share = np.clip((points - start) @ axis / max(axis @ axis, 1e-12), 0, 1)
        assert np.linalg.norm(points - start - share[:, None] * axis, axis=1).max() <= capsule.radius * (1 + 1e-9)
