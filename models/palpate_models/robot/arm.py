"""The arm of a scenario on its base with its tool, as tables and as a URDF, with its forward kinematics (not for hot
paths); the operating table and the robot's cubic base, as boxes in world.

Behind the arm's flange follow `ft_sensor` (origin at the measuring face) and `indenter` (origin at the sphere's centre), z out of
the flange.
"""

import warnings
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from palpate_models.numerics.frames import Array, matrix, rigid
from palpate_models.robot.chain import Arm, Capsule, Inertia, Point
from palpate_models.robot.lbr import ARM
from palpate_models.robot.urdf_arm import load_arm, read_arm
from palpate_models.scenario.schema import Robot
from palpate_models.section import Pose, Vec3


class ToolGeometry(NamedTuple):
    """F/T sensor and standoff between flange and indenter."""

    flange_to_ft_m: float = 0.030
    """Thickness of the F/T sensor: flange to measuring face [A: like an ATI Gamma, 75 mm x 33 mm, 0.255 kg]."""
    ft_to_indenter_m: float = 0.100
    """Measuring face to the sphere's centre: the stand-off (assumed)."""
    ft_sensor_mass_kg: float = 0.25
    """The sensor's own mass, on the flange's side of its measuring face (assumed)."""
    ft_sensor_radius_m: float = 0.0375
    standoff_radius_m: float = 0.0125
    standoff_mass_fraction: float = 0.6
    """Part of the tool's mass that is in the stand-off; the rest is in the sphere (assumed)."""
    mount_clearance_m: float = 0.02
    """A link that comes nearer to the base in every posture is not checked against it."""


TOOL: Final = ToolGeometry()


def arm_of(robot: Robot) -> Arm:
    """Return the arm of a robot. Raises UserError that names file, link or joint, and what is wrong."""
    return ARM if robot.arm == ARM.name else load_arm(robot.arm)


def check_arm(name: str) -> tuple[Arm | None, list[str]]:
    """Return an arm, None if it is unusable, and what is wrong with it. Raises UserError if a file cannot be read."""
    return (ARM, []) if name == ARM.name else read_arm(name)


def base_pose(robot: Robot) -> Array:
    """Return X_WL0 of the base link in world, shape (4, 4)."""
    turn, R_BL = Rotation.from_euler("z", robot.base_yaw_rad).as_matrix(), arm_of(robot).R_BL
    return rigid(turn if R_BL is None else turn @ R_BL, (*robot.base_xy_m, robot.base_height_m))


def link_names(robot: Robot) -> tuple[str, ...]:
    """Return every link, from the base to the tool; each is the child of the one before it."""
    return (*arm_of(robot).link_names, "ft_sensor", "indenter")


def mounts(robot: Robot) -> Array:
    """Return the origins of flange, F/T sensor and indenter in the arm's last link [m], shape (3, 3)."""
    x, y, z = arm_of(robot).flange_m
    return np.column_stack((np.full(3, x), np.full(3, y), np.cumsum((z, TOOL.flange_to_ft_m, TOOL.ft_to_indenter_m))))


def count_mounted(robot: Robot) -> int:
    """Return how many links, counted from the base, are always at it: two, and a third that is thicker than its joint is high.

    The first joint turns about the vertical, so the second keeps its height.
    """
    arm = arm_of(robot)
    height = float(arm.posture(np.zeros(arm.joints))[0][1, 2])
    thickness = max((capsule.radius for capsule in arm.capsules[2]), default=0.0)
    return 2 if height - thickness > TOOL.mount_clearance_m else 3


def _cylinder(mass: float, radius: float, length: float, z: float) -> Inertia:
    """Return a solid cylinder along z with its centre at height z of the link frame."""
    across = mass * (3 * radius**2 + length**2) / 12
    return Inertia(mass, (0.0, 0.0, z), (across, across, mass * radius**2 / 2))


def _sphere(mass: float, radius: float) -> Inertia:
    """Return a solid sphere about the link frame's origin."""
    inertia = 0.4 * mass * radius**2
    return Inertia(mass, (0.0, 0.0, 0.0), (inertia, inertia, inertia))


def inertias(robot: Robot) -> dict[str, Inertia]:
    """Return the inertia by link: the stand-off is in `ft_sensor`, the sphere in `indenter`, the sensor in the flange."""
    standoff = TOOL.standoff_mass_fraction * robot.tool_mass_kg
    tool = (
        _cylinder(TOOL.ft_sensor_mass_kg, TOOL.ft_sensor_radius_m, TOOL.flange_to_ft_m, TOOL.flange_to_ft_m / 2),
        _cylinder(standoff, TOOL.standoff_radius_m, TOOL.ft_to_indenter_m, TOOL.ft_to_indenter_m / 2),
        _sphere(robot.tool_mass_kg - standoff, robot.indenter_radius_m),
    )
    return dict(zip(link_names(robot), (*arm_of(robot).inertias, *tool), strict=True))


