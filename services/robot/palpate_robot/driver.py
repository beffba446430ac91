"""Driver: chooses the joint torque or position, and enters a safe hold when commands, limits or requests demand it.

A driver is IDLE until its first valid command, then ACTIVE. On an expired or invalid command, a lost commander, a violated limit
or a stop request it enters SAFE_HOLD and stays there until released. IDLE and SAFE_HOLD compensate gravity and damp the joints,
without stiffness: pressed tissue pushes the arm away, so the force falls. An arm that takes positions stops and stays where it
is.
"""

from typing import Any, Final, NamedTuple

import numpy as np

from palpate_bus.messages.codes import DriverMode, HoldCause
from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array, frozen
from palpate_models.robot.chain import Arm


class DriverTuning(NamedTuple):
    """Limits on commands, and the braking phase of a hold."""

    brake_factor: float = 5.0
    """Factor on the damping at the start of a hold (assumed): a scan at 30 mm/s stops in 0.2 mm, before stiffening tissue adds
    force."""
    brake_ticks: int = 100
    """Duration of that phase [ms]: much longer than stopping takes, and a small part of a breath."""
    torque_rate_nm_per_ms: float = 2.0
    """Maximum change of a joint command. libfranka aborts beyond 1; our controller keeps to 1. A corrupted command rarely
    passes."""
    position_jump_rad: float = 0.02
    """Maximum change of a joint position command beyond that at the speed limit, and largest distance of the first one from the
    measured position (assumed)."""
    first_torque_nm: float = 20.0
    """Maximum first command per joint (assumed): the arm is at rest, and a set-point at its position needs almost no torque."""
    further_n: float = 3.0
    """Rise of a force above its limit, after a release of an arm that takes positions, that holds it again."""
    validity_ns: int = 50_000_000
    """Longest validity of a command, as in the contract, and longest interval counted since the previous one."""
    ahead_ns: int = 500_000_000
    """A command stamped further ahead comes from a wrong clock, so its expiry is meaningless. Larger than the lag of a driver
    behind its own timer (`palpate_bus.runtime.wallclock.TIMES`) plus the validity."""


TUNING: Final = DriverTuning()
_COMMAND: Final = "control/joint_torque"


class Command(NamedTuple):
    """Joint torques without gravity [N m] or joint positions [rad], their stamp [ns] and expiry [ns]."""

    values: Array
    """Owned by the command and never written to."""
    stamp: int
    expires: int
    problem: str = ""
    """Text of the commander's reason to stop commanding; for messages only."""
    culprit: str = ""
    """Topic that causes the problem."""


