"""A scenario: all inputs of a run as one frozen, validated model. YAML overrides its defaults; those of section `robot` come from
the YAML file of the arm, which also has what its URDF lacks.

Field names carry their unit. Angles are in radians, lengths in metres, unless the name says otherwise.
World frame W: origin on the floor under the robot, z up, x towards the table. Abdomen frame A: origin at the umbilicus,
x to the patient's left, y to the head, z outward.
"""

import re
from collections.abc import Mapping
from enum import StrEnum
from functools import cache
from math import dist
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, ConfigDict, Field, ValidationInfo, field_validator, model_validator

from palpate_errors import UserError
from palpate_models.patient.person import draw_person
from palpate_models.patient.schema import Phantom
from palpate_models.scenario.errors import Errors
from palpate_models.section import Force, Length, NonNegative, Pose, Positive, Section, Turn, Vec2, Vec3, read_model
from palpate_plugins import PluginKind, is_file

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


SEARCH: Final = "search"
BUILTIN_PATTERNS: Final = ("lines", "raster", "snake", SEARCH)
PATTERN: Final = PluginKind(
    "pattern", "exam.pattern", "scan", "exam, surface", BUILTIN_PATTERNS, "palpate_models.scenario.patterns"
)


def _known_pattern(choice: str) -> str:
    """Validate a name. A file is checked when it is loaded, since a scenario may be read on another machine."""
    if is_file(choice) or choice in PATTERN.names():
        return choice
    raise ValueError(PATTERN.describe_allowed(choice))


class Mode(StrEnum):
    """Modes of indentation during the scan."""

    CONTINUOUS = "continuous"
    POINT = "point"


class Following(StrEnum):
    """Responses to the breathing motion of the wall."""

    FOLLOW = "follow"
    """The indenter follows the wall."""
    GATE = "gate"
    """The indenter follows; samples are taken only at the end of expiration."""
    IGNORE = "ignore"
    """The indenter does not follow."""


MOTION_NOTICED_S = 1.0
"""A patient who moves is noticed within this time: the assessment discards what was felt in it, and planning repeats it."""


class SearchBudget(Section):
    """Budget of a search."""

    presses: Annotated[int, Field(ge=1, le=1000)] = 60
    """Maximum number of presses."""
    seconds: Annotated[float, Field(gt=0, le=3600)] = 300.0
    """Maximum duration [s] from the first request."""


class Search(Section):
    """Policy and end of a search. Used if `exam.pattern` is `search`."""

    policy: str = "informed"
    """Policy that chooses the next press: `informed`, `raster`, `random`, `latin-hypercube`, `expected-improvement`,
    `upper-confidence-bound`, `straddle`, `garg-2016`, `yan-pan-2021`, `ppo`, or a Python file with
    `next_press(posterior, budget)`."""
    missed: Annotated[float, Field(gt=0, lt=1)] = 0.05
    """The search ends when the probability of an undetected lump falls below this value, or the budget is spent."""


class Marked(Section):
    """Skin marked as scarred."""

    path_m: Annotated[tuple[Vec2, ...], Field(min_length=2)]
    """Corners of its middle line in the abdomen frame."""
    width_m: Annotated[float, Field(ge=0.002, le=0.2)] = 0.015