def capsules(robot: Robot) -> dict[str, tuple[Capsule, ...]]:
    """Return the collision geometry by link, in link frames. It encloses the visual meshes to within a few millimetres."""
    tip = (0.0, 0.0, 0.0)
    tool = (
        (Capsule(tip, (0.0, 0.0, TOOL.flange_to_ft_m / 2), TOOL.ft_sensor_radius_m),),
        (Capsule((0.0, 0.0, 0.01), (0.0, 0.0, TOOL.ft_to_indenter_m), TOOL.standoff_radius_m),),
        (Capsule(tip, tip, robot.indenter_radius_m),),
    )
    return dict(zip(link_names(robot), (*arm_of(robot).capsules, *tool), strict=True))


def _text(values: Point | Array) -> str:
    return " ".join(repr(float(value)) for value in values)


def _inertial(inertia: Inertia) -> str:
    names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    entries = " ".join(f'{n}="{v!r}"' for n, v in zip(names, (*inertia.diagonal, *inertia.products), strict=True))
    com = f'<origin xyz="{_text(inertia.com)}"/>'
    return f'<inertial>{com}<mass value="{inertia.mass!r}"/><inertia {entries}/></inertial>'


def _geometry(tag: str, capsule: Capsule) -> str:
    """Return a capsule as URDF primitives: a cylinder and a sphere at each end."""
    start, end = np.array(capsule.start), np.array(capsule.end)
    axis = end - start
    length = float(np.linalg.norm(axis))
    ends = (start,) if length == 0 else (start, end)
    parts = [
        f'<{tag}><origin xyz="{_text(tuple(point))}"/><geometry><sphere radius="{capsule.radius}"/></geometry></{tag}>'
        for point in ends
    ]
    if length > 0:
        x, y, z = axis / length
        rpy = (0.0, float(np.arctan2(np.hypot(x, y), z)), float(np.arctan2(y, x)))  # turns z onto the axis
        parts.append(
            f'<{tag}><origin xyz="{_text(tuple((start + end) / 2))}" rpy="{_text(rpy)}"/>'
            f'<geometry><cylinder radius="{capsule.radius}" length="{length!r}"/></geometry></{tag}>'
        )
    return "".join(parts)


def _joint(
    name: str, kind: str, parent: str, child: str, xyz: Point | Array, rpy: Point | Array = (0, 0, 0), extra: str = ""
) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{_text(xyz)}" rpy="{_text(rpy)}"/>{extra}</joint>'
    )


def _revolute(arm: Arm, i: int, robot: Robot) -> str:
    lower, upper, velocity, torque = (float(x[i]) for x in (arm.lower_rad, arm.upper_rad, arm.velocity_radps, arm.torque_nm))
    extra = (
        f'<axis xyz="{_text(arm.axis[i])}"/>'
        f'<limit lower="{lower!r}" upper="{upper!r}" velocity="{velocity!r}" effort="{torque!r}"/>'
        f'<dynamics damping="{robot.joint_damping_nms!r}" friction="{robot.joint_friction_nm!r}"/>'
    )
    return _joint(arm.joint_names[i], "revolute", arm.link_names[i], arm.link_names[i + 1], arm.origin_m[i], extra=extra)


def urdf(robot: Robot, *, geometry: bool = True) -> str:
    """Return the robot as URDF text: link `world` (W), the base fixed to it, the arm, the tool. It refers to no file.

    `geometry=False` leaves out visual and collision shapes.
    """
    arm, links, X_WB = arm_of(robot), link_names(robot), base_pose(robot)
    inertia, shapes = inertias(robot), capsules(robot)
    parts = [f'<robot name="{arm.name}">', '<link name="world"/>']
    for link in links:
        seen = shapes[link] if geometry else ()
        primitives = "".join(_geometry(tag, capsule) for tag in ("visual", "collision") for capsule in seen)
        parts.append(f'<link name="{link}">{_inertial(inertia[link])}{primitives}</link>')
    with warnings.catch_warnings(action="ignore"):  # an arm whose z points along the table is at a gimbal lock
        rpy = Rotation.from_matrix(X_WB[:3, :3]).as_euler("xyz")
    parts.append(_joint(f"{arm.name}_base", "fixed", "world", links[0], X_WB[:3, 3], rpy))
    parts += [_revolute(arm, i, robot) for i in range(arm.joints)]
    flange = arm.link_names[-1]
    parts.append(_joint(f"{arm.name}_flange", "fixed", arm.link_names[-2], flange, arm.flange_m))
    parts.append(_joint("ft_sensor_mount", "fixed", flange, "ft_sensor", (0.0, 0.0, TOOL.flange_to_ft_m)))
    parts.append(_joint("standoff", "fixed", "ft_sensor", "indenter", (0.0, 0.0, TOOL.ft_to_indenter_m)))
    parts.append("</robot>\n")
    return "\n".join(parts)


