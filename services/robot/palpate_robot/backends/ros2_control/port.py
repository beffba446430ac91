"""The driver's connection to a ros2_control system, and the joint state from its messages."""

from typing import Any, NamedTuple

import numpy as np

from palpate_bus.messages import codec, header, nanoseconds
from palpate_bus.messages.geometry import pose_message
from palpate_errors import UserError
from palpate_models.numerics.frames import Array, rigid
from palpate_models.robot.arm import TOOL, arm_of, base_pose, tool_pose
from palpate_models.robot.chain import Arm
from palpate_models.scenario.schema import CommandLevel, Robot
from palpate_robot.backends.arm_port import ArmPort, ZenohArmPort
from palpate_robot.backends.hardware import STATE_AGE_NS, MeasuredArm
from palpate_robot.backends.ros2_control.profile import Profile

STATE = "sensor_msgs/msg/JointState"
ARRAY = "std_msgs/msg/Float64MultiArray"
POSE = "geometry_msgs/msg/PoseStamped"
FLOAT, BOOL = "std_msgs/msg/Float64", "std_msgs/msg/Bool"


class StackStatus(NamedTuple):
    """Status of a stack besides its joint states; None where nothing new came."""

    speed: float | None = None
    """Execution speed, 1 for all of it."""
    running: bool | None = None
    """False while the arm takes no commands."""


class Ros2Port(ArmPort):
    """A port that also gives the status of the stack, and takes poses."""

    def status(self) -> StackStatus:
        """Return what is new since the last call."""
        return StackStatus()

    def pose(self, X_BU: Array) -> None:
        """Send the desired pose of the URDF's flange in the arm's base, shape (4, 4), to a Cartesian controller of the stack.

        Raises UserError where the stack has none.
        """
        raise UserError("robot.level: this stack takes no set-points; expected torque or position")


def array_message(values: Array) -> Any:
    """Return a std_msgs/Float64MultiArray as `ros2 topic pub` makes it."""
    layout = codec.message_type("std_msgs/msg/MultiArrayLayout")
    return codec.message_type(ARRAY)(layout(dim=[], data_offset=0), values)


class FlangePose:
    """Poses of the URDF's flange in the arm's base, as a Cartesian controller takes them, shape (4, 4)."""

    def __init__(self, robot: Robot) -> None:
        arm, turned = arm_of(robot), base_pose(robot)
        if arm.R_BL is not None:
            turned[:3, :3] = turned[:3, :3] @ arm.R_BL.T
        R_FU = np.eye(3) if arm.R_FU is None else arm.R_FU
        self._robot, self._X_BW = robot, np.linalg.inv(turned)
        self._X_IU = rigid(R_FU, (0.0, 0.0, -TOOL.flange_to_ft_m - TOOL.ft_to_indenter_m))

    def of(self, X_WI: Array) -> Array:
        """Return the pose for that of the indenter in world."""
        return np.asarray(self._X_BW @ X_WI @ self._X_IU)

    def at(self, q: Array) -> Array:
        """Return the pose at joint positions `q` [rad], shape (n,)."""
        return self.of(tool_pose(q, self._robot))


def pose_command(X_BU: Array, base: str) -> Any:
    """Return a geometry_msgs/PoseStamped in the frame `base`."""
    return codec.message_type(POSE)(header(0, base), pose_message(X_BU[:3, :3], X_BU[:3, 3]))


class ZenohRos2Port(ZenohArmPort, Ros2Port):
    """Connection over zenoh, with the keys of rmw_zenoh."""

    def __init__(self, robot: Robot, profile: Profile) -> None:
        """Connect. Raises BusConfigError, and UserError if the profile has no controller of the arm's level."""
        self._base = next(iter(arm_of(robot).link_names))
        command = profile.commands(robot.level), POSE if robot.level is CommandLevel.SETPOINT else ARRAY
        state = profile.topic(profile.joint_states), STATE
        super().__init__("palpate_ros2_control", robot.driver, state, command, profile.topic(profile.ft_topic))
        speed, running = profile.speed_scaling, profile.program_running
        self._speed = None if speed is None else self._node.subscription(profile.topic(speed), FLOAT)
        self._running = None if running is None else self._node.subscription(profile.topic(running), BOOL, latched=True)

    def command(self, q: Array, values: Array) -> None:
        """Send torques or positions, in the order of the arm's joints."""
        self._command.publish(array_message(values))

    def pose(self, X_BU: Array) -> None:
        """See `Ros2Port.pose`."""
        self._command.publish(pose_command(X_BU, self._base))

    def status(self) -> StackStatus:
        """See `Ros2Port.status`."""
        speed = None if self._speed is None else self._speed.newest()
        running = None if self._running is None else self._running.newest()
        return StackStatus(None if speed is None else speed.data / 100, None if running is None else bool(running.data))


FULL_SPEED = 0.99
"""Execution speed below which the arm does not follow as commanded."""


class MeasuredJoints(MeasuredArm):
    """Joint state by names, whatever their order and whatever else is in the message."""

    def __init__(self, arm: Arm, *, effort_is_torque: bool) -> None:
        super().__init__(arm.joints)
        self._arm, self._torques = arm, effort_is_torque
        if not effort_is_torque:
            self.torque = np.zeros(0)
        self._names: list[str] = []
        self._order: list[int] = []
        self._stamp = -1
        self._status = StackStatus(1.0, running=True)
        self._fault: str | None = "no joint states received yet"

    @property
    def accepts(self) -> bool:
        """False also while the external control program does not run."""
        return super().accepts and bool(self._status.running)

    def report(self, status: StackStatus) -> None:
        """Take what is new in the status of the stack."""
        speed, running = self._status
        self._status = StackStatus(
            speed if status.speed is None else status.speed, running if status.running is None else status.running
        )

    def update(self, t: int, state: Any) -> bool:
        """Take a JointState received at `t` [ns]; return True if it is new and usable."""
        stamp = nanoseconds(state.header.stamp)
        if stamp <= self._stamp < stamp + 1_000_000_000:
            return False  # overtaken, or sent again
        names = list(state.name)
        if names != self._names:
            missing = [name for name in self._arm.joint_names if name not in names]
            if missing:
                self._fault = f"joint states: no {', '.join(missing)} among {', '.join(names)}"
                return False
            self._names, self._order = names, [names.index(name) for name in self._arm.joint_names]
        try:
            q, v = self._in_order(state.position), self._in_order(state.velocity)
            torque = self._in_order(state.effort) if self._torques else self.torque
        except IndexError:
            self._fault = "joint states: expected a position, a velocity and an effort of each joint"
            return False
        if not np.isfinite(np.concatenate((q, v, torque))).all():
            self._fault = f"joint states: position = {q}, velocity = {v}, effort = {torque}: must be finite"
            return False
        self.q, self.v, self.torque = q, v, torque
        self.received, self._stamp, self._fault = t, stamp, None
        return True

    def _in_order(self, values: Any) -> Array:
        return np.array(values, dtype=float)[self._order]

    def fault(self, t: int) -> str | None:
        """Return None if the arm accepts commands at `t` [ns], else a message that says why not."""
        if self.received is not None and t - self.received > STATE_AGE_NS:
            return f"no joint states for {(t - self.received) / 1e6:.0f} ms: the controller manager or its connection has ended"
        if not self._status.running:
            return "the external control program does not run: press play on the pendant, or enable remote control"
        if self._status.speed is not None and self._status.speed < FULL_SPEED:
            return f"the arm's speed is scaled to {100 * self._status.speed:.0f} %: set the pendant's slider to 100 %"
        return self._fault
