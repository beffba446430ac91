"""Messages between the driver and the ROS side, and the port that exchanges them.

The messages are those of `lbr_fri_idl` (branch fri-1, FRI 1.11 to 1.16) with the values of FRI's enumerations. Field names and
types are those of the ROS package, so that type hash and CDR are equal.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from enum import IntEnum
from typing import Any

from rosbags.typesys import get_types_from_msg

from palpate_bus.messages import codec
from palpate_bus.wire.ros_node import RosNode
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_models.numerics.frames import Array
from palpate_models.scenario.schema import RobotDriver

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
NAMESPACE = "lbr"
"""Default of the stack's `robot_name`, which is also its namespace."""
DEFINITIONS = {STATE: _STATE, TORQUE_COMMAND: "float64[7] joint_position\nfloat64[7] torque\n"}


def register() -> None:
    """Register the messages with the codec; further calls do nothing."""
    if STATE in codec.store.types:
        return
    types: dict[str, Any] = {}
    for name, text in DEFINITIONS.items():
        types.update(get_types_from_msg(text, name))
    codec.store.register(types)


register()
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


class FriControlMode(IntEnum):
    """KUKA::FRI::EControlMode."""

    POSITION_CONTROL_MODE = 0
    CART_IMP_CONTROL_MODE = 1
    JOINT_IMP_CONTROL_MODE = 2
    NO_CONTROL = 3


WRENCH = "geometry_msgs/msg/WrenchStamped"
TOOL_STATE = "palpation_msgs/msg/ToolState"
LINKS = "tf2_msgs/msg/TFMessage"
CONTACT_TOPIC, TOOL_TOPIC, LINKS_TOPIC = "emulator/contact_wrench", "emulator/tool_state", "emulator/link_poses"


class LbrPort(ABC):
    """The driver's connection to the arm."""

    @abstractmethod
    def states(self) -> list[Any]:
        """Return LBRState messages since the last call, oldest first."""

    @abstractmethod
    def wrenches(self) -> list[Any]:
        """Return WrenchStamped messages of the F/T sensor since the last call, oldest first."""

    @abstractmethod
    def command(self, q: Array, torque: Array) -> None:
        """Send joint positions [rad] and torque overlay [N m], shapes (7,)."""

    @abstractmethod
    def rivals(self) -> list[bytes]:
        """Return the GIDs of other senders of commands since the last call, oldest first."""

    @abstractmethod
    def contact(self, wrench: Any) -> None:
        """Emulated: sends the tissue's wrench on the indenter."""

    @abstractmethod
    def physics(self) -> tuple[Any | None, Any | None]:
        """Emulated: return new ToolState and link poses."""

    @abstractmethod
    def close(self) -> None:
        """Disconnect from the ROS side."""


class ZenohPort(LbrPort):
    """Connection over zenoh, with the keys of rmw_zenoh."""

    def __init__(self, connection: RobotDriver) -> None:
        """Connect. Raises BusConfigError."""
        name = (connection.namespace or NAMESPACE).strip("/")
        self._node = RosNode("palpate_robot.backends.lbr", connection.domain, BusOptions(router=connection.router))
        self._states = self._node.subscription(f"{name}/state", STATE)
        self._wrenches = self._node.subscription(connection.ft_topic.strip("/"), WRENCH)
        self._command = self._node.publisher(f"{name}/command/torque", TORQUE_COMMAND)
        self._commands = self._node.subscription(f"{name}/command/torque", TORQUE_COMMAND)
        if connection.emulated:
            self._contact = self._node.publisher(CONTACT_TOPIC, WRENCH)
            self._tool = self._node.subscription(TOOL_TOPIC, TOOL_STATE)
            self._links = self._node.subscription(LINKS_TOPIC, LINKS)

    def states(self) -> list[Any]:
        """Return LBRState messages since the last call, oldest first."""
        return self._states.take()

    def wrenches(self) -> list[Any]:
        """Return WrenchStamped messages since the last call, oldest first."""
        return self._wrenches.take()

    def command(self, q: Array, torque: Array) -> None:
        """Send both; the stack's torque controller also needs a joint position, see docs/real-robot.md on its stiffness."""
        self._command.publish(LBRTorqueCommand(q, torque))

    def rivals(self) -> list[bytes]:
        """Return the GIDs of other senders; this process's own commands are left out."""
        return self._commands.others(self._command.gid)

    def contact(self, wrench: Any) -> None:
        """Send the tissue's wrench to the emulator."""
        self._contact.publish(wrench)

    def physics(self) -> tuple[Any | None, Any | None]:
        """Return new ToolState and link poses of the emulator."""
        return self._tool.newest(), self._links.newest()

    def close(self) -> None:
        """Disconnect from the ROS side."""
        self._node.close()
