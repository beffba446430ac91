"""The driver's contract: which torque the joints get, and when the driver stops obeying and holds safely by itself.

A driver is IDLE until its first valid command, then ACTIVE. On an expired or invalid command, a lost commander, a
broken limit or a stop request it goes to SAFE_HOLD and stays there until released. IDLE and SAFE_HOLD carry gravity and
damp the joints, without any stiffness: tissue that is pressed pushes the arm away, so the force on it falls.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array
from palpate_models.robot import lbr

HOLD_DAMPING: Final = np.array([100.0, 100.0, 80.0, 80.0, 40.0, 40.0, 20.0])
"""Joint damping in a hold [N m s/rad] [A]: about 300 N s/m at the tool. Breathing at 8 mm/s against it adds less than 3 N."""
BRAKE: Final = 5.0
"""Times the damping while a hold begins [A]: a scan at 30 mm/s stops in 0.2 mm, before tissue that stiffens on the way pushes
noticeably harder."""
BRAKE_TICKS: Final = 100
"""How long that lasts [ms]: many times what stopping takes, and a small part of a breath."""
TORQUE_RATE: Final = 2.0
"""Largest change of a joint's command in a millisecond [N m]. libfranka ends a motion beyond 1, our controller keeps to 1 a tick.
A command that was damaged on its way rarely stays within it."""
FIRST_TORQUE: Final = 20.0
"""Largest first command of a joint [N m] [A]: the arm rests, and a set-point that lies where it is asks for next to nothing."""
VALIDITY: Final = 50_000_000
"""So long [ns] a command is obeyed at most, as in the contract, and counts the time since the one before."""
AHEAD: Final = 500_000_000
"""A command stamped so far ahead [ns] comes from a clock that is wrong: its expiry protects nobody. More than a driver can be
behind its own timer (`palpate_bus.runtime.wallclock.CATCH_UP`) and the command's validity: a busy machine is no wrong clock."""
_LIMITS: Final = tuple(
    zip(
        lbr.JOINT_NAMES,
        lbr.POSITION_LIMIT.tolist(),
        lbr.VELOCITY_LIMIT.tolist(),
        lbr.TORQUE_LIMIT.tolist(),
        strict=True,
    )
)
_ZERO: Final = np.zeros(7)
_ZERO.setflags(write=False)


class DriverMode(IntEnum):
    """Values of `palpation_msgs/RobotStatus.mode`."""

    IDLE = 0
    ACTIVE = 1
    SAFE_HOLD = 2


class HoldCause(IntEnum):
    """Values of `palpation_msgs/RobotStatus.cause`."""

    NONE = 0
    COMMAND_EXPIRED = 1
    COMMANDER_LOST = 2
    POSITION_LIMIT = 3
    VELOCITY_LIMIT = 4
    TORQUE_LIMIT = 5
    INVALID_COMMAND = 6
    FORCE_LIMIT = 7
    STOP_REQUESTED = 8
    DEVICE = 9
    """The arm, its controller, its sensor or the connection to them: of drivers of hardware."""


@dataclass(slots=True)
class Command:
    """Joint torques without gravity [N m], when they were sent [ns], and when they expire [ns]."""

    torque: Array
    """An array of its own memory, that nobody writes to."""
    stamp: int
    expires: int
    problem: str = ""
    """Why the commander gives up; empty while it commands."""


