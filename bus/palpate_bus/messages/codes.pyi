"""Written by `python bus/tests/message_stubs.py`; change the .msg files or typestore.py instead."""

from enum import IntEnum

class DriverMode(IntEnum):
    IDLE = 0
    ACTIVE = 1
    SAFE_HOLD = 2

class FindingKind(IntEnum):
    LUMP = 0
    MUSCLE = 1
    RIDGE = 2
    BONE = 3
    SOFT_DEFECT = 4

class HoldCause(IntEnum):
    NONE = 0
    COMMAND_EXPIRED = 1
    COMMANDER_LOST = 2
    POSITION_LIMIT = 3
    VELOCITY_LIMIT = 4
    TORQUE_LIMIT = 5
    INVALID_COMMAND = 6
    FORCE_LIMIT = 7
    STOP_REQUESTED = 8
    DEVICE = 9
    SUPERVISOR = 10

class Phase(IntEnum):
    HOME = 0
    LOOK = 1
    PLAN = 2
    APPROACH = 3
    INDENT = 4
    SCAN = 5
    RETRACT = 6
    RETURN = 7
    ASSESS = 8
    DONE = 9
    ABORTED = 10
    HELD = 11

class Reason(IntEnum):
    NONE = 0
    VIEW_BLOCKED = 1
    VIEW_FAILED = 2
    VIEW_TIMEOUT = 3
    VIEW_UNREACHABLE = 4
    NO_PATH = 5
    OUT_OF_REACH = 6
    ARM_STRETCHED = 7
    COLLISION = 8
    FORCE = 9
    NO_TISSUE = 10
    UNEXPECTED_CONTACT = 11
    WALL_NOT_TRACKED = 12
    WALL_HIDDEN = 13
    CONTACT_LOST = 14
    PATIENT_MOVED = 15
    ARM_DISPLACED = 16
    NO_REQUEST = 17
    OPERATOR_STOP = 18
    OPERATOR_END = 19
    ROBOT_HOLD = 20
    ROBOT_NOT_READY = 21
    SOFT_STOP = 22
    EMERGENCY_STOP = 23
    NOT_RELEASED = 24
    SERVICE_LOST = 25
    OTHER_PATIENT = 26
    NO_FINDINGS = 27
    WAITS_FOR_WALL = 28
    WAITS_FOR_BREATH = 29
    WAITS_FOR_ARM = 30
    WAITS_FOR_REQUEST = 31
    WAITS_FOR_ROBOT = 32
    WAITS_FOR_PLAN = 33
    WAITS_FOR_PERCEPTION = 34
    WAITS_FOR_FINDINGS = 35

class StopCause(IntEnum):
    NONE = 0
    FORCE = 1
    DEPTH = 2
    SPEED = 3
    WORKSPACE = 4
    LOST = 5
    SILENT = 6
    INVALID = 7
    OPERATOR = 8
    DRIVER = 9
    UNHEEDED = 10
    SENSOR = 11

class StopLevel(IntEnum):
    OK = 0
    SOFT_STOP = 1
    EMERGENCY = 2

class UnassessedReason(IntEnum):
    ASSESSED = 0
    NOT_REACHED = 1
    CONTRADICTED = 2
    YIELDED = 3

class ViewReason(IntEnum):
    NONE = 0
    VIEW_BLOCKED = 1
    SELF_OCCLUDED = 2
    OUT_OF_IMAGE = 3
    NO_DEPTH = 4
    BEYOND_ABDOMEN = 5
    TOO_FEW_POINTS = 6
    PATIENT_MOVED = 7
    NO_FRAMES = 8
    NO_CAMERA = 9
    NO_CALIBRATION = 10
    BAD_FRAMES = 11
