"""The KUKA LBR iiwa 7 R800 with F/T sensor, stand-off and spherical indenter, as tables and as a URDF.

Kinematics, limits, masses and inertias: lbr_fri_ros2_stack, `iiwa7_description` and its joint limits. Capsules and tool
are ours. Links: lbr_link_0..lbr_link_7, lbr_link_ee (flange), ft_sensor (origin at the measuring face, z along the
flange's z), indenter (origin at the sphere's centre, z along the flange's z, out of the flange). Joint origins have no
rotation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from palpate_models.scenario.schema import Robot

Array = NDArray[np.float64]
Point = tuple[float, float, float]

JOINT_NAMES: Final[tuple[str, ...]] = tuple(f"lbr_A{i}" for i in range(1, 8))
LINK_NAMES: Final[tuple[str, ...]] = (*(f"lbr_link_{i}" for i in range(8)), "lbr_link_ee", "ft_sensor", "indenter")
"""Every link, from the base to the tool; each is the child of the one before it."""


def _fixed(values: Array) -> Array:
    values.setflags(write=False)
    return values


POSITION_LIMIT: Final = _fixed(np.deg2rad([170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 175.0]))
"""Joint positions lie within +- this [rad], shape (7,)."""
VELOCITY_LIMIT: Final = _fixed(np.deg2rad([98.0, 98.0, 100.0, 130.0, 140.0, 180.0, 180.0]))
"""Joint speed limits [rad/s], shape (7,)."""
TORQUE_LIMIT: Final = _fixed(np.array([176.0, 176.0, 110.0, 110.0, 110.0, 40.0, 40.0]))
"""Joint torque limits [N m], shape (7,)."""
HOME: Final = _fixed(np.deg2rad([0.0, -25.0, 0.0, -105.0, 0.0, 100.0, 0.0]))
"""Ready posture [rad], shape (7,): folded back over the base, tool straight down, the arm out of the camera's view."""

JOINT_ORIGIN: Final[tuple[Point, ...]] = (
    (0.0, 0.0, 0.1475),
    (0.0, -0.0105, 0.1925),
    (0.0, 0.0105, 0.2075),
    (0.0, 0.0105, 0.1925),
    (0.0, -0.0105, 0.2075),
    (0.0, -0.0707, 0.1925),
    (0.0, 0.0707, 0.091),
)
"""Origin of joint i + 1 in its parent link i [m]."""
JOINT_AXIS: Final[tuple[Point, ...]] = (
    (0.0, 0.0, 1.0),
    (0.0, 1.0, 0.0),
    (0.0, 0.0, 1.0),
    (0.0, -1.0, 0.0),
    (0.0, 0.0, 1.0),
    (0.0, 1.0, 0.0),
    (0.0, 0.0, 1.0),
)
LINK_7_TO_FLANGE_M: Final = 0.035
FLANGE_TO_FT_M: Final = 0.030
"""Thickness of the F/T sensor: flange to measuring face [A: like an ATI Gamma, 75 mm x 33 mm, 0.255 kg]."""
FT_TO_INDENTER_M: Final = 0.100
"""Measuring face to the sphere's centre: the stand-off [A]."""
FT_SENSOR_MASS_KG: Final = 0.25
"""The sensor's own mass, on the flange's side of its measuring face [A]."""
FT_SENSOR_RADIUS_M: Final = 0.0375
STANDOFF_RADIUS_M: Final = 0.0125
STANDOFF_MASS_FRACTION: Final = 0.6
"""Part of the tool's mass that is in the stand-off; the rest is in the sphere [A]."""


@dataclass(frozen=True, slots=True)
class Inertia:
    """Mass [kg], centre of mass [m] in the link frame, inertia about it [kg m^2], axes of the link frame."""

    mass: float
    com: Point
    diagonal: Point
    """ixx, iyy, izz."""
    products: Point = (0.0, 0.0, 0.0)
    """ixy, ixz, iyz."""


@dataclass(frozen=True, slots=True)
class Capsule:
    """A cylinder from `start` to `end` [m, link frame] with round ends of its radius [m]; a sphere if they coincide."""

    start: Point
    end: Point
    radius: float


ARM_INERTIA: Final[tuple[Inertia, ...]] = (
    Inertia(4.855658, (-0.012857, 0.0, 0.069964), (0.017839, 0.022294, 0.021334), (0.0, 0.000781, 0.0)),
    Inertia(3.394011, (0.0, -0.034819, 0.123299), (0.021383, 0.020403, 0.007563), (0.0, 0.0, 0.003797)),
    Inertia(4.031991, (0.0, 0.039793, 0.086944), (0.031697, 0.030080, 0.009666), (0.0, 0.0, 0.005889)),
    Inertia(3.394011, (0.0, 0.034819, 0.123299), (0.021383, 0.020403, 0.007563), (0.0, 0.0, -0.003797)),
    Inertia(4.031989, (0.0, -0.039793, 0.086944), (0.031695, 0.030079, 0.009665), (0.0, 0.0, -0.005889)),
    Inertia(1.529239, (0.0, -0.029824, 0.076267), (0.008485, 0.007136, 0.003848), (0.0, 0.0, 0.002806)),
    Inertia(2.403626, (0.0, 0.07102, 0.00495), (0.007067, 0.006804, 0.004629), (0.0, 0.0, 0.000311)),
    Inertia(0.259474, (3e-6, -2e-6, 0.013782), (0.000171, 0.000171, 0.000299)),
)
"""Links 0 to 7."""

