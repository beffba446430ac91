"""Role control: impedance or admittance control. The suite plays an arm that stands still at the ready posture."""

from typing import Any

import numpy as np

from palpate.check.rig import Feed, ReceivedMessage, Rig, Source, robot_status, sense
from palpate_bus.contract import contract
from palpate_bus.messages import ImpedanceSetpoint, JointState, Point, Pose, Quaternion, Twist, Vector3, Wrench
from palpate_bus.messages.geometry import pose_message
from palpate_bus.messages.stamps import MS, duration_message, header, nanoseconds
from palpate_models.numerics.frames import GRAVITY, Array
from palpate_models.robot.arm import arm_of, tool_jacobian, tool_pose
from palpate_models.robot.chain import Arm
from palpate_models.scenario.schema import CommandLevel

COMMAND = "control/joint_torque"
VALID = contract().topics["planning/setpoint"].expiry


class Played:
    """The arm of a scenario at rest, and set-points for it."""

    def __init__(self, rig: Rig) -> None:
        self.robot = rig.settings.scenario.robot
        self.arm: Arm = arm_of(self.robot)
        self.home, self.rest = self.arm.home_rad, np.zeros(self.arm.joints)
        self.positions = self.robot.level is CommandLevel.POSITION
        self.unit = "rad" if self.positions else "N m"

    def values(self, message: Any) -> Array:
        """Return the torques [N m] or positions [rad] of a command, shape (n,)."""
        return np.asarray(message.position if self.positions else message.torque)

    def joints(self, q: Any = None, names: tuple[str, ...] | None = None) -> Source:
        """Return the source of an arm at rest at `q` [rad]."""
        position = np.asarray(self.home if q is None else q, dtype=float)
        listed = list(names or self.arm.joint_names)
        return lambda t: JointState(header(t), listed, sense(position, t), sense(self.rest, t), self.rest)

    def status(self, t: int) -> Any:
        """Return the status of the arm: nothing but the tool loads its F/T sensor."""
        weight_W = np.array((0.0, 0.0, -self.robot.tool_mass_kg * GRAVITY))
        force = tool_pose(self.home, self.robot)[:3, :3].T @ weight_W
        return robot_status(t, self.home, self.rest, force, self.rest)

    def joint_target(self, q: Any, stiffness: float) -> Source:
        """Return the source of a set-point of mode JOINT."""
        pose = Pose(Point(0.0, 0.0, 0.0), Quaternion(0.0, 0.0, 0.0, 1.0))
        kind, target = ImpedanceSetpoint.MODE_JOINT, np.asarray(q, dtype=float)
        return self._setpoint(kind, pose, np.zeros(6), target, np.full_like(self.rest, stiffness))

    def pose_target(self, X_WI: Array, stiffness: float) -> Source:
        """Return the source of a set-point of mode CARTESIAN, with the current null-space posture."""
        K = np.array([stiffness] * 3 + [100.0] * 3)
        return self._setpoint(ImpedanceSetpoint.MODE_CARTESIAN, pose_message(X_WI[:3, :3], X_WI[:3, 3]), K, self.home, self.rest)

    def _setpoint(self, mode: int, pose: Any, K: Array, q: Array, K_q: Array) -> Source:
        zero = Vector3(0.0, 0.0, 0.0)
        twist, force, valid = Twist(zero, zero), Wrench(zero, zero), duration_message(VALID)
        return lambda t: ImpedanceSetpoint(header(t, "world"), mode, pose, twist, force, K, np.ones(6), q, self.rest, K_q, valid)

    def feed(self, setpoint: Source | None = None, joints: Source | None = None) -> Feed:
        """Return the inputs of the controller."""
        sources: dict[str, Source] = {"joint_states": joints or self.joints(), "robot/status": self.status}
        if setpoint is not None:
            sources["planning/setpoint"] = setpoint
        return sources


def suite(rig: Rig) -> None:
    """Check signs, limits, expiry and reactions to garbage."""
    arm = Played(rig)
    rig.section("law")
    idle = rig.run(0.3, arm.feed())[COMMAND]
    wanted = arm.home if arm.positions else arm.rest
    off = max((np.max(np.abs(arm.values(item.message) - wanted)) for item in idle), default=np.inf)
    name = "without a set-point it commands no torque, or the arm's position"
    rig.below(name, 0.0 if _has_expired(idle) else off, 1e-6, f"{arm.unit} off")
    _joint_sign(rig, arm)
    _cartesian_sign(rig, arm)
    _limits(rig, arm)
    rig.section("expiry")
    _expiry(rig, arm)
    rig.section("garbage")
    _garbage(rig, arm)
    rig.section("silence")
    received = rig.run(0.4 + rig.slack_s, {"planning/setpoint": arm.joint_target(arm.home, 100.0)})[COMMAND]
    _ceases(rig, arm, "no joint states", received)


def _has_expired(received: list[ReceivedMessage]) -> bool:
    """Return True if the last commands have expired or there are none: then the driver holds."""
    return all(nanoseconds(item.message.valid_for) == 0 for item in received[-5:])


def _command(rig: Rig, arm: Played, sources: Feed, seconds: float = 0.3) -> Array:
    """Return the mean of the last commands [N m or rad], shape (n,)."""
    received = rig.run(seconds, sources)[COMMAND][-20:]
    return np.mean([arm.values(item.message) for item in received], axis=0) if received else np.full_like(arm.rest, np.nan)


