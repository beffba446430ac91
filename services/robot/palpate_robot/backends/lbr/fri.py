"""The rules of KUKA's Fast Robot Interface and of the stack's command handling, as an emulator has to keep them. No transport.

What is modelled, and where it stands in lbr_fri_ros2_stack (rolling) and in KUKA's FRI manual:

- the send period is a whole number of milliseconds, 1 to 100;
- the session goes IDLE, MONITORING_WAIT, MONITORING_READY, COMMANDING_WAIT, COMMANDING_ACTIVE, and leaves the last for good:
  the stack then ends ("LBR left COMMANDING_ACTIVE", system_interface.cpp);
- only in COMMANDING_ACTIVE are commands taken; the last one is kept for ever (lbr_torque_command_controller.cpp has no time-out);
- a NaN in the command means "position as measured, no torque" (torque_command.cpp);
- the command guard ends the session when the commanded position leaves the joint's limits or the measured speed is above the
  joint's; it does not look at torques (command_guard.cpp: `is_valid_command`);
- the joint position that reaches the arm is the old one plus `pid_p` times what is missing (filters.cpp, `JointPIDArray`);
- the controller itself ends the session when overlay and gravity are above a joint's torque limit, or when the client does not
  answer: connection quality falls from EXCELLENT to POOR, at which commanding ends.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_models.robot import lbr
from palpate_robot.backends.lbr.idl import ConnectionQuality, SessionState

PERIODS_MS: Final = range(1, 101)
MONITORING_S: Final = 0.2
"""In each of the monitoring states [A]; on the arm it lasts until the Sunrise application goes on."""
SYNC_S: Final = 0.1
"""In COMMANDING_WAIT [A]."""
QUALITY_WINDOW: Final = 100
"""Answers over which connection quality is judged."""
QUALITY: Final = ((0.02, ConnectionQuality.EXCELLENT), (0.10, ConnectionQuality.GOOD), (0.30, ConnectionQuality.FAIR))
"""Share of lost answers up to which the quality holds [A]; beyond it is POOR."""


@dataclass(frozen=True, slots=True)
class Drive:
    """What the arm's controller applies in a cycle."""

    position: Array
    """Commanded joint position [rad], shape (7,): the spring's other end where the controller has stiffness."""
    torque: Array
    """Overlay [N m], shape (7,)."""


class FriSession:
    """One FRI session with the stack behind it."""

    def __init__(self, period_ms: int, q: Array, *, pid_p: float = 0.1, command_timeout_ms: int = 0) -> None:
        """`command_timeout_ms`: a time-out on commands, as a site may add one; 0 for none, as in the stack.

        Raises ValueError for a period that FRI does not have.
        """
        if period_ms not in PERIODS_MS:
            raise ValueError(f"send period {period_ms} ms: FRI takes whole milliseconds from {PERIODS_MS[0]} to {PERIODS_MS[-1]}")
        self._dt = period_ms * 1e-3
        self._pid_p = pid_p
        self._timeout = command_timeout_ms * 1e-3
        self.state = SessionState.IDLE
        self.quality = ConnectionQuality.POOR
        self.ended = ""
        """Why the session is over; empty while it is not."""
        self._in_state = 0.0
        self._answers: deque[bool] = deque(maxlen=QUALITY_WINDOW)
        self._target = Drive(q.copy(), np.zeros(7))
        self._position = q.copy()
        self._since_command: float | None = None
        self._q_before: Array | None = None

    def _enter(self, state: SessionState) -> None:
        self.state, self._in_state = state, 0.0

    def end(self, why: str) -> None:
        """Ends the session."""
        if not self.ended:
            self.ended = why
            self._enter(SessionState.IDLE)

    def take(self, position: Array, torque: Array) -> None:
        """A command of the client: joint positions [rad], overlay [N m], shapes (7,). Passed over unless COMMANDING_ACTIVE."""
        if self.state is SessionState.COMMANDING_ACTIVE:
            self._target = Drive(position, torque)
            self._since_command = 0.0

    def cycle(self, q: Array, gravity: Array, *, answered: bool = True) -> Drive:
        """One send period at measured positions q [rad] and gravity torques [N m]; what the arm's controller applies."""
        self._in_state += self._dt
        self._answers.append(answered)
        lost = 1.0 - sum(self._answers) / len(self._answers)
        self.quality = next((quality for share, quality in QUALITY if lost <= share), ConnectionQuality.POOR)
        if not self.ended:
            self._advance(q)
        if self.state is not SessionState.COMMANDING_ACTIVE:
            return Drive(q, np.zeros(7))
        return self._apply(q, gravity)

    def _advance(self, q: Array) -> None:
        state = self.state
        if state is SessionState.IDLE:
            self._enter(SessionState.MONITORING_WAIT)
        elif state is SessionState.MONITORING_WAIT and self._in_state > MONITORING_S and self.quality >= ConnectionQuality.GOOD:
            self._enter(SessionState.MONITORING_READY)
        elif state is SessionState.MONITORING_READY and self._in_state > MONITORING_S:
            self._enter(SessionState.COMMANDING_WAIT)
        elif state is SessionState.COMMANDING_WAIT and self._in_state > SYNC_S:
            self._enter(SessionState.COMMANDING_ACTIVE)
            self._target, self._position = Drive(q.copy(), np.zeros(7)), q.copy()
            self._since_command = None
        elif state >= SessionState.COMMANDING_WAIT and self.quality is ConnectionQuality.POOR:
            self.end("connection quality is POOR: the client does not answer in time")

    def _apply(self, q: Array, gravity: Array) -> Drive:
        if self._since_command is not None:
            self._since_command += self._dt
            if 0.0 < self._timeout < self._since_command:
                self.end(f"no command for {self._since_command * 1e3:.0f} ms, time-out {self._timeout * 1e3:.0f} ms")
        if not (np.isfinite(self._target.position).all() and np.isfinite(self._target.torque).all()):
            self._target, self._position = Drive(q.copy(), np.zeros(7)), q.copy()
        self._position = self._position + self._pid_p * (self._target.position - q)
        self._guard(q, gravity)
        return Drive(q, np.zeros(7)) if self.ended else Drive(self._position, self._target.torque)

    def _guard(self, q: Array, gravity: Array) -> None:
        speed = np.zeros(7) if self._q_before is None else np.abs(q - self._q_before) / self._dt
        self._q_before = q.copy()
        for i, joint in enumerate(lbr.JOINT_NAMES):
            if abs(self._position[i]) > lbr.POSITION_LIMIT[i]:
                self.end(f"command guard: position of {joint} commanded to {self._position[i]:.3f} rad")
            elif speed[i] > lbr.VELOCITY_LIMIT[i]:
                self.end(f"command guard: {joint} moves at {speed[i]:.2f} rad/s, limit {lbr.VELOCITY_LIMIT[i]:.2f} rad/s")
            elif abs(self._target.torque[i] + gravity[i]) > lbr.TORQUE_LIMIT[i]:
                self.end(
                    f"controller: {joint} at {self._target.torque[i] + gravity[i]:.0f} N m, limit {lbr.TORQUE_LIMIT[i]:.0f} N m"
                )