def link_transforms(q: Array, robot: Robot) -> list[tuple[str, str, Array]]:
    """Return (parent, child, X_PC) of every URDF link, from `world` to `indenter`, at joint positions `q` [rad], shape (n,)."""
    arm = arm_of(robot)
    turns = Rotation.from_rotvec(np.asarray(q)[:, None] * arm.axis).as_matrix()
    steps = (arm.flange_m, (0.0, 0.0, TOOL.flange_to_ft_m), (0.0, 0.0, TOOL.ft_to_indenter_m))
    found = [base_pose(robot), *map(rigid, turns, arm.origin_m), *(rigid(np.eye(3), step) for step in steps)]
    links = link_names(robot)
    return list(zip(("world", *links[:-1]), links, found, strict=True))


def tool_pose(q: Array, robot: Robot) -> Array:
    """Return X_WI of the indenter, shape (4, 4)."""
    X_WI = np.eye(4)
    for _, _, X in link_transforms(q, robot):
        X_WI = X_WI @ X
    return X_WI


def tool_jacobian(q: Array, robot: Robot) -> Array:
    """Return the Jacobian of the indenter's V_WI_W (linear above angular) by the joint speeds, shape (6, n)."""
    p_WI = tool_pose(q, robot)[:3, 3]
    columns = []
    X = np.eye(4)
    joints = link_transforms(q, robot)
    X = X @ joints[0][2]
    for (_, _, X_PC), axis in zip(joints[1:-3], arm_of(robot).axis, strict=True):
        X = X @ X_PC
        axis_W = X[:3, :3] @ axis
        columns.append(np.concatenate((np.cross(axis_W, p_WI - X[:3, 3]), axis_W)))
    return np.array(columns).T


class OperatingTable(NamedTuple):
    """Measures of the operating table."""

    top_m: float = 0.73
    """Height of the table's top face (assumed)."""
    x_m: tuple[float, float] = (0.285, 0.835)
    y_m: tuple[float, float] = (-1.0, 1.0)
    thickness_m: float = 0.10
    column_m: tuple[float, float] = (0.30, 0.60)
    """Footprint of the table's column, x and y (assumed)."""


TABLE: Final = OperatingTable()
BASE_SIDE_M: Final = 0.40


class Box(NamedTuple):
    """A box B, aligned with its own frame at its centre."""

    name: str
    X_WB: Array
    """Homogeneous pose of the centre in world, shape (4, 4)."""
    size: Vec3
    """Full edge lengths along B's axes [m]."""


def _aligned_box(name: str, low: Vec3, high: Vec3) -> Box:
    X_WB = rigid(np.eye(3), (np.array(low) + np.array(high)) / 2)
    return Box(name, X_WB, (high[0] - low[0], high[1] - low[1], high[2] - low[2]))


def boxes(robot: Robot) -> tuple[Box, ...]:
    """Table top, table column and robot base, in world. The base reaches from the floor to `robot.base_height_m`."""
    under = TABLE.top_m - TABLE.thickness_m
    x, y = sum(TABLE.x_m) / 2, sum(TABLE.y_m) / 2
    height = robot.base_height_m
    base = Pose(xyz_m=(*robot.base_xy_m, height / 2), rpy_rad=(0.0, 0.0, robot.base_yaw_rad))
    return (
        _aligned_box("table_top", (TABLE.x_m[0], TABLE.y_m[0], under), (TABLE.x_m[1], TABLE.y_m[1], TABLE.top_m)),
        _aligned_box(
            "table_column",
            (x - TABLE.column_m[0] / 2, y - TABLE.column_m[1] / 2, 0.0),
            (x + TABLE.column_m[0] / 2, y + TABLE.column_m[1] / 2, under),
        ),
        Box("robot_base", matrix(base), (BASE_SIDE_M, BASE_SIDE_M, height)),
    )