class Driver:
    """Decides what the joints get. All arrays are of shape (7,), order lbr_A1..lbr_A7."""

    def __init__(self, force_emergency_n: float) -> None:
        """`force_emergency_n` is the external force at the tool [N] above which the driver holds."""
        self._force_emergency = force_emergency_n
        self.mode = DriverMode.IDLE
        self.cause = HoldCause.NONE
        self.reason = ""
        self.rejected = 0
        """Invalid commands since start."""
        self.holds: list[tuple[int, HoldCause, str]] = []
        """Every safe hold so far: when [ns], cause, reason."""
        self._since = -1
        self._brake = 0
        self._judged: Command | None = None
        self._before: Array | None = None
        """The torques of the command judged last; None when none was obeyed since the driver was IDLE."""
        still = np.zeros(7)  # compiles what a tick calls
        _within(still, still, lbr.POSITION_LIMIT, lbr.VELOCITY_LIMIT)
        _obeyable(still, still, still, lbr.TORQUE_LIMIT, TORQUE_RATE)

    @property
    def held(self) -> bool:
        """Whether a safe hold is latched."""
        return self.mode is DriverMode.SAFE_HOLD

    def hold(self, t: int, cause: HoldCause, reason: str) -> None:
        """Latches a safe hold at `t` [ns]. The first cause stands until the release."""
        if not self.held:
            self.mode, self.cause, self.reason = DriverMode.SAFE_HOLD, cause, reason
            self._brake = BRAKE_TICKS
            self.holds.append((t, cause, reason))

    def release(self, t: int) -> None:
        """Leaves a safe hold at `t` [ns] for IDLE. Only commands sent after `t` count; a broken limit holds again."""
        if self.mode is DriverMode.SAFE_HOLD:
            self.mode, self.cause, self.reason = DriverMode.IDLE, HoldCause.NONE, ""
            self._since = t
            self._before = None

    def update(self, t: int, q: Array, v: Array, gravity: Array, force: float, command: Command | None, *, lost: bool) -> Array:
        """Joint torques at `t` [ns] without gravity [N m]; zero outside ACTIVE, where `damping` is to act instead.

        Takes measured positions [rad] and velocities [rad/s], the gravity torques [N m], the external force at the tool
        [N], the newest command, and whether the commander is known to be lost.
        """
        if self.held:
            return _ZERO
        if lost:
            self.hold(t, HoldCause.COMMANDER_LOST, "the service of role control, which commands, is gone")
        elif not force <= self._force_emergency:  # NaN, too
            limit = self._force_emergency
            self.hold(t, HoldCause.FORCE_LIMIT, f"external force {force:.1f} N at the tool, limit {limit:.1f} N")
        else:
            self._check_joints(t, q, v)
        if command is not None and not self.held:
            if command.stamp > self._since:
                self._take(t, command, gravity)
            elif self.mode is DriverMode.ACTIVE:  # it has not been judged, so it must not be obeyed
                age = (t - command.stamp) / 1e6
                self.hold(t, HoldCause.COMMAND_EXPIRED, f"the newest command of control is stamped {age:.0f} ms ago")
        return command.torque if command is not None and self.mode is DriverMode.ACTIVE else _ZERO

    def damping(self, v: Array, gravity: Array) -> Array:
        """Joint damping that the driver adds in this tick [N m s/rad]; in a hold as much as the torque limits leave room for."""
        if self.mode is DriverMode.ACTIVE:
            return _ZERO
        wanted = HOLD_DAMPING
        if self._brake:
            self._brake -= 1
            wanted = BRAKE * HOLD_DAMPING
        room = lbr.TORQUE_LIMIT - np.abs(gravity)
        return np.asarray(np.minimum(wanted, np.maximum(room, 0.0) / np.maximum(np.abs(v), 1e-9)))

    def _check_joints(self, t: int, q: Array, v: Array) -> None:
        if _within(q, v, lbr.POSITION_LIMIT, lbr.VELOCITY_LIMIT):
            return
        for (joint, q_max, v_max, _), q_i, v_i in zip(_LIMITS, q.tolist(), v.tolist(), strict=True):
            if not -q_max <= q_i <= q_max:
                self.hold(t, HoldCause.POSITION_LIMIT, f"{joint} at {q_i:.4f} rad, limit +-{q_max:.4f} rad")
            elif not -v_max <= v_i <= v_max:
                self.hold(t, HoldCause.VELOCITY_LIMIT, f"{joint} at {v_i:.3f} rad/s, limit +-{v_max:.3f} rad/s")

    def _take(self, t: int, command: Command, gravity: Array) -> None:
        """Judges a command: obey it, ignore it (already expired while IDLE), or hold."""
        given_up = command.expires <= command.stamp  # however far its sender's clock is ahead of ours
        expires = min(command.expires, command.stamp + VALIDITY)
        if given_up or t > expires:
            if self.mode is DriverMode.ACTIVE:
                late = max(t - expires, 0) / 1e6
                words = f"the last command of control expired {late:.0f} ms ago, none came after it"
                self.hold(t, HoldCause.COMMAND_EXPIRED, f"control gives up: {command.problem}" if command.problem else words)
            return
        if command is not self._judged:
            self._judge(t, command, gravity)
            self._judged = command
        if self.mode is DriverMode.IDLE:
            self.mode = DriverMode.ACTIVE

    def _judge(self, t: int, command: Command, gravity: Array) -> None:
        shape = np.shape(command.torque)
        if shape != (7,):
            self._reject(t, HoldCause.INVALID_COMMAND, f"control commands torques of shape {shape}, want (7,)")
            return
        if command.stamp > t + AHEAD:
            self._reject(t, HoldCause.INVALID_COMMAND, f"control stamps its command {(command.stamp - t) / 1e6:.0f} ms ahead")
            return
        first = self._before is None
        before = _ZERO if self._before is None else self._before
        apart = 1.0
        if self._judged is not None:
            apart = min(max((command.stamp - self._judged.stamp) / 1e6, 1.0), VALIDITY / 1e6)
        change = FIRST_TORQUE if first else TORQUE_RATE * apart
        if not _obeyable(command.torque, gravity, before, lbr.TORQUE_LIMIT, change):
            numbers = (command.torque.tolist(), before.tolist(), gravity.tolist())
            for (joint, _, _, limit), torque, last, weight in zip(_LIMITS, *numbers, strict=True):
                if torque - torque != 0.0:  # NaN or infinite
                    self._reject(t, HoldCause.INVALID_COMMAND, f"control commands {joint} {torque} N m, want a finite torque")
                    return
                if not -limit <= torque + weight <= limit:
                    text = f"control commands {joint} {torque:.1f} N m plus {weight:.1f} N m of gravity, limit +-{limit:.0f} N m"
                    self._reject(t, HoldCause.TORQUE_LIMIT, text)
                    return
                if not -change <= torque - last <= change:
                    after, rate = f"after {last:.1f} N m, {apart:.0f} ms apart", f"{TORQUE_RATE:g} N m/ms"
                    how, most = ("to begin with", f"{FIRST_TORQUE:g} N m") if first else (after, rate)
                    self._reject(t, HoldCause.INVALID_COMMAND, f"control commands {joint} {torque:.1f} N m {how}, limit {most}")
                    return
        self._before = command.torque

    def _reject(self, t: int, cause: HoldCause, reason: str) -> None:
        self.rejected += 1
        self.hold(t, cause, reason)


@compiled
def _within(q: Array, v: Array, position_limit: Array, velocity_limit: Array) -> bool:
    """Whether positions and velocities, shapes (7,), are numbers and at most their limits in size."""
    return bool(np.all(np.abs(q) <= position_limit) and np.all(np.abs(v) <= velocity_limit))


@compiled
def _obeyable(torque: Array, gravity: Array, before: Array, limit: Array, change: float) -> bool:
    """Whether a command (7,), gravity added, is within its limit and no more than `change` away from the one before [N m]."""
    return bool(np.all(np.abs(torque + gravity) <= limit) and np.all(np.abs(torque - before) <= change))
