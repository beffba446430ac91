"""Connections between a driver and the ROS side of its arm."""

from typing import Any, Final, Protocol

from palpate_bus.wire.ros_node import RosNode
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_models.numerics.frames import Array
from palpate_models.scenario.schema import RobotDriver

WRENCH: Final = "geometry_msgs/msg/WrenchStamped"
TOOL_STATE: Final = "palpation_msgs/msg/ToolState"
LINKS: Final = "tf2_msgs/msg/TFMessage"
CONTACT_TOPIC: Final = "emulator/contact_wrench"
"""Topic of the tissue's wrench on the indenter of an emulated arm."""
TOOL_TOPIC: Final = "emulator/tool_state"
LINKS_TOPIC: Final = "emulator/link_poses"


class ArmPort(Protocol):
    """The driver's connection to the arm."""

    def states(self) -> list[Any]:
        """Return the arm's states since the last call, oldest first."""

    def wrenches(self) -> list[Any]:
        """Return WrenchStamped messages of the F/T sensor since the last call, oldest first."""

    def command(self, q: Array, values: Array) -> None:
        """Send a command, at measured joint positions `q` [rad]; `values`, shape (n,), are torques [N m] or positions [rad]."""

    def rivals(self) -> list[bytes]:
        """Return the GIDs of other senders of commands since the last call, oldest first."""
        return []

    def contact(self, wrench: Any) -> None:
        """Emulated: sends the tissue's wrench on the indenter."""

    def physics(self) -> tuple[Any | None, Any | None]:
        """Emulated: return new ToolState and link poses."""

    def close(self) -> None:
        """Disconnect from the ROS side."""


class ZenohArmPort(ArmPort):
    """Connection over zenoh, with the keys of rmw_zenoh. Subclasses send the commands."""

    def __init__(self, name: str, given: RobotDriver, state: tuple[str, str], command: tuple[str, str], ft_topic: str) -> None:
        """Connect as node `name`; `state` and `command` are topics with their types. Raises BusConfigError."""
        self._node = RosNode(name, given.domain, BusOptions(router=given.router))
        self._states = self._node.subscription(*state)
        self._wrenches = self._node.subscription(ft_topic.strip("/"), WRENCH)
        self._command = self._node.publisher(*command)
        self._commands = self._node.subscription(*command)
        if given.emulated:
            self._contact = self._node.publisher(CONTACT_TOPIC, WRENCH)
            self._tool = self._node.subscription(TOOL_TOPIC, TOOL_STATE)
            self._links = self._node.subscription(LINKS_TOPIC, LINKS)

    def states(self) -> list[Any]:
        """See `ArmPort.states`."""
        return self._states.take()

    def wrenches(self) -> list[Any]:
        """See `ArmPort.wrenches`."""
        return self._wrenches.take()

    def rivals(self) -> list[bytes]:
        """See `ArmPort.rivals`."""
        return self._commands.others(self._command.gid)

    def contact(self, wrench: Any) -> None:
        """See `ArmPort.contact`."""
        self._contact.publish(wrench)

    def physics(self) -> tuple[Any | None, Any | None]:
        """See `ArmPort.physics`."""
        return self._tool.newest(), self._links.newest()

    def close(self) -> None:
        """See `ArmPort.close`."""
        self._node.close()
