"""Joint state from sensor_msgs/JointState, and whether the arm accepts commands. Arrays in, arrays out."""

from typing import Any

import numpy as np

from palpate_bus.messages import nanoseconds
from palpate_models.numerics.frames import Array
from palpate_models.robot.chain import Arm
from palpate_robot.backends.hardware import STATE_AGE_NS, MeasuredArm
from palpate_robot.backends.ros2_control.port import StackStatus

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
