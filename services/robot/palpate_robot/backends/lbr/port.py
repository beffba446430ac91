"""Messages between the driver and the ROS side, and the port that exchanges them.

The messages are those of `lbr_fri_idl` (branch fri-1, FRI 1.11 to 1.16) with the values of FRI's enumerations. Field names and
types are those of the ROS package, so that type hash and CDR are equal.
"""

from enum import IntEnum
from typing import Any

from rosbags.typesys import get_types_from_msg

from palpate_bus.messages import codec
from palpate_models.numerics.frames import Array
from palpate_models.scenario.schema import RobotDriver
from palpate_robot.backends.arm_port import ZenohArmPort

_STATE = """\
float64 sample_time
int8 session_state
int8 connection_quality
int8 safety_state
int8 operation_mode
int8 drive_state
int8 client_command_mode
int8 overlay_type
int8 control_mode
uint32 time_stamp_sec
uint32 time_stamp_nano_sec
float64[7] measured_joint_position
float64[7] commanded_joint_position
float64[7] measured_torque
float64[7] commanded_torque
float64[7] external_torque
float64[7] ipo_joint_position
float64 tracking_performance
"""
STATE = "lbr_fri_idl/msg/LBRState"
TORQUE_COMMAND = "lbr_fri_idl/msg/LBRTorqueCommand"
NAMESPACE, FT_TOPIC = "lbr", "ft_sensor/wrench"
"""Default of the stack's `robot_name`, which is also its namespace."""
DEFINITIONS = {STATE: _STATE, TORQUE_COMMAND: "float64[7] joint_position\nfloat64[7] torque\n"}

for _name, _text in DEFINITIONS.items():
    codec.store.register(get_types_from_msg(_text, _name))
LBRState: Any = codec.message_type(STATE)
LBRTorqueCommand: Any = codec.message_type(TORQUE_COMMAND)


class SessionState(IntEnum):
    """KUKA::FRI::ESessionState."""

    IDLE = 0
    MONITORING_WAIT = 1
    MONITORING_READY = 2
    COMMANDING_WAIT = 3
    COMMANDING_ACTIVE = 4


class ConnectionQuality(IntEnum):
    """KUKA::FRI::EConnectionQuality."""

    POOR = 0
    FAIR = 1
    GOOD = 2
    EXCELLENT = 3


class SafetyState(IntEnum):
    """KUKA::FRI::ESafetyState."""

    NORMAL_OPERATION = 0
    SAFETY_STOP_LEVEL_0 = 1
    SAFETY_STOP_LEVEL_1 = 2
    SAFETY_STOP_LEVEL_2 = 3


class ClientCommandMode(IntEnum):
    """KUKA::FRI::EClientCommandMode."""

    NO_COMMAND_MODE = 0
    POSITION = 1
    WRENCH = 2
    TORQUE = 3


class ZenohPort(ZenohArmPort):
    """Connection to the stack."""

    def __init__(self, given: RobotDriver) -> None:
        """Connect. Raises BusConfigError."""
        name = (given.namespace or NAMESPACE).strip("/")
        command = f"{name}/command/torque", TORQUE_COMMAND
        super().__init__("palpate_robot.backends.lbr", given, (f"{name}/state", STATE), command, given.ft_topic or FT_TOPIC)

    def command(self, q: Array, values: Array) -> None:
        """Send both; the stack's torque controller also needs a joint position, see docs/real-lbr.md on its stiffness."""
        self._command.publish(LBRTorqueCommand(q, values))
