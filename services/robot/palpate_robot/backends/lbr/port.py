"""Messages between the driver and the ROS side, the port that exchanges them, and the joint state from them.

The messages are those of `lbr_fri_idl` (branch fri-1, FRI 1.11 to 1.16) with the values of FRI's enumerations. Field names and
types are those of the ROS package, so that type hash and CDR are equal.
"""

from enum import IntEnum
from typing import Any, Final

import numpy as np
from rosbags.typesys import get_types_from_msg

from palpate_bus.messages import codec
from palpate_models.numerics.frames import Array
from palpate_models.robot import lbr
from palpate_models.scenario.schema import RobotDriver
from palpate_robot.backends.arm_port import ZenohArmPort
from palpate_robot.backends.hardware import STATE_AGE_NS, MeasuredArm

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


VELOCITY_LAG_S: Final = 0.004
"""Time constant of the low-pass on the differentiated position: LBRState carries no velocity. It keeps the encoder's steps
(about 1e-5 rad) below 3 mrad/s at 500 Hz and costs the damping 4 ms."""
CLOCK_SET_NS: Final = 1_000_000_000
"""A stamp older than the newest by this much means that the controller's clock was set back; otherwise the state was
overtaken."""


class MeasuredLbr(MeasuredArm):
    """Joint state from a stream of LBRState."""

    def __init__(self) -> None:
        super().__init__(len(lbr.HOME))
        self.session = SessionState.IDLE
        self._stamp: int | None = None
        self._fault: str | None = "no LBRState received yet"

    @property
    def accepts(self) -> bool:
        """True while the session commands."""
        return self.session is SessionState.COMMANDING_ACTIVE

    def update(self, t: int, state: Any) -> bool:
        """Take a state received at `t` [ns]; return True if it is new and usable.

        Velocities restart from zero after the controller's clock was set.
        """
        q = np.array(state.measured_joint_position)
        stamp = int(state.time_stamp_sec) * 1_000_000_000 + int(state.time_stamp_nano_sec)
        torque = np.array(state.measured_torque)
        if not np.isfinite((q, torque)).all():
            self._fault = f"LBRState: measured_joint_position = {q}, measured_torque = {torque}: must be finite"
            return False
        if self._stamp is not None and 0 <= self._stamp - stamp < CLOCK_SET_NS:
            return False
        dt = 0.0 if self._stamp is None else (stamp - self._stamp) * 1e-9
        if 0.0 < dt < 0.1:
            self.v = self.v + dt / (VELOCITY_LAG_S + dt) * ((q - self.q) / dt - self.v)
        else:
            self.v = np.zeros(lbr.HOME.shape)
        self.q, self.torque, self._stamp, self.received = q, torque, stamp, t
        try:
            self.session, self._fault = SessionState(state.session_state), _fault(state)
        except ValueError as error:  # not a value of FRI
            self.session, self._fault = SessionState.IDLE, f"LBRState: {error}"
        return True

    def fault(self, t: int) -> str | None:
        """Return None if the arm accepts commands at `t` [ns], else a message that says why not."""
        if self.received is not None and t - self.received > STATE_AGE_NS:
            return f"no LBRState for {(t - self.received) / 1e6:.0f} ms: the FRI session or the ROS side has ended"
        return self._fault


def _fault(state: Any) -> str | None:
    if state.safety_state != SafetyState.NORMAL_OPERATION:
        return f"the arm's safety state is {SafetyState(state.safety_state).name}"
    if state.session_state != SessionState.COMMANDING_ACTIVE:
        return f"the FRI session is in {SessionState(state.session_state).name}, not COMMANDING_ACTIVE"
    if state.connection_quality <= ConnectionQuality.POOR:
        return "the FRI connection is POOR"
    if state.client_command_mode != ClientCommandMode.TORQUE:
        mode = ClientCommandMode(state.client_command_mode).name
        return f"the client command mode is {mode}: set client_command_mode: torque in lbr_system_config.yaml"
    return None