def _joint_sign(rig: Rig, arm: Played) -> None:
    wrong = []
    for joint, name in enumerate(arm.arm.joint_names):
        target = arm.home.copy()
        target[joint] += 0.05
        command = _command(rig, arm, arm.feed(arm.joint_target(target, 100.0)))
        off = np.abs(command - (target if arm.positions else 100.0 * (target - arm.home)))
        if not np.all(off < (0.005 if arm.positions else 1.0)):
            wrong.append(f"{name}: {command.round(2)}")
    wanted = "the position" if arm.positions else "+5 N m for +0.05 rad at 100 N m/rad"
    name = "mode JOINT: stiffness times offset on that joint alone, or the position"
    rig.expect(name, not wrong, wanted, "; ".join(wrong) or "all joints")


def _cartesian_sign(rig: Rig, arm: Played) -> None:
    X_WI = tool_pose(arm.home, arm.robot)
    J = tool_jacobian(arm.home, arm.robot)
    wrong = []
    for axis, name in enumerate("xyz"):
        target = X_WI.copy()
        target[axis, 3] += 0.01
        command = _command(rig, arm, arm.feed(arm.pose_target(target, 1000.0)))
        if arm.positions:
            got, wanted, allowed = tool_pose(command, arm.robot)[:3, 3], target[:3, 3], 0.001
        else:
            got, wanted = command, J.T[:, axis] * 10.0
            allowed = 0.15 * float(np.linalg.norm(wanted))
        if not np.linalg.norm(got - wanted) < allowed:
            wrong.append(f"{name}: {got.round(3)}, not {wanted.round(3)}")
    expected = "the pose, within 1 mm" if arm.positions else "10 N for 10 mm at 1000 N/m, within 15 %"
    name = "mode CARTESIAN: the torques of stiffness times offset, J^T F, or the positions of the pose"
    rig.expect(name, not wrong, expected, "; ".join(wrong) or "x, y and z")


def _limits(rig: Rig, arm: Played) -> None:
    rig.run(0.6, arm.feed(arm.joint_target(arm.home + np.where(arm.home > arm.arm.middle_rad, -1.0, 1.0), 2000.0)))
    rig.run(0.6, arm.feed(arm.joint_target(arm.home, 100.0)))
    values = np.array([arm.values(item.message) for item in rig.log[COMMAND]])
    worst, torque = np.max(np.abs(values), axis=0).round(2), arm.arm.torque_nm
    low, high = (arm.arm.lower_rad, arm.arm.upper_rad) if arm.positions else (-torque, torque)
    inside = bool(np.all((values >= low) & (values <= high)))
    rig.expect("commands stay within the joints' limits for any set-point", inside, f"{low} to {high} {arm.unit}", worst)


def _expiry(rig: Rig, arm: Played) -> None:
    rig.run(0.3, arm.feed(arm.joint_target(arm.home, 100.0)))
    ended = rig.t
    received = rig.run(0.6 + rig.slack_s, arm.feed())[COMMAND]
    expired = next((item.t - ended for item in received if nanoseconds(item.message.valid_for) == 0), None)
    limit = VALID + 12 * MS + rig.slack
    silent = received[-1].t - ended if received else 0
    ok = (expired is not None and expired <= limit and _has_expired(received)) or (expired is None and silent <= limit)
    got = f"after {expired / MS:.0f} ms" if expired is not None else f"last command after {silent / MS:.0f} ms"
    rig.expect("stops commanding when set-points cease", ok, f"expired commands or none within {limit / MS:.0f} ms", got)
    command = _command(rig, arm, arm.feed(arm.joint_target(arm.home, 100.0)))
    ok = not _has_expired(rig.log[COMMAND]) and bool(np.all(np.isfinite(command)))
    rig.expect("commands again on a new set-point", ok, "valid commands", f"{command.round(2)} {arm.unit}")


def _garbage(rig: Rig, arm: Played) -> None:
    target = arm.home.copy()
    target[0] += 0.05
    good = arm.joint_target(target, 100.0)
    before = _command(rig, arm, arm.feed(good))
    nothing = np.full_like(arm.rest, np.nan)
    received = rig.run(0.2, arm.feed(arm.joint_target(nothing, 100.0)))[COMMAND]
    finite = all(np.all(np.isfinite(arm.values(item.message))) for item in received)
    rig.expect("a set-point that is not a number makes no such command", finite, "finite commands")
    still = float(np.max(np.abs(arm.values(received[-1].message) - before))) if received else np.inf
    calm = still < (0.01 if arm.positions else 1.0) or _has_expired(received)
    rig.expect("and is not followed", calm, "the last good set-point's command, or expired ones", f"{still:.2f} {arm.unit} off")
    received = rig.run(0.3 + rig.slack_s, arm.feed(good, arm.joints(nothing)))[COMMAND]
    finite = all(np.all(np.isfinite(arm.values(item.message))) for item in received)
    _ceases(rig, arm, "joint states that are not numbers", received, finite)
    wrong = tuple(reversed(arm.arm.joint_names))
    received = rig.run(0.3 + rig.slack_s, arm.feed(good, arm.joints(names=wrong)))[COMMAND]
    _ceases(rig, arm, "joint states in another order", received)
    _command(rig, arm, arm.feed(arm.joint_target(arm.home, 100.0)))
    received = rig.log[COMMAND]
    rig.expect("and recovers with good ones", not _has_expired(received), "valid commands", _last(arm, received))


def _ceases(rig: Rig, arm: Played, when: str, received: list[ReceivedMessage], finite: bool = True) -> None:
    rig.expect(f"{when}: it ceases", finite and _has_expired(received), "expired commands or none", _last(arm, received))


def _last(arm: Played, received: list[ReceivedMessage]) -> str:
    if not received:
        return "none"
    message = received[-1].message
    return f"{arm.values(message).round(2)} {arm.unit}, valid for {nanoseconds(message.valid_for) / MS:.0f} ms"
