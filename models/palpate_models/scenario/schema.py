"""A scenario: everything that a run is made of, as one frozen, validated model. YAML overlays its defaults.

Field names carry their unit. Angles are in radians, lengths in metres, unless the name says otherwise.
World frame W: origin on the floor under the robot, z up, x towards the table. Abdomen frame A: origin at the umbilicus,
x to the patient's left, y to the head, z outward.
"""

from __future__ import annotations

from enum import StrEnum
from math import dist
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, ConfigDict, Field, ValidationInfo, field_validator, model_validator

from palpate_models.patient.person import drawn
from palpate_models.patient.schema import Phantom
from palpate_models.scenario.errors import Errors
from palpate_models.section import Force, Length, NonNegative, Pose, Positive, Section, Vec2, Vec3
from palpate_plugins import PluginKind, is_file

SEARCH: Final = "search"
BUILTIN_PATTERNS: Final = ("lines", "raster", "snake", SEARCH)
PATTERN: Final = PluginKind(
    "pattern", "exam.pattern", "scan", "exam, surface", BUILTIN_PATTERNS, "palpate_models.scenario.patterns"
)


def _known_pattern(choice: str) -> str:
    """Validate a name. A file is checked when it is loaded, since a scenario may be read on another machine."""
    if is_file(choice) or choice in PATTERN.names():
        return choice
    raise ValueError(PATTERN.expected(choice))


class Mode(StrEnum):
    """Indentation while covering."""

    CONTINUOUS = "continuous"
    POINT = "point"


class Following(StrEnum):
    """What is done about the wall's breathing."""

    FOLLOW = "follow"
    """The indenter follows the wall."""
    GATE = "gate"
    """It follows, and samples are taken at the end of expiration alone."""
    IGNORE = "ignore"
    """It does not follow, as if the patient did not breathe."""


class SearchBudget(Section):
    """How much a search may take."""

    presses: Annotated[int, Field(ge=1, le=1000)] = 60
    seconds: Annotated[float, Field(gt=0, le=3600)] = 300.0
    """From its first request on."""


class Search(Section):
    """How a search presses, and when it is over. It takes part where `exam.pattern` is `search`."""

    policy: str = "informed"
    """What chooses the next press: `informed`, `raster`, `random`, `latin-hypercube`, `expected-improvement`,
    `upper-confidence-bound`, `straddle`, `garg-2016`, `yan-pan-2021`, `ppo`, or a Python file with
    `next_press(posterior, budget)`."""
    missed: Annotated[float, Field(gt=0, lt=1)] = 0.05
    """It is over when a lump that was not found is less probable than this, or the budget is spent."""


class Exam(Section):
    """What is examined, and how."""

    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    """Seed of what the examination itself draws, such as motion planning; the patient's seed is a secret."""
    pose: Pose = Pose(xyz_m=(0.56, 0.0, 0.93))
    """X_WA: registered pose of the abdomen in world. The true one differs by `errors.registration`."""
    pattern: Annotated[str, AfterValidator(_known_pattern)] = "lines"
    """`lines`: there and back, every second line first, lifted at each line's end; `raster`: every line from the feet to the
    head; `snake`: there and back, line ends joined in contact; `search`: presses where the role `search` asks for them; or a
    pattern of your own: the path of a Python file that has `scan(exam, surface)`."""
    mode: Mode = Mode.CONTINUOUS
    """`continuous`: slides at depth; `point`: presses, holds and lifts at each point."""
    breathing: Following = Following.FOLLOW
    """`follow`: the indenter follows the wall; `gate`: it follows, and samples are taken at the end of expiration alone;
    `ignore`: it does not follow, as if the patient did not breathe."""
    depth_m: Annotated[float, Field(ge=0.002, le=0.02)] = 0.010
    """Indentation along the inward normal from where the skin is touched."""
    spacing_m: Annotated[float, Field(ge=0.004, le=0.05)] = 0.0125
    """Distance of scan lines, and of points on a line."""
    speed_mps: Annotated[float, Field(ge=0.005, le=0.1)] = 0.03
    """Tangential speed in contact."""
    region_m: tuple[Length, Length] = (0.20, 0.20)
    """Width (x) and height (y) of the examined region about `centre_m`."""
    centre_m: Vec2 = (0.0, 0.0)
    """Centre of the region in the abdomen frame."""
    budget: SearchBudget = SearchBudget()
    """How much a search may take."""
    false_findings: Annotated[float, Field(ge=1e-4, le=0.5)] = 0.02
    """The operating point: how probable a finding may be in a healthy examination. Less of it misses more."""

    @property
    def searched(self) -> bool:
        """Whether the role `search` says what is pressed."""
        return self.pattern == SEARCH


