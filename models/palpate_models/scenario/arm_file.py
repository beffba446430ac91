"""The YAML file of an arm: what its URDF lacks, and the defaults of section `robot`."""

from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import Field

from palpate_errors import UserError
from palpate_models.section import NonNegative, Positive, Section, Turn, Vec2, Vec3, read_model

FOLDER: Final = Path(__file__).with_name("arms")
"""YAML files of the arms that are known by name; their URDFs are in the package `example-robot-data`."""

DEFAULT_ARM: Final = "lbr"
"""The arm whose tables are built in."""
Joints = tuple[float, ...]
"""One value a joint, from the base to the flange."""
PositiveJoints = tuple[Positive, ...]


class CommandLevel(StrEnum):
    """Kind of the commands that an arm takes."""

    TORQUE = "torque"
    """Joint torques without gravity."""
    POSITION = "position"
    """Joint positions."""
    SETPOINT = "setpoint"
    """The Cartesian set-point of planning; the control law runs in the driver."""


class ArmFile(Section):
    """Values that a URDF lacks. Lists have one value a joint, from the base to the flange."""

    urdf: str
    """Path of the URDF, relative to this file, or `package://PACKAGE/PATH`."""
    flange: str
    """Link whose origin is the flange: z out of the arm. Links behind it (a gripper) are left out."""
    base: str | None = None
    """Link where the arm begins, if it is part of a larger robot; links before it are left out."""
    flange_rpy_rad: Vec3 = (0.0, 0.0, 0.0)
    """Turn from the axes of that link to those of the flange, if its z is not out of the arm."""
    home_rad: Joints | None = None
    """Ready posture: folded back over the base, z of the flange straight down, out of the camera's view. Sought if missing."""
    level: CommandLevel = CommandLevel.POSITION
    """Kind of the commands that the arm takes."""
    base_xy_m: Vec2 = (0.0, 0.0)
    """Position of the base in world; `palpate arm place` finds it."""
    base_height_m: Annotated[float, Field(ge=0.0, le=2.0)] = 0.9
    base_yaw_rad: Turn = 0.0
    joint_friction_nm: NonNegative = 0.1
    """Coulomb friction."""
    joint_damping_nms: NonNegative = 1.0
    """Viscous friction."""
    lower_rad: Joints | None = None
    """Replaces the URDF's limit, and so do the next three."""
    upper_rad: Joints | None = None
    velocity_radps: Joints | None = None
    torque_nm: Joints | None = None
    acceleration_radps2: PositiveJoints | None = None
    stiffness_nmprad: PositiveJoints | None = None
    """Joint stiffness in free motion."""
    hold_damping_nms: PositiveJoints | None = None
    """Joint damping in a hold."""
    seeds_rad: tuple[Joints, ...] = ()
    """Postures from which inverse kinematics starts; home and others that are sought if missing."""


PLACEMENT: Final = ("level", "base_xy_m", "base_height_m", "base_yaw_rad", "joint_friction_nm", "joint_damping_nms")
"""Fields that are defaults of the scenario's section `robot`."""


def arm_path(name: str) -> Path:
    """Return the YAML file of an arm: a path, or a name of `FOLDER`. Raises UserError."""
    path = Path(name) if name.endswith((".yaml", ".yml")) else FOLDER / f"{name}.yaml"
    if Path(name).suffix == ".urdf" and Path(name).is_file():
        raise UserError(
            f"robot.arm: {name}: is a URDF; expected the path of a YAML file next to it with at least "
            f"`urdf: {Path(name).name}` and `flange: LINK`, the link at the mounting face"
        )
    if not path.is_file():
        known = ", ".join((DEFAULT_ARM, *sorted(file.stem for file in FOLDER.glob("*.yaml"))))
        raise UserError(f"robot.arm: {name}: no such file; expected {known}, or the path of a YAML file")
    return path


@cache
def arm_file(name: str) -> ArmFile:
    """Return the YAML file of an arm. Raises UserError that names file, field and what is allowed."""
    return read_model(arm_path(name), ArmFile)


def placement_of(name: str) -> dict[str, Any]:
    """Return the defaults of section `robot` for an arm. Raises UserError."""
    return arm_file(name).model_dump(include=set(PLACEMENT))