class Driver:
    """Chooses joint torques and damping, or joint positions. All arrays have shape (n,), from the base to the flange."""

    def __init__(self, arm: Arm, force_emergency_n: float, *, positions: bool = False) -> None:
        """`force_emergency_n`: force at the tool [N] above which the driver holds; `positions`: commands are positions."""
        self._arm, self._positions = arm, positions
        self._still = frozen(np.zeros(arm.joints))
        self._force_emergency = self._force_limit = force_emergency_n
        self.mode = DriverMode.IDLE
        self.cause = HoldCause.NONE
        self.reason = self.culprit = ""
        self.rejected = 0
        self.holds: list[tuple[int, HoldCause, str]] = []
        """All safe holds: time [ns], cause, reason."""
        self._since = -1
        self._brake = 0
        self._checked: Command | None = None
        self._before: Array | None = None
        """Values of the last checked command; None if no command was accepted since the driver was IDLE."""
        still = np.zeros(arm.joints)  # compiles the functions of a tick
        _is_within(still, still, arm.lower_rad, arm.upper_rad, arm.velocity_radps)
        _is_acceptable(still, still, still, arm.torque_nm, TUNING.torque_rate_nm_per_ms)

    @property
    def held(self) -> bool:
        """True while a safe hold is latched."""
        return self.mode is DriverMode.SAFE_HOLD

    def hold(self, t: int, cause: HoldCause, reason: str, culprit: str = "") -> None:
        """Latch a safe hold at `t` [ns]. The first cause is kept until the release, unless an operator requests a stop.

        `culprit`: role or topic at fault.
        """
        if not self.held or cause is HoldCause.STOP_REQUESTED:
            self.mode, self.cause, self.reason, self.culprit = DriverMode.SAFE_HOLD, cause, reason, culprit
            self._brake = TUNING.brake_ticks
            self.holds.append((t, cause, reason))

    def release(self, t: int) -> None:
        """Leave a safe hold at `t` [ns] for IDLE. Only commands sent after `t` count; a violated limit holds again.

        Positions do not yield in a hold, so a force above its limit may stay after the release: it must only not rise.
        """
        if self.mode is DriverMode.SAFE_HOLD:
            self.mode, self.cause, self.reason, self.culprit = DriverMode.IDLE, HoldCause.NONE, "", ""
            self._since = t
            self._before = None
            if self._positions:
                self._force_limit = np.inf  # until the next force

    def facts(self) -> dict[str, Any]:
        """Return mode, safe holds and the number of rejected commands, for the report."""
        holds = [{"t_s": t / 1e9, "cause": cause.name, "reason": reason} for t, cause, reason in self.holds]
        return {"mode": self.mode.name, "holds": holds, "commands_rejected": self.rejected}

    def update(self, t: int, q: Array, v: Array, gravity: Array, force: float, command: Command | None, *, lost: bool) -> Array:
        """Return the values to apply at `t` [ns]; zero outside ACTIVE, where `damping` acts instead, or the arm stays.

        Args:
            t: time [ns].
            q: measured positions [rad].
            v: measured velocities [rad/s].
            gravity: gravity torques [N m].
            force: external force at the tool [N].
            command: newest command.
            lost: True if the commander is lost.
        """
        if self.held:
            return self._still
        if lost:
            self.hold(t, HoldCause.COMMANDER_LOST, "the service of role control is lost", "control")
            return self._still
        limit = self._force_limit = max(self._force_emergency, min(self._force_limit, force + TUNING.further_n))
        if not force <= limit:  # also for NaN
            self.hold(t, HoldCause.FORCE_LIMIT, f"external force {force:.1f} N at the tool, limit {limit:.1f} N")
        else:
            self._check_joints(t, q, v)
        if command is not None and not self.held:
            if command.stamp > self._since:
                self._take(t, command, q, gravity)
            elif self.mode is DriverMode.ACTIVE:  # not checked, so it must not be applied
                age = (t - command.stamp) / 1e6
                self.hold(t, HoldCause.COMMAND_EXPIRED, f"the newest command of control is {age:.0f} ms old", _COMMAND)
        return command.values if command is not None and self.mode is DriverMode.ACTIVE else self._still

    def damping(self, v: Array, gravity: Array) -> Array:
        """Return the joint damping of this tick [N m s/rad]; in a hold it is limited by the torque limits."""
        if self.mode is DriverMode.ACTIVE:
            return self._still
        wanted = self._arm.hold_damping_nms
        if self._brake:
            self._brake -= 1
            wanted = TUNING.brake_factor * wanted
        room = self._arm.torque_nm - np.abs(gravity)
        return np.asarray(np.minimum(wanted, np.maximum(room, 0.0) / np.maximum(np.abs(v), 1e-9)))

    def _check_joints(self, t: int, q: Array, v: Array) -> None:
        arm = self._arm
        if _is_within(q, v, arm.lower_rad, arm.upper_rad, arm.velocity_radps):
            return
        for joint, q_i, v_i, low, high, fastest in zip(
            arm.joint_names, q, v, arm.lower_rad, arm.upper_rad, arm.velocity_radps, strict=True
        ):
            if not low <= q_i <= high:
                self.hold(t, HoldCause.POSITION_LIMIT, f"{joint} at {q_i:.4f} rad, limits {low:.4f} and {high:.4f} rad")
            elif not -fastest <= v_i <= fastest:
                self.hold(t, HoldCause.VELOCITY_LIMIT, f"{joint} at {v_i:.3f} rad/s, limit +-{fastest:.3f} rad/s")

    def _take(self, t: int, command: Command, q: Array, gravity: Array) -> None:
        """Accept a command, ignores it (already expired while IDLE), or holds."""
        no_command = command.expires <= command.stamp  # also if the sender's clock is ahead
        expires = min(command.expires, command.stamp + TUNING.validity_ns)
        if no_command or t > expires:
            if self.mode is DriverMode.ACTIVE:
                late = max(t - expires, 0) / 1e6
                expired = f"the last command of control expired {late:.0f} ms ago"
                reason = f"control stopped commanding: {command.problem}" if command.problem else expired
                self.hold(t, HoldCause.COMMAND_EXPIRED, reason, command.culprit or _COMMAND)
            return
        if command is not self._checked:
            self._check(t, command, q, gravity)
            self._checked = command
        if self.mode is DriverMode.IDLE:
            self.mode = DriverMode.ACTIVE

    def _check(self, t: int, command: Command, q: Array, gravity: Array) -> None:
        shape, expected = command.values.shape, (self._arm.joints,)
        if shape != expected:
            what = "position" if self._positions else "torque"
            self._reject(t, HoldCause.INVALID_COMMAND, f"control/joint_torque: {what} of shape {shape}, expected {expected}")
            return
        if command.stamp > t + TUNING.ahead_ns:
            ahead, limit = (command.stamp - t) / 1e6, TUNING.ahead_ns / 1e6
            self._reject(
                t, HoldCause.INVALID_COMMAND, f"control/joint_torque: stamped {ahead:.0f} ms ahead, limit {limit:.0f} ms"
            )
            return
        interval_ms = 1.0
        if self._checked is not None:
            interval_ms = min(max((command.stamp - self._checked.stamp) / 1e6, 1.0), TUNING.validity_ns / 1e6)
        fault = (self._position_fault if self._positions else self._torque_fault)(command.values, q, gravity, interval_ms)
        if fault is None:
            self._before = command.values
        else:
            self._reject(t, fault[0], f"control/joint_torque: {fault[1]}")

    def _torque_fault(self, wanted: Array, q: Array, gravity: Array, interval_ms: float) -> tuple[HoldCause, str] | None:
        """Check torques [N m] against their limits and those before."""
        first, limit = self._before is None, self._arm.torque_nm
        before = self._still if self._before is None else self._before
        change = TUNING.first_torque_nm if first else TUNING.torque_rate_nm_per_ms * interval_ms
        if _is_acceptable(wanted, gravity, before, limit, change):
            return None
        over, far = ~(np.abs(wanted + gravity) <= limit), ~(np.abs(wanted - before) <= change)  # also for NaN
        k = int(np.argmax(over | far))
        joint = f"{self._arm.joint_names[k]} = {wanted[k]:.1f} N m"
        if not np.isfinite(wanted[k]):
            return HoldCause.INVALID_COMMAND, f"{joint}, must be finite"
        if over[k]:
            return HoldCause.TORQUE_LIMIT, f"{joint} plus {gravity[k]:.1f} N m of gravity, limit +-{limit[k]:.0f} N m"
        if first:
            return HoldCause.INVALID_COMMAND, f"first command {joint}, limit {TUNING.first_torque_nm:g} N m"
        after = f"{interval_ms:.0f} ms after {before[k]:.1f} N m"
        return HoldCause.INVALID_COMMAND, f"{joint}, {after}, limit {TUNING.torque_rate_nm_per_ms:g} N m/ms"

    def _position_fault(self, wanted: Array, q: Array, gravity: Array, interval_ms: float) -> tuple[HoldCause, str] | None:
        """Check positions [rad] against joint limits and against those before, or the measured `q` [rad]."""
        arm, before = self._arm, q if self._before is None else self._before
        change = TUNING.position_jump_rad + (0.0 if self._before is None else interval_ms * 1e-3) * arm.velocity_radps
        far = ~(np.abs(wanted - before) <= change)  # also for NaN
        outside = ~((wanted >= arm.lower_rad) & (wanted <= arm.upper_rad))
        for k in np.flatnonzero(far | outside)[:1]:
            joint = f"{arm.joint_names[k]} = {wanted[k]:.4f} rad"
            if not np.isfinite(wanted[k]):
                return HoldCause.INVALID_COMMAND, f"{joint}, must be finite"
            if outside[k]:
                return HoldCause.POSITION_LIMIT, f"{joint}, limits {arm.lower_rad[k]:.4f} and {arm.upper_rad[k]:.4f} rad"
            after = f"{interval_ms:.0f} ms after {before[k]:.4f} rad"
            return HoldCause.INVALID_COMMAND, f"{joint}, {after}, limit {change[k]:.4f} rad"
        return None

    def _reject(self, t: int, cause: HoldCause, reason: str) -> None:
        self.rejected += 1
        self.hold(t, cause, reason, _COMMAND)


@compiled
def _is_within(q: Array, v: Array, lower: Array, upper: Array, velocity_limit: Array) -> bool:
    """Return True if positions and velocities, shapes (n,), are within their limits and not NaN."""
    return bool(np.all(q >= lower) and np.all(q <= upper) and np.all(np.abs(v) <= velocity_limit))


@compiled
def _is_acceptable(torque: Array, gravity: Array, before: Array, limit: Array, change: float) -> bool:
    """Return True if a command (n,) plus gravity is within its limit and within `change` of the previous one [N m]."""
    return bool(np.all(np.abs(torque + gravity) <= limit) and np.all(np.abs(torque - before) <= change))
