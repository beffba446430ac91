"""Written by `python bus/tests/message_stubs.py`; change the .msg files or typestore.py instead."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from palpate_bus.messages.codec import CodecError as CodecError, Message as Message
from palpate_bus.messages.stamps import (
    MS as MS,
    NS as NS,
    UNIX_NS as UNIX_NS,
    blank as blank,
    duration_message as duration_message,
    header as header,
    nanoseconds as nanoseconds,
    time_message as time_message,
)

@dataclass
class Duration:
    __msgtype__: ClassVar[str]
    sec: int
    nanosec: int

@dataclass
class Time:
    __msgtype__: ClassVar[str]
    sec: int
    nanosec: int

@dataclass
class DiagnosticArray:
    __msgtype__: ClassVar[str]
    header: Header
    status: list[DiagnosticStatus]

@dataclass
class DiagnosticStatus:
    __msgtype__: ClassVar[str]
    OK: ClassVar[int]
    WARN: ClassVar[int]
    ERROR: ClassVar[int]
    STALE: ClassVar[int]
    level: int
    name: str
    message: str
    hardware_id: str
    values: list[KeyValue]

@dataclass
class KeyValue:
    __msgtype__: ClassVar[str]
    key: str
    value: str

@dataclass
class Point:
    __msgtype__: ClassVar[str]
    x: float
    y: float
    z: float

@dataclass
class Pose:
    __msgtype__: ClassVar[str]
    position: Point
    orientation: Quaternion

@dataclass
class PoseStamped:
    __msgtype__: ClassVar[str]
    header: Header
    pose: Pose

@dataclass
class Quaternion:
    __msgtype__: ClassVar[str]
    x: float
    y: float
    z: float
    w: float

@dataclass
class Transform:
    __msgtype__: ClassVar[str]
    translation: Vector3
    rotation: Quaternion

@dataclass
class TransformStamped:
    __msgtype__: ClassVar[str]
    header: Header
    child_frame_id: str
    transform: Transform

@dataclass
class Twist:
    __msgtype__: ClassVar[str]
    linear: Vector3
    angular: Vector3

@dataclass
class Vector3:
    __msgtype__: ClassVar[str]
    x: float
    y: float
    z: float

@dataclass
class Wrench:
    __msgtype__: ClassVar[str]
    force: Vector3
    torque: Vector3

@dataclass
class WrenchStamped:
    __msgtype__: ClassVar[str]
    header: Header
    wrench: Wrench

@dataclass
class Path:
    __msgtype__: ClassVar[str]
    header: Header
    poses: list[PoseStamped]

@dataclass
class Advance:
    __msgtype__: ClassVar[str]
    tick: int
    sequences: NDArray[np.uint32]

@dataclass
class CameraTrigger:
    __msgtype__: ClassVar[str]
    header: Header
    frames: int

@dataclass
class ExamState:
    __msgtype__: ClassVar[str]
    PHASE_HOME: ClassVar[int]
    PHASE_LOOK: ClassVar[int]
    PHASE_PLAN: ClassVar[int]
    PHASE_APPROACH: ClassVar[int]
    PHASE_INDENT: ClassVar[int]
    PHASE_SCAN: ClassVar[int]
    PHASE_RETRACT: ClassVar[int]
    PHASE_RETURN: ClassVar[int]
    PHASE_ASSESS: ClassVar[int]
    PHASE_DONE: ClassVar[int]
    PHASE_ABORTED: ClassVar[int]
    PHASE_HELD: ClassVar[int]
    REASON_NONE: ClassVar[int]
    REASON_VIEW_BLOCKED: ClassVar[int]
    REASON_VIEW_FAILED: ClassVar[int]
    REASON_VIEW_TIMEOUT: ClassVar[int]
    REASON_VIEW_UNREACHABLE: ClassVar[int]
    REASON_NO_PATH: ClassVar[int]
    REASON_OUT_OF_REACH: ClassVar[int]
    REASON_ARM_STRETCHED: ClassVar[int]
    REASON_COLLISION: ClassVar[int]
    REASON_FORCE: ClassVar[int]
    REASON_NO_TISSUE: ClassVar[int]
    REASON_UNEXPECTED_CONTACT: ClassVar[int]
    REASON_WALL_NOT_TRACKED: ClassVar[int]
    REASON_WALL_HIDDEN: ClassVar[int]
    REASON_CONTACT_LOST: ClassVar[int]
    REASON_PATIENT_MOVED: ClassVar[int]
    REASON_ARM_DISPLACED: ClassVar[int]
    REASON_NO_REQUEST: ClassVar[int]
    REASON_OPERATOR_STOP: ClassVar[int]
    REASON_OPERATOR_END: ClassVar[int]
    REASON_ROBOT_HOLD: ClassVar[int]
    REASON_ROBOT_NOT_READY: ClassVar[int]
    REASON_SOFT_STOP: ClassVar[int]
    REASON_EMERGENCY_STOP: ClassVar[int]
    REASON_NOT_RELEASED: ClassVar[int]
    REASON_SERVICE_LOST: ClassVar[int]
    REASON_OTHER_PATIENT: ClassVar[int]
    REASON_NO_FINDINGS: ClassVar[int]
    REASON_WAITS_FOR_WALL: ClassVar[int]
    REASON_WAITS_FOR_BREATH: ClassVar[int]
    REASON_WAITS_FOR_ARM: ClassVar[int]
    REASON_WAITS_FOR_REQUEST: ClassVar[int]
    REASON_WAITS_FOR_ROBOT: ClassVar[int]
    REASON_WAITS_FOR_PLAN: ClassVar[int]
    REASON_WAITS_FOR_PERCEPTION: ClassVar[int]
    REASON_WAITS_FOR_FINDINGS: ClassVar[int]
    header: Header
    phase: int
    message: str
    target_index: int
    target_count: int
    targets_skipped: int
    in_contact: bool
    steady: bool
    force_limited: bool
    view_blocked: bool
    depth_setpoint: float
    depth: float
    normal_force: float
    surface_point: Point
    surface_normal: Vector3
    end_tick: int
    depth_uncertainty: float
    wall_displacement: float
    stroke: int
    patient_moved: bool
    reason: int
    culprit: str

@dataclass
class Finding:
    __msgtype__: ClassVar[str]
    KIND_LUMP: ClassVar[int]
    KIND_MUSCLE: ClassVar[int]
    KIND_RIDGE: ClassVar[int]
    KIND_BONE: ClassVar[int]
    KIND_SOFT_DEFECT: ClassVar[int]
    centroid: Point
    quadrant: str
    area: float
    ratio: float
    ratio_lower: float
    ratio_upper: float
    confidence: float
    guarding: float
    ridge: float
    bone: float
    soft: float
    kind: int

@dataclass
class Findings:
    __msgtype__: ClassVar[str]
    header: Header
    findings: list[Finding]
    candidates: list[Finding]
    final: bool

@dataclass
class ImpedanceSetpoint:
    __msgtype__: ClassVar[str]
    MODE_CARTESIAN: ClassVar[int]
    MODE_JOINT: ClassVar[int]
    header: Header
    mode: int
    pose: Pose
    twist: Twist
    wrench: Wrench
    stiffness: NDArray[np.float64]
    damping_ratio: NDArray[np.float64]
    joint_position: NDArray[np.float64]
    joint_velocity: NDArray[np.float64]
    joint_stiffness: NDArray[np.float64]
    valid_for: Duration

@dataclass
class IndentationTruth:
    __msgtype__: ClassVar[str]
    header: Header
    depth: float
    normal_force: float
    tangential_force: float
    peak_force: float
    contacts: int
    surface_point: Point
    stiffness: float

@dataclass
class JointTorqueCommand:
    __msgtype__: ClassVar[str]
    header: Header
    torque: NDArray[np.float64]
    position: NDArray[np.float64]
    valid_for: Duration
    problem: str
    culprit: str

@dataclass
class OperatorRequest:
    __msgtype__: ClassVar[str]
    STOP: ClassVar[int]
    RELEASE: ClassVar[int]
    END: ClassVar[int]
    SOFT_STOP: ClassVar[int]
    header: Header
    request: int
    reason: str

@dataclass
class PalpationSample:
    __msgtype__: ClassVar[str]
    header: Header
    position: Point
    normal: Vector3
    depth: float
    normal_force: float
    tangential_speed: float
    time_in_contact: float
    force_limited: bool
    stroke: int
    depth_uncertainty: float

@dataclass
class PalpationTargets:
    __msgtype__: ClassVar[str]
    NONE: ClassVar[int]
    VIEW_BLOCKED: ClassVar[int]
    SELF_OCCLUDED: ClassVar[int]
    OUT_OF_IMAGE: ClassVar[int]
    NO_DEPTH: ClassVar[int]
    BEYOND_ABDOMEN: ClassVar[int]
    TOO_FEW_POINTS: ClassVar[int]
    PATIENT_MOVED: ClassVar[int]
    NO_FRAMES: ClassVar[int]
    NO_CAMERA: ClassVar[int]
    NO_CALIBRATION: ClassVar[int]
    BAD_FRAMES: ClassVar[int]
    header: Header
    positions: list[Point]
    normals: list[Vector3]
    lines: NDArray[np.uint32]
    surface_noise: float
    frames_fused: int
    coverage: float
    reason: int
    message: str

@dataclass
class PatientTruth:
    __msgtype__: ClassVar[str]
    header: Header
    excursion: float
    pose: Pose

@dataclass
class PhantomTruth:
    __msgtype__: ClassVar[str]
    surface: SurfaceMesh
    stiffness: NDArray[np.float64]
    background: NDArray[np.float64]
    lesion: NDArray[np.int32]
    pose: Pose

@dataclass
class RecordChunk:
    __msgtype__: ClassVar[str]
    role: str
    tick: int
    topics: list[str]
    topic: NDArray[np.uint16]
    stamp: NDArray[np.int64]
    sequence: NDArray[np.uint32]
    length: NDArray[np.uint32]
    data: NDArray[np.uint8]

@dataclass
class RobotStatus:
    __msgtype__: ClassVar[str]
    MODE_IDLE: ClassVar[int]
    MODE_ACTIVE: ClassVar[int]
    MODE_SAFE_HOLD: ClassVar[int]
    CAUSE_NONE: ClassVar[int]
    CAUSE_COMMAND_EXPIRED: ClassVar[int]
    CAUSE_COMMANDER_LOST: ClassVar[int]
    CAUSE_POSITION_LIMIT: ClassVar[int]
    CAUSE_VELOCITY_LIMIT: ClassVar[int]
    CAUSE_TORQUE_LIMIT: ClassVar[int]
    CAUSE_INVALID_COMMAND: ClassVar[int]
    CAUSE_FORCE_LIMIT: ClassVar[int]
    CAUSE_STOP_REQUESTED: ClassVar[int]
    CAUSE_DEVICE: ClassVar[int]
    CAUSE_SUPERVISOR: ClassVar[int]
    header: Header
    mode: int
    cause: int
    reason: str
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    wrench: Wrench
    applied_torque: NDArray[np.float64]
    commands_rejected: int
    culprit: str
    measured_torque: NDArray[np.float64]

@dataclass
class RunControl:
    __msgtype__: ClassVar[str]
    HELLO: ClassVar[int]
    GRANT: ClassVar[int]
    LOST: ClassVar[int]
    ABORT: ClassVar[int]
    END: ClassVar[int]
    HANDOVER: ClassVar[int]
    HEARTBEAT: ClassVar[int]
    command: int
    tick: int
    last: bool
    role: str
    reason: str

@dataclass
class SearchRequest:
    __msgtype__: ClassVar[str]
    PRESS: ClassVar[int]
    DONE: ClassVar[int]
    header: Header
    number: int
    request: int
    place: Point
    depth: float
    lump: float
    reason: str

@dataclass
class ServiceReport:
    __msgtype__: ClassVar[str]
    READY: ClassVar[int]
    PROGRESS: ClassVar[int]
    FINISHED: ClassVar[int]
    FAILED: ClassVar[int]
    state: int
    role: str
    tick: int
    waiting_for: str
    detail: str

@dataclass
class SkinTouch:
    __msgtype__: ClassVar[str]
    header: Header
    surface_point: Point
    stroke: int
    height: float
    sigma: float
    expected: float
    expected_sigma: float

@dataclass
class StiffnessMap:
    __msgtype__: ClassVar[str]
    ASSESSED: ClassVar[int]
    NOT_REACHED: ClassVar[int]
    CONTRADICTED: ClassVar[int]
    YIELDED: ClassVar[int]
    header: Header
    vertices: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    apparent: NDArray[np.float32]
    lower: NDArray[np.float32]
    upper: NDArray[np.float32]
    force: NDArray[np.float32]
    stiffness: NDArray[np.float32]
    scanned: NDArray[np.bool]
    unassessed: NDArray[np.uint8]
    finding: NDArray[np.int32]
    common_depth: float
    background: float
    samples: int

@dataclass
class SupervisorState:
    __msgtype__: ClassVar[str]
    LEVEL_OK: ClassVar[int]
    LEVEL_SOFT_STOP: ClassVar[int]
    LEVEL_EMERGENCY: ClassVar[int]
    CAUSE_NONE: ClassVar[int]
    CAUSE_FORCE: ClassVar[int]
    CAUSE_DEPTH: ClassVar[int]
    CAUSE_SPEED: ClassVar[int]
    CAUSE_WORKSPACE: ClassVar[int]
    CAUSE_LOST: ClassVar[int]
    CAUSE_SILENT: ClassVar[int]
    CAUSE_INVALID: ClassVar[int]
    CAUSE_OPERATOR: ClassVar[int]
    CAUSE_DRIVER: ClassVar[int]
    CAUSE_UNHEEDED: ClassVar[int]
    CAUSE_SENSOR: ClassVar[int]
    header: Header
    level: int
    cause: int
    reason: str
    releases: int
    force: float
    depth: float
    speed: float
    refusals: int
    culprit: str
    joint_force: float

@dataclass
class SurfaceCorrection:
    __msgtype__: ClassVar[str]
    header: Header
    outward: NDArray[np.float32]
    uncertainty: NDArray[np.float32]

@dataclass
class SurfaceMesh:
    __msgtype__: ClassVar[str]
    header: Header
    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    breathing: NDArray[np.float32]

@dataclass
class SurfaceMotion:
    __msgtype__: ClassVar[str]
    QUIET: ClassVar[int]
    SPOILED: ClassVar[int]
    MOVED: ClassVar[int]
    LOST: ClassVar[int]
    FORECASTS: ClassVar[int]
    FORECAST_STEP_MS: ClassVar[int]
    header: Header
    state: int
    displacement: float
    forecast: NDArray[np.float64]
    uncertainty: float
    shift: Vector3

@dataclass
class ToolState:
    __msgtype__: ClassVar[str]
    header: Header
    pose: Pose
    twist: Twist
    radius: float

@dataclass
class Clock:
    __msgtype__: ClassVar[str]
    clock: Time

@dataclass
class CameraInfo:
    __msgtype__: ClassVar[str]
    header: Header
    height: int
    width: int
    distortion_model: str
    d: NDArray[np.float64]
    k: NDArray[np.float64]
    r: NDArray[np.float64]
    p: NDArray[np.float64]
    binning_x: int
    binning_y: int
    roi: RegionOfInterest

@dataclass
class Image:
    __msgtype__: ClassVar[str]
    header: Header
    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    data: NDArray[np.uint8]

@dataclass
class JointState:
    __msgtype__: ClassVar[str]
    header: Header
    name: list[str]
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    effort: NDArray[np.float64]

@dataclass
class PointCloud2:
    __msgtype__: ClassVar[str]
    header: Header
    height: int
    width: int
    fields: list[PointField]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: NDArray[np.uint8]
    is_dense: bool

@dataclass
class PointField:
    __msgtype__: ClassVar[str]
    INT8: ClassVar[int]
    UINT8: ClassVar[int]
    INT16: ClassVar[int]
    UINT16: ClassVar[int]
    INT32: ClassVar[int]
    UINT32: ClassVar[int]
    FLOAT32: ClassVar[int]
    FLOAT64: ClassVar[int]
    name: str
    offset: int
    datatype: int
    count: int

@dataclass
class RegionOfInterest:
    __msgtype__: ClassVar[str]
    x_offset: int
    y_offset: int
    height: int
    width: int
    do_rectify: bool

@dataclass
class Header:
    __msgtype__: ClassVar[str]
    stamp: Time
    frame_id: str

@dataclass
class String:
    __msgtype__: ClassVar[str]
    data: str

@dataclass
class TFMessage:
    __msgtype__: ClassVar[str]
    transforms: list[TransformStamped]