class Exam(Section):
    """Region, pattern and mode of the examination."""

    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    """Seed of random choices of the examination, such as motion planning. It does not depend on the patient's seed."""
    pose: Pose = Pose(xyz_m=(0.56, 0.0, 0.93))
    """X_WA: registered pose of the abdomen in world. The true one differs by `errors.registration`."""
    pattern: Annotated[str, AfterValidator(_known_pattern)] = "lines"
    """`lines`: alternating directions, every second line first, lifted at each line's end; `raster`: all lines from feet to head;
    `snake`: alternating directions, line ends joined in contact; `search`: presses requested by the role `search`; or a
    user-defined pattern: the path of a Python file that has `scan(exam, surface)`."""
    mode: Mode = Mode.CONTINUOUS
    """`continuous`: slides at depth; `point`: presses, holds and lifts at each point."""
    breathing: Following = Following.FOLLOW
    """`follow`: the indenter follows the breathing motion; `gate`: it follows, with samples only at the end of expiration;
    `ignore`: it does not follow."""
    depth_m: Annotated[float, Field(ge=0.0002, le=0.05)] = 0.010
    """Indentation along the inward normal, from the touched skin."""
    spacing_m: Annotated[float, Field(ge=0.001, le=0.05)] = 0.0125
    """Distance between scan lines, and between points on a line."""
    speed_mps: Annotated[float, Field(ge=0.005, le=0.1)] = 0.03
    """Tangential speed in contact."""
    region_m: tuple[Length, Length] = (0.20, 0.20)
    """Width (x) and height (y) of the examined region around `centre_m`."""
    centre_m: Vec2 = (0.0, 0.0)
    """Centre of the region in the abdomen frame."""
    budget: SearchBudget = SearchBudget()
    """Budget of a search."""
    false_findings: Annotated[float, Field(ge=1e-4, le=0.5)] = 0.02
    """Operating point: probability of a finding in a healthy examination. A smaller value misses more lumps."""
    prevalence: Annotated[float, Field(ge=1e-4, le=0.9)] = 1 / 3
    """Share of such persons who have a lump that can be felt; confidence refers to it. Which findings are reported does not."""
    marked: tuple[Marked, ...] = ()
    """Skin that the user has marked as scarred."""

    @property
    def searched(self) -> bool:
        """True if the role `search` chooses the presses."""
        return self.pattern == SEARCH


class RobotDriver(Section):
    """Connection to a real arm through a ROS 2 system over rmw_zenoh; each driver uses the fields that it needs."""

    profile: str | None = None
    """Of `services.robot: ros2_control`: `franka`, `ur`, or the path of a YAML file like theirs."""
    router: str = "tcp/127.0.0.1:7447"
    """zenoh endpoint of the ROS system: its rmw_zenohd, or the emulator."""
    domain: Annotated[int, Field(ge=0, le=232)] = 0
    """ROS domain of the ROS system."""
    namespace: str | None = None
    """Namespace of the arm's nodes; default: the driver's."""
    controller: str | None = None
    """Name of the controller that takes the commands; default: the driver's."""
    joint_states: str | None = None
    """Topic of the joint states; default: the driver's."""
    ft_topic: str | None = None
    """Topic of the F/T sensor's driver, geometry_msgs/WrenchStamped; default: the driver's, else `ft_sensor/wrench`."""
    ft_sign: Literal[1, -1] | None = None
    """-1 if the driver reports the wrench of the sensor on the tool; default: the driver's, else 1."""
    ft_weight: bool | None = None
    """False if the wrench is without the tool's weight; default: the driver's, else true."""
    ft_yaw_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    """Rotation of the sensor's x axis about the flange's z axis."""
    emulated: bool = False
    """True if the arm is the emulator. It then exchanges the `sim/` topics with simulated tissue and camera."""
    events: tuple[str, ...] = ()
    """Events of the emulated arm: a time [s], a name and a number, such as `12.5 speed 0.5`."""


class RosCamera(Section):
    """Connection to a depth camera of a ROS 2 system over rmw_zenoh."""

    router: str = "tcp/127.0.0.1:7447"
    """zenoh endpoint of the ROS system, its rmw_zenohd."""
    domain: Annotated[int, Field(ge=0, le=232)] = 0
    """ROS domain of the ROS system."""
    image: str = "camera/depth/image_rect_raw"
    """Topic of the depth images, 16UC1 [mm] or 32FC1 [m]. `rect` in its last part marks rectified images."""
    info: str = "camera/depth/camera_info"
    """Topic of the intrinsics."""
    frame: str = "camera_depth_optical_frame"
    """The camera's optical frame."""
    world: str = "world"
    """ROS frame that corresponds to world: on the floor under the robot, z up, x towards the table."""