_ARM_CAPSULES: Final[tuple[tuple[Capsule, ...], ...]] = (
    (Capsule((-0.02, 0.0, 0.085), (0.0, 0.0, 0.10), 0.09),),
    (Capsule((0.0, 0.0, 0.035), (0.0, -0.035, 0.19), 0.077),),
    (Capsule((0.0, 0.035, 0.0), (0.0, 0.0105, 0.1675), 0.075),),
    (Capsule((0.0, 0.0, 0.035), (0.0, 0.035, 0.19), 0.077),),
    (Capsule((0.0, -0.035, 0.0), (0.0, -0.0105, 0.1675), 0.075),),
    (Capsule((0.0, 0.0, 0.03), (0.0, -0.012, 0.085), 0.071), Capsule((0.0, -0.055, 0.12), (0.0, -0.082, 0.1925), 0.06)),
    (
        Capsule((0.0, 0.048, 0.0), (0.0, 0.092, 0.0), 0.068),
        Capsule((0.0, 0.0707, 0.0), (0.0, 0.0707, 0.04), 0.055),
    ),
    (Capsule((0.0, 0.0, 0.0), (0.0, 0.0, 0.005), 0.045),),
)


def _cylinder(mass: float, radius: float, length: float, z: float) -> Inertia:
    """Return a solid cylinder along z with its centre at height z of the link frame."""
    across = mass * (3 * radius**2 + length**2) / 12
    return Inertia(mass, (0.0, 0.0, z), (across, across, mass * radius**2 / 2))


def _sphere(mass: float, radius: float) -> Inertia:
    """Return a solid sphere about the link frame's origin."""
    inertia = 0.4 * mass * radius**2
    return Inertia(mass, (0.0, 0.0, 0.0), (inertia, inertia, inertia))


def inertias(robot: Robot) -> dict[str, Inertia]:
    """Inertia by link: the stand-off is in `ft_sensor`, the sphere in `indenter`, the sensor in `lbr_link_ee`."""
    standoff = STANDOFF_MASS_FRACTION * robot.tool_mass_kg
    tool = (
        _cylinder(FT_SENSOR_MASS_KG, FT_SENSOR_RADIUS_M, FLANGE_TO_FT_M, FLANGE_TO_FT_M / 2),
        _cylinder(standoff, STANDOFF_RADIUS_M, FT_TO_INDENTER_M, FT_TO_INDENTER_M / 2),
        _sphere(robot.tool_mass_kg - standoff, robot.indenter_radius_m),
    )
    return dict(zip(LINK_NAMES, (*ARM_INERTIA, *tool), strict=True))


def capsules(robot: Robot) -> dict[str, tuple[Capsule, ...]]:
    """Collision geometry by link, in link frames. It encloses the visual meshes to within a few millimetres."""
    tip = (0.0, 0.0, 0.0)
    tool = (
        (Capsule(tip, (0.0, 0.0, FLANGE_TO_FT_M / 2), FT_SENSOR_RADIUS_M),),
        (Capsule((0.0, 0.0, 0.01), (0.0, 0.0, FT_TO_INDENTER_M), STANDOFF_RADIUS_M),),
        (Capsule(tip, tip, robot.indenter_radius_m),),
    )
    return dict(zip(LINK_NAMES, (*_ARM_CAPSULES, *tool), strict=True))


def _text(values: Point) -> str:
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


def _joint(name: str, kind: str, parent: str, child: str, xyz: Point, rpy: Point = (0, 0, 0), extra: str = "") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{_text(xyz)}" rpy="{_text(rpy)}"/>{extra}</joint>'
    )


def _arm_joint(i: int, robot: Robot) -> str:
    limit, velocity, torque = (float(x[i]) for x in (POSITION_LIMIT, VELOCITY_LIMIT, TORQUE_LIMIT))
    extra = (
        f'<axis xyz="{_text(JOINT_AXIS[i])}"/>'
        f'<limit lower="{-limit!r}" upper="{limit!r}" velocity="{velocity!r}" effort="{torque!r}"/>'
        f'<dynamics damping="{robot.joint_damping_nms!r}" friction="{robot.joint_friction_nm!r}"/>'
    )
    return _joint(JOINT_NAMES[i], "revolute", LINK_NAMES[i], LINK_NAMES[i + 1], JOINT_ORIGIN[i], extra=extra)


def urdf(robot: Robot, *, geometry: bool = True) -> str:
    """Return the robot as URDF text: link `world` (W), the base fixed to it, the arm, the tool. It refers to no file.

    `geometry=False` leaves out visual and collision shapes.
    """
    inertia, shapes = inertias(robot), capsules(robot)
    parts = ['<robot name="lbr">', '<link name="world"/>']
    for link in LINK_NAMES:
        seen = shapes[link] if geometry else ()
        primitives = "".join(_geometry(tag, capsule) for tag in ("visual", "collision") for capsule in seen)
        parts.append(f'<link name="{link}">{_inertial(inertia[link])}{primitives}</link>')
    base = (*robot.base_xy_m, robot.base_height_m)
    parts.append(_joint("lbr_base", "fixed", "world", LINK_NAMES[0], base, (0.0, 0.0, robot.base_yaw_rad)))
    parts += [_arm_joint(i, robot) for i in range(7)]
    parts.append(_joint("lbr_flange", "fixed", "lbr_link_7", "lbr_link_ee", (0.0, 0.0, LINK_7_TO_FLANGE_M)))
    parts.append(_joint("ft_sensor_mount", "fixed", "lbr_link_ee", "ft_sensor", (0.0, 0.0, FLANGE_TO_FT_M)))
    parts.append(_joint("standoff", "fixed", "ft_sensor", "indenter", (0.0, 0.0, FT_TO_INDENTER_M)))
    parts.append("</robot>\n")
    return "\n".join(parts)
