"""Set-point of the impedance controller, as created by planning and followed by the control law."""

from enum import IntEnum
from typing import NamedTuple

from palpate_bus.contract import contract
from palpate_bus.messages import ImpedanceSetpoint, duration_message, header, nanoseconds
from palpate_bus.messages.geometry import Array, pose_message, rotation, twist, twist_message, vector, wrench, wrench_message

TOPIC = "planning/setpoint"


class ControlMode(IntEnum):
    """Modes of `palpation_msgs/ImpedanceSetpoint`."""

    CARTESIAN = 0
    JOINT = 1


class Setpoint(NamedTuple):
    """Desired motion of the arm at one time. Control extrapolates it with `V_WD` and `qd`.

    D is the desired frame of the indenter, W is world. The contract's row of `planning/setpoint` limits the values.
    """

    stamp: int
    """Time of pose and joint position [ns]."""
    mode: ControlMode
    R_WD: Array
    """Desired rotation of the indenter, shape (3, 3)."""
    p_WD: Array
    """Desired origin of the indenter [m], shape (3,)."""
    V_WD: Array
    """Desired twist in world axes, linear [m/s] then angular [rad/s], shape (6,)."""
    F_W: Array
    """Feed-forward wrench of the indenter on the environment at D's origin, force [N] then torque [N m], world axes, shape (6,).
    The tissue's `F_W` is the wrench on the indenter."""
    stiffness: Array
    """Stiffness in axes of D: translation [N/m], rotation [N m/rad], shape (6,)."""
    damping_ratio: Array
    """Damping ratio in axes of D [1], shape (6,)."""
    q: Array
    """JOINT: target; CARTESIAN: null-space posture [rad], shape (n,)."""
    qd: Array
    """Velocity of `q` [rad/s], shape (n,)."""
    joint_stiffness: Array
    """JOINT: joint stiffness; CARTESIAN: null-space stiffness [N m/rad], shape (n,)."""

    def message(self) -> ImpedanceSetpoint:
        """Return the `ImpedanceSetpoint`, valid until the contract's expiry."""
        return ImpedanceSetpoint(
            header=header(self.stamp, "world"),
            mode=int(self.mode),
            pose=pose_message(self.R_WD, self.p_WD),
            twist=twist_message(self.V_WD),
            wrench=wrench_message(self.F_W),
            stiffness=self.stiffness,
            damping_ratio=self.damping_ratio,
            joint_position=self.q,
            joint_velocity=self.qd,
            joint_stiffness=self.joint_stiffness,
            valid_for=duration_message(contract().topics[TOPIC].expiry),
        )

    @classmethod
    def from_message(cls, message: ImpedanceSetpoint) -> "Setpoint":
        """Return the set-point in a message, which the port has checked."""
        return cls(
            stamp=nanoseconds(message.header.stamp),
            mode=ControlMode(message.mode),
            R_WD=rotation(message.pose.orientation),
            p_WD=vector(message.pose.position),
            V_WD=twist(message.twist),
            F_W=wrench(message.wrench),
            stiffness=message.stiffness,
            damping_ratio=message.damping_ratio,
            q=message.joint_position,
            qd=message.joint_velocity,
            joint_stiffness=message.joint_stiffness,
        )