class Robot(Section):
    """Robot, tool and its sensor."""

    arm: str = DEFAULT_ARM
    """Name of an arm, or the path of a YAML file next to a URDF. Other defaults of this section are the arm's."""
    level: CommandLevel = CommandLevel.TORQUE
    """Kind of the commands that the arm takes: `torque` or `position` from the role control, or `setpoint`: its driver follows
    `planning/setpoint` itself. A simulated arm plays `setpoint` as `torque`."""
    driver: RobotDriver = RobotDriver()
    indenter_radius_m: Annotated[float, Field(ge=0.0005, le=0.1)] = 0.015
    """Radius of the spherical indenter."""
    tool_mass_kg: Annotated[float, Field(ge=0.05, le=2)] = 0.35
    """Nominal mass below the F/T sensor: stand-off and indenter."""
    base_height_m: Annotated[float, Field(ge=0.2, le=1.5)] = 1.17
    """Height of the base. The three defaults of its placement are the optimum of `palpate arm place`."""
    base_xy_m: Vec2 = (0.03, 0.02)
    """Position of the base in world."""
    base_yaw_rad: Turn = 0.0
    """Rotation of the base about the vertical."""
    joint_friction_nm: NonNegative = 0.1
    """Nominal Coulomb friction (lbr_fri_ros2_stack's URDF)."""
    joint_damping_nms: NonNegative = 10.0
    """Nominal viscous friction (same source)."""

    @model_validator(mode="before")
    @classmethod
    def _of_arm(cls, given: Any) -> Any:
        arm = given.get("arm") if isinstance(given, Mapping) else None
        if not isinstance(arm, str) or arm == cls.model_fields["arm"].default:
            return given
        return {**placement_of(arm), **given}


class Camera(Section):
    """Kinect-like depth camera on a tripod (Nguyen 2012)."""

    ros: RosCamera = RosCamera()
    recording: str | None = None
    """Source of the frames of `services.camera: replay`: a run's folder, a rosbag2 folder or an MCAP file."""
    position_m: Vec3 = (0.95, -0.45, 1.85)
    """Calibrated optical centre in world. The true pose differs by `errors.hand_eye`."""
    look_at_m: Vec3 = (0.56, 0.0, 0.90)
    """Point in world at the centre of the image."""
    width_px: Annotated[int, Field(ge=64, le=1920)] = 640
    """Columns of a depth image."""
    height_px: Annotated[int, Field(ge=48, le=1080)] = 480
    """Rows of a depth image."""
    focal_px: Positive = 585.0
    """Focal length."""
    frames: Annotated[int, Field(ge=1, le=200)] = 20
    """Number of frames fused for a perceived surface."""

    @model_validator(mode="after")
    def _apart(self) -> "Camera":
        if dist(self.position_m, self.look_at_m) < 0.1:
            raise ValueError(f"camera.position_m {self.position_m} and look_at_m {self.look_at_m}: expected 0.1 m or more apart")
        return self


class Limits(Section):
    """Operating limits (no claim of compliance with ISO/TS 15066)."""

    force_working_n: Force = 15.0
    """Above this force the depth is reduced."""
    force_soft_stop_n: Force = 25.0
    """Above this force the arm retreats along the normal."""
    force_emergency_n: Force = 40.0
    """Above this force the driver holds safely."""
    depth_m: Annotated[float, Field(gt=0, le=0.05)] = 0.020
    """Maximum indentation: limit of the commanded depth, and of the measured depth before a stop."""
    joint_margin_rad: Annotated[float, Field(ge=0, le=0.5)] = 0.05
    """Distance from the ends of each joint's range."""
    speed_mps: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Maximum speed of the tool in free motion."""
    contact_speed_mps: Annotated[float, Field(gt=0, le=0.5)] = 0.25
    """Maximum speed of the tool in contact; above it the supervisor stops."""
    workspace_min_m: Vec3 = (-0.7, -0.6, -0.1)
    """Lower workspace bound (x, y, z) of the tool in the abdomen frame."""
    workspace_max_m: Vec3 = (0.7, 0.6, 1.2)
    """Upper workspace bound."""
    release_patience_s: NonNegative = 60.0
    """Time that a stopped examination waits for release before it ends."""
    joint_velocity_scale: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Share of the joint velocity limits used in free motion."""

    @model_validator(mode="after")
    def _order(self) -> "Limits":
        if not self.force_working_n < self.force_soft_stop_n < self.force_emergency_n:
            raise ValueError("need force_working_n < force_soft_stop_n < force_emergency_n")
        for axis, low, high in zip("xyz", self.workspace_min_m, self.workspace_max_m, strict=True):
            if not -3 <= low < high <= 3:
                raise ValueError(f"workspace_min_m, workspace_max_m: {axis} {low:g} to {high:g} m; expected -3 <= min < max <= 3")
        return self