class LbrConnection(Section):
    """Where a real LBR is and how it is commanded: the ROS side, lbr_fri_ros2_stack over rmw_zenoh."""

    router: str = "tcp/127.0.0.1:7447"
    """zenoh endpoint of the ROS side: its rmw_zenohd, or the emulator."""
    domain: Annotated[int, Field(ge=0, le=232)] = 0
    """Its ROS domain."""
    namespace: str = "lbr"
    """The stack's `robot_name`, which is its namespace too."""
    ft_topic: str = "ft_sensor/wrench"
    """Topic of the F/T sensor's driver, geometry_msgs/WrenchStamped."""
    ft_sign: Literal[1, -1] = 1
    """-1 when that driver reports what the sensor exerts on the tool."""
    ft_yaw_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    """How far the sensor's x axis is turned about the flange's z."""
    level: Literal["torque", "setpoint"] = "torque"
    """`setpoint`: the control law runs in the driver's process, and `control/joint_torque` is not read."""
    emulated: bool = False
    """Whether the arm is the emulator: then what only physics knows is exchanged with it, for simulated tissue and camera."""


class RosCamera(Section):
    """Where a depth camera of a ROS 2 system is, over rmw_zenoh."""

    router: str = "tcp/127.0.0.1:7447"
    """zenoh endpoint of the ROS side, its rmw_zenohd."""
    domain: Annotated[int, Field(ge=0, le=232)] = 0
    """Its ROS domain."""
    image: str = "camera/depth/image_rect_raw"
    """Topic of the depth images, 16UC1 [mm] or 32FC1 [m]; they count as rectified when its last part has `rect` in it."""
    info: str = "camera/depth/camera_info"
    """Topic of the intrinsics."""
    frame: str = "camera_depth_optical_frame"
    """The camera's optical frame."""
    world: str = "world"
    """The ROS frame that is our world: on the floor under the robot, z up, x towards the table."""


class Robot(Section):
    """Robot, tool and its sensor."""

    lbr: LbrConnection = LbrConnection()
    indenter_radius_m: Annotated[float, Field(ge=0.005, le=0.04)] = 0.015
    """Radius of the sphere that presses."""
    tool_mass_kg: Annotated[float, Field(ge=0.05, le=2)] = 0.35
    """Nominal mass below the F/T sensor: stand-off and indenter."""
    base_height_m: Annotated[float, Field(ge=0.2, le=1.5)] = 1.17
    """Height of the base. The three defaults of its placement are what `python -m research.base_placement` finds best."""
    base_xy_m: Vec2 = (0.03, 0.02)
    """Where the base stands in world."""
    base_yaw_rad: float = 0.0
    """How it is turned about the vertical."""
    joint_friction_nm: NonNegative = 0.1
    """Nominal Coulomb friction (lbr_fri_ros2_stack's URDF)."""
    joint_damping_nms: NonNegative = 10.0
    """Nominal viscous friction (the same)."""


class Camera(Section):
    """Kinect-like depth camera on a tripod (Nguyen 2012)."""

    ros: RosCamera = RosCamera()
    recording: str | None = None
    """A run's folder, a rosbag2 folder or an MCAP file whose frames `services.camera: replay` shows."""
    position_m: Vec3 = (0.95, -0.45, 1.85)
    """Optical centre in world, as calibrated. The true pose differs by `errors.hand_eye`."""
    look_at_m: Vec3 = (0.56, 0.0, 0.90)
    """Point in world at the centre of its picture."""
    width_px: Annotated[int, Field(ge=64, le=1920)] = 640
    """Columns of a depth image."""
    height_px: Annotated[int, Field(ge=48, le=1080)] = 480
    """Rows of a depth image."""
    focal_px: Positive = 585.0
    """Focal length."""
    frames: Annotated[int, Field(ge=1, le=200)] = 20
    """Frames fused for a perceived surface."""

    @model_validator(mode="after")
    def _apart(self) -> Camera:
        if dist(self.position_m, self.look_at_m) < 0.1:
            raise ValueError(
                f"camera.position_m {self.position_m} and look_at_m {self.look_at_m}: want at least 0.1 m between them"
            )
        return self


