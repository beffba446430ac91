"""What the driver exchanges with the ROS side: the stack's topics, the F/T sensor's, and the emulator's."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from palpate_bus.wire.ros_node import RosNode
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_models.numerics.frames import Array
from palpate_models.scenario.schema import LbrConnection
from palpate_robot.backends.lbr.idl import STATE, TORQUE_COMMAND, LBRTorqueCommand

WRENCH = "geometry_msgs/msg/WrenchStamped"
TOOL_STATE = "palpation_msgs/msg/ToolState"
LINKS = "tf2_msgs/msg/TFMessage"
CONTACT_TOPIC, TOOL_TOPIC, LINKS_TOPIC = "emulator/contact_wrench", "emulator/tool_state", "emulator/link_poses"


class LbrPort(ABC):
    """The driver's view of the arm."""

    @abstractmethod
    def states(self) -> list[Any]:
        """LBRState since last time, oldest first."""

    @abstractmethod
    def wrenches(self) -> list[Any]:
        """WrenchStamped of the F/T sensor since last time, oldest first."""

    @abstractmethod
    def command(self, q: Array, torque: Array) -> None:
        """Joint positions [rad] and torque overlay [N m], shapes (7,)."""

    @abstractmethod
    def rivals(self) -> list[bytes]:
        """GIDs of others who commanded the arm since last time, oldest first."""

    @abstractmethod
    def contact(self, wrench: Any) -> None:
        """Emulated: the tissue's wrench on the indenter."""

    @abstractmethod
    def physics(self) -> tuple[Any | None, Any | None]:
        """Emulated: new ToolState and link poses."""

    @abstractmethod
    def close(self) -> None:
        """Leaves the ROS side."""


class ZenohPort(LbrPort):
    """Over zenoh, as rmw_zenoh does."""

    def __init__(self, connection: LbrConnection) -> None:
        """Joins. Raises BusConfigError."""
        name = connection.namespace.strip("/")
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
        """LBRState since last time, oldest first."""
        return self._states.take()

    def wrenches(self) -> list[Any]:
        """WrenchStamped since last time, oldest first."""
        return self._wrenches.take()

    def command(self, q: Array, torque: Array) -> None:
        """The stack's torque controller wants a joint position as well; see docs/real-robot.md on its stiffness."""
        self._command.publish(LBRTorqueCommand(q, torque))

    def rivals(self) -> list[bytes]:
        """Everyone's commands come back, also this process's: those are left out."""
        return self._commands.others(self._command.gid)

    def contact(self, wrench: Any) -> None:
        """To the emulator."""
        self._contact.publish(wrench)

    def physics(self) -> tuple[Any | None, Any | None]:
        """From the emulator."""
        return self._tool.newest(), self._links.newest()

    def close(self) -> None:
        """Leaves the ROS side."""
        self._node.close()