class TissueChoice(Section):
    """Files of the tissue."""

    fmu: str | None = None
    """Co-simulation FMU for `services.tissue: fmu`; without it, it is built from the phantom."""
    fmu_map: str | None = None
    """Map of the FMU's variables to topic fields (YAML); without it, the map of the abdomen FMU."""


class Services(Section):
    """Implementation of each role: an entry point in the group `palpate.<role>`, or the path of a Python file that has
    `create(scenario)`. Further roles of the contract are fields too, with default `default`.
    """

    model_config = ConfigDict(extra="allow")

    robot: str = "dart"
    """`dart`, `mujoco`; for a real arm `lbr` or `ros2_control` (wall-clock mode only, except for an emulated arm)."""
    tissue: str = "winkler"
    """`winkler`, `elastic` or `fmu`; `none` for a real object: then there is no truth and no score (wall-clock mode only)."""
    camera: str = "kinect"
    """`kinect`, `replay`, or `ros` for a real camera (wall-clock mode only)."""
    perception: str = "default"
    planning: str = "default"
    control: str = "default"
    assessment: str = "default"
    supervisor: str = "default"
    search: str = "default"
    dashboard: str = "default"
    recorder: str = "default"


class Scenario(Section):
    """All inputs of a run."""

    name: str = "unnamed"
    """Name of the results; default: the file's name."""
    description: str = ""
    """Description, for readers."""
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    """Seed of patient, equipment and noise: equal seeds give equal runs."""
    phantom: Phantom = Phantom()
    errors: Errors = Errors()
    exam: Exam = Exam()
    search: Search = Search()
    robot: Robot = Robot()
    camera: Camera = Camera()
    limits: Annotated[Limits, Field(validate_default=True)] = Limits()
    tissue: TissueChoice = TissueChoice()
    services: Annotated[Services, Field(validate_default=True)] = Services()

    @field_validator("name")
    @classmethod
    def _one_file(cls, name: str) -> str:
        """Refuse a name that would place results in another folder."""
        if not re.fullmatch(r"[^./\\\x00-\x1f][^/\\\x00-\x1f]{0,99}", name):
            raise ValueError("expected a file name of at most 100 characters, without / and \\ and no dot at its beginning")
        return name

    @field_validator("phantom")
    @classmethod
    def _draw_person(cls, phantom: Phantom, info: ValidationInfo) -> Phantom:
        """Draw a person from the seed, so that every scenario has a complete phantom."""
        seed = info.data.get("seed")
        return phantom if seed is None else draw_person(phantom, seed)

    @field_validator("limits")
    @classmethod
    def _deep_enough(cls, limits: Limits, info: ValidationInfo) -> Limits:
        exam = info.data.get("exam")
        if exam is not None and exam.depth_m > limits.depth_m:
            raise ValueError(f"limits.depth_m = {limits.depth_m:g} m: expected at least exam.depth_m, {exam.depth_m:g} m")
        return limits

    @field_validator("services")
    @classmethod
    def _fitting(cls, services: Services, info: ValidationInfo) -> Services:
        camera, tissue = info.data.get("camera"), info.data.get("tissue")
        if camera is not None and (services.camera == "replay") != (camera.recording is not None):
            raise ValueError("services.camera: replay needs camera.recording: FILE, and camera.recording needs it")
        if tissue is not None and (tissue.fmu is not None or tissue.fmu_map is not None) and services.tissue != "fmu":
            raise ValueError("tissue.fmu and tissue.fmu_map need services.tissue: fmu")
        return services


class ExamInput(Section):
    """Inputs of every role: examination, nominal equipment, registered pose."""

    X_WA: tuple[tuple[float, float, float, float], ...]
    """Registered pose of the abdomen in world, homogeneous 4 x 4."""
    exam: Exam
    robot: Robot
    camera: Camera
    limits: Limits


class PlantInput(ExamInput):
    """Inputs of the simulated robot and camera: also their errors, drawn from the seed by `draw_errors`."""

    seed: int
    errors: Errors