class Limits(Section):
    """Operating limits that we set (no claim of compliance with ISO/TS 15066)."""

    force_working_n: Force = 15.0
    """At this force depth yields."""
    force_soft_stop_n: Force = 25.0
    """The exam retreats along the normal."""
    force_emergency_n: Force = 40.0
    """The driver holds safely."""
    depth_m: Annotated[float, Field(gt=0, le=0.05)] = 0.020
    """Greatest indentation: the exam commands no more, and beyond it the supervisor stops."""
    joint_margin_rad: Annotated[float, Field(ge=0, le=0.5)] = 0.05
    """Distance that is kept from the ends of each joint's range."""
    speed_mps: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Speed of the tool in free motion."""
    contact_speed_mps: Annotated[float, Field(gt=0, le=0.5)] = 0.25
    """Speed of the tool while it presses: at this the supervisor stops."""
    workspace_min_m: Vec3 = (-0.7, -0.6, -0.1)
    """Least x, y, z of the tool in the abdomen frame ..."""
    workspace_max_m: Vec3 = (0.7, 0.6, 1.2)
    """... and largest."""
    release_patience_s: NonNegative = 60.0
    """How long a stopped exam waits for an operator's release before it ends."""
    joint_velocity_scale: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Fraction of the joint velocity limits used in free motion."""

    @model_validator(mode="after")
    def _order(self) -> Limits:
        if not self.force_working_n < self.force_soft_stop_n < self.force_emergency_n:
            raise ValueError("need force_working_n < force_soft_stop_n < force_emergency_n")
        for axis, low, high in zip("xyz", self.workspace_min_m, self.workspace_max_m, strict=True):
            if not -3 <= low < high <= 3:
                raise ValueError(
                    f"workspace_min_m and workspace_max_m: {axis} from {low:g} to {high:g} m; want -3 <= min < max <= 3"
                )
        return self


class TissueChoice(Section):
    """What the tissue is made from."""

    fmu: str | None = None
    """File of a co-simulation FMU for `services.tissue: fmu`; built from the phantom when empty."""
    fmu_map: str | None = None
    """File of the map of its variables to topic fields (YAML); that of the abdomen FMU when empty."""


class Services(Section):
    """Which implementation plays each role: the name of an entry point in the group `palpate.<role>`, or the path of a Python
    file that has `create(scenario)`. A role that the contract has besides these is a field, too, by default `default`.
    """

    model_config = ConfigDict(extra="allow")

    robot: str = "dart"
    """`dart`, `mujoco`, or `lbr` for the real arm (wall clock only)."""
    tissue: str = "winkler"
    """`winkler`, `elastic` or `fmu`; `none` where what the arm touches is real: then no tissue is simulated, no truth is known,
    and nothing is scored (wall clock only)."""
    camera: str = "kinect"
    """`kinect`, `replay`, or `ros` for a real camera (wall clock only)."""
    perception: str = "default"
    planning: str = "default"
    control: str = "default"
    assessment: str = "default"
    supervisor: str = "default"
    search: str = "default"
    dashboard: str = "default"
    recorder: str = "default"


class Scenario(Section):
    """All of a run. `palpate_models.scenario.load.seen` gives the part that a role may know."""

    name: str = "unnamed"
    """Names the run's results; by default the file's name."""
    description: str = ""
    """A sentence for people."""
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    """Patient and equipment are drawn from it, and noise: equal seeds give equal runs."""
    phantom: Phantom = Phantom()
    errors: Errors = Errors()
    exam: Exam = Exam()
    search: Search = Search()
    robot: Robot = Robot()
    camera: Camera = Camera()
    limits: Limits = Limits()
    tissue: TissueChoice = TissueChoice()
    services: Annotated[Services, Field(validate_default=True)] = Services()

    @field_validator("phantom")
    @classmethod
    def _drawn(cls, phantom: Phantom, info: ValidationInfo) -> Phantom:
        """A person as the seed draws it: a scenario has no phantom that is not whole."""
        seed = info.data.get("seed")
        return phantom if seed is None else drawn(phantom, seed)

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
    """What every role may know: how the examination is to be, with the nominal equipment and the registered pose."""

    X_WA: tuple[tuple[float, float, float, float], ...]
    """Registered pose of the abdomen in world, homogeneous 4 x 4."""
    exam: Exam
    robot: Robot
    camera: Camera
    limits: Limits


class PlantInput(ExamInput):
    """What the simulated robot and camera may know besides: their own errors, which `draw_errors` draws from the seed."""

    seed: int
    errors: Errors
