"""Joint state from a stream of LBRState, and whether the arm accepts commands. Arrays in, arrays out."""

from typing import Any, Final

import numpy as np

from palpate_models.robot import lbr
from palpate_robot.backends.hardware import STATE_AGE_NS, MeasuredArm
from palpate_robot.backends.lbr.port import ClientCommandMode, ConnectionQuality, SafetyState, SessionState

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
