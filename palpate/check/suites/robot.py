"""Role robot: a driver or plant of the arm, with its F/T sensor. The order matters, because holds are latched."""

from typing import Any

import numpy as np

from palpate.check.report import ConformanceReport
from palpate.check.rig import Feed, ReceivedMessage, Rig, Source
from palpate_bus.contract import MS
from palpate_bus.messages import JointTorqueCommand, OperatorRequest, RobotStatus, SupervisorState, Vector3, Wrench, WrenchStamped
from palpate_bus.messages.geometry import rotation
from palpate_bus.messages.stamps import duration_message, header
from palpate_models.numerics.frames import Array
from palpate_models.robot.arm import arm_of
from palpate_models.robot.chain import Arm
from palpate_models.scenario.arm_file import CommandLevel

COMMAND = "control/joint_torque"
PUSH_FRACTION = 0.02
"""Torque that moves a joint slightly in `PUSH_S`, over its limit, on top of twice the friction."""
PUSH_RAD = 0.01
"""The same for an arm that takes positions."""
PUSH_S = 0.06
MOVED_RAD = 2e-4
DRIFT_RAD = 0.05
PRESS_N = 10.0


def quiet(rig: Rig, level: int = SupervisorState.LEVEL_OK) -> dict[str, Source]:
    """Return the inputs without contact and command, with the supervisor at `level`."""
    zero = Wrench(Vector3(0.0, 0.0, 0.0), Vector3(0.0, 0.0, 0.0))
    cause = SupervisorState.CAUSE_NONE if level == SupervisorState.LEVEL_OK else SupervisorState.CAUSE_FORCE

    def supervisor(t: int) -> Any:
        reason = "conformance check" if cause else ""
        return SupervisorState(header(t), level, cause, reason, rig.memory.get("releases", 0), 0.0, -1.0, 0.0, 0, "", 0.0)

    return {"sim/contact_wrench": lambda t: WrenchStamped(header(t, "world"), zero), "supervisor/state": supervisor}


def _arm(rig: Rig) -> Arm:
    return arm_of(rig.settings.scenario.robot)


def _positions(rig: Rig) -> bool:
    """Return True if the arm takes positions."""
    return rig.settings.scenario.robot.level is CommandLevel.POSITION


def _still(rig: Rig) -> Array:
    return np.zeros(_arm(rig).joints)


def commanding(rig: Rig, push: Any, level: int = SupervisorState.LEVEL_OK) -> Feed:
    """Return the inputs with a command on every tick: torques [N m], or positions [rad] relative to the present; shape (n,)."""
    values, none = np.array(push, dtype=float), np.zeros(0)
    if _positions(rig):
        values = values + rig.last("joint_states").position
    torque, position = (none, values) if _positions(rig) else (values, none)
    valid = duration_message(rig.rules.topics[COMMAND].expiry)
    return {**quiet(rig, level), COMMAND: lambda t: JointTorqueCommand(header(t), torque, position, valid, "", "")}


def suite(rig: Rig, report: ConformanceReport) -> None:
    """Check signs, gravity, holds, latches and limits."""
    report.section("joints")
    rest = rig.run(0.5, quiet(rig))
    _joints(_arm(rig), rest["joint_states"], report)
    report.expect("starts idle, without a command", _mode(rig) == RobotStatus.MODE_IDLE, "MODE_IDLE", _mode_name(rig))
    _description(rig, report)
    if not rig.settings.motion:
        report.section("commands")
        report.skip("signs, expiry, limits, holds", "they move the arm; allow it with --motion")
        return
    report.section("commands")
    _gravity(rig, report)
    _signs(rig, report)
    report.section("safe hold")
    _expiry(rig, report)
    _invalid(rig, report)
    _stop(rig, report)
    _emergency(rig, report)
    report.section("sensor")
    _force(rig, report)
    _twist(rig, report)
    report.section("safe hold")
    _lost(rig, report)
    _limits(rig, report)


def _mode(rig: Rig) -> int:
    status = rig.last("robot/status")
    return -1 if status is None else int(status.mode)


def _mode_name(rig: Rig) -> str:
    status = rig.last("robot/status")
    names = {0: "MODE_IDLE", 1: "MODE_ACTIVE", 2: "MODE_SAFE_HOLD"}
    return (
        "no robot/status"
        if status is None
        else f"{names.get(int(status.mode), status.mode)}, cause {status.cause}: {status.reason}"
    )


def _joints(arm: Arm, received: list[ReceivedMessage], report: ConformanceReport) -> None:
    if not report.expect("joint_states come", len(received) > 0, "messages", f"{len(received)}"):
        return
    last = received[-1].message
    names = list(last.name)
    report.expect("joint names, in order", names == list(arm.joint_names), ", ".join(arm.joint_names), ", ".join(names))
    shapes = [np.shape(values) for values in (last.position, last.velocity, last.effort)]
    n = arm.joints
    report.expect("a position, velocity and effort of each joint", shapes == [(n,)] * 3, f"3 x ({n},)", shapes)
    q = np.array([item.message.position for item in received if np.shape(item.message.position) == (n,)])
    inside = bool(np.all((q >= arm.lower_rad) & (q <= arm.upper_rad)))
    limits = f"{np.rad2deg(arm.lower_rad).round()} to {np.rad2deg(arm.upper_rad).round()} deg"
    report.expect("joints within their limits", inside, limits, np.rad2deg(q[-1]).round(1))
    drift = float(np.max(np.abs(q[-1] - q[0])))
    report.expect("holds still without commands", drift < DRIFT_RAD, f"drift below {DRIFT_RAD} rad in 0.5 s", f"{drift:.4f} rad")


def _description(rig: Rig, report: ConformanceReport) -> None:
    described = rig.last("robot_description")
    text = "" if described is None else str(described.data)
    missing = [name for name in (*_arm(rig).joint_names, "indenter") if f'name="{name}"' not in text]
    report.expect(
        "robot_description is a URDF of the arm and tool",
        "<robot" in text and not missing,
        "all joints, link indenter",
        "as expected" if not missing else f"without {', '.join(missing)}",
    )


def _gravity(rig: Rig, report: ConformanceReport) -> None:
    """Check that commands exclude gravity: with zero torque, or at its position, the arm stays where it is."""
    moved = rig.run(0.4, commanding(rig, _still(rig)))["joint_states"]
    report.expect("obeys commands", _mode(rig) == RobotStatus.MODE_ACTIVE, "MODE_ACTIVE", _mode_name(rig))
    drift = float(np.max(np.abs(moved[-1].message.position - moved[0].message.position))) if moved else np.inf
    report.expect(
        "stays where it is when commanded nothing else: commands exclude gravity",
        drift < DRIFT_RAD,
        f"drift below {DRIFT_RAD} rad in 0.4 s",
        f"{drift:.4f} rad",
    )


def _signs(rig: Rig, report: ConformanceReport) -> None:
    """Check that a positive command moves its joint positively and that its torque is reported with that sign."""
    wrong, unreported = [], []
    settle(rig)
    arm, robot = _arm(rig), rig.settings.scenario.robot
    for joint, name in enumerate(arm.joint_names):
        release(rig)
        push = _still(rig)
        push[joint] = PUSH_RAD if _positions(rig) else PUSH_FRACTION * arm.torque_nm[joint] + 2 * robot.joint_friction_nm
        received = rig.run(PUSH_S, commanding(rig, push))["joint_states"]
        settle(rig)
        q = np.array([item.message.position[joint] for item in received])
        if len(q) < 10 or q[-5:].mean() - q[:5].mean() < MOVED_RAD:
            wrong.append(name)
        if not any(abs(item.message.effort[joint] - push[joint]) < 0.2 * push[joint] for item in received):
            unreported.append(name)
    got = f"not {', '.join(wrong)}" if wrong else "all of them"
    report.expect("a positive command moves its joint positively", not wrong, "all joints", got)
    if _positions(rig):
        return
    got = f"not {', '.join(unreported)}" if unreported else "all of them"
    report.expect("effort reports the applied torque", not unreported, "within 20 % of the command", got)


def settle(rig: Rig) -> None:
    """Wait in the driver's hold until the arm rests."""
    rig.run(0.4, quiet(rig))


def release(rig: Rig) -> None:
    """Send a release, as the supervisor grants it."""
    rig.run(0.02, quiet(rig))
    rig.memory["releases"] = rig.memory.get("releases", 0) + 1
    rig.run(0.05 + rig.slack / 1e9, quiet(rig))


def _activate(rig: Rig) -> None:
    release(rig)
    rig.run(0.1 + rig.slack / 1e9, commanding(rig, _still(rig)))


def _holds(rig: Rig, received: list[ReceivedMessage]) -> ReceivedMessage | None:
    return next((item for item in received if item.message.mode == RobotStatus.MODE_SAFE_HOLD), None)


def _how(hold: ReceivedMessage | None) -> str:
    return "no hold" if hold is None else f"cause {hold.message.cause}: {hold.message.reason}"


def _expiry(rig: Rig, report: ConformanceReport) -> None:
    _activate(rig)
    report.expect("a release and a command make it active", _mode(rig) == RobotStatus.MODE_ACTIVE, "MODE_ACTIVE", _mode_name(rig))
    ended = rig.t
    received = rig.run(0.5 + rig.slack / 1e9, quiet(rig))["robot/status"]
    hold = _holds(rig, received)
    expiry = rig.rules.topics[COMMAND].expiry_ms or 0
    limit = (expiry + rig.rules.topics["robot/status"].period_ms + 2) * MS + rig.slack
    late = None if hold is None else hold.t - ended
    report.expect(
        "holds safely when commands cease",
        late is not None and late <= limit,
        f"MODE_SAFE_HOLD within {limit / MS:.0f} ms",
        "no hold" if late is None else f"after {late / MS:.0f} ms",
    )
    cause = -1 if hold is None else int(hold.message.cause)
    causes = (RobotStatus.CAUSE_COMMAND_EXPIRED, RobotStatus.CAUSE_COMMANDER_LOST)
    report.expect(
        "and states the reason",
        cause in causes and bool(hold and hold.message.reason),
        "CAUSE_COMMAND_EXPIRED with a reason",
        _mode_name(rig),
    )
    v = np.abs(rig.last("joint_states").velocity).max()
    report.expect("and comes to rest", v < 0.1, "below 0.1 rad/s", f"{v:.3f} rad/s")
    rig.run(0.3, commanding(rig, _still(rig)))
    latched = _mode(rig) == RobotStatus.MODE_SAFE_HOLD
    report.expect("the hold is latched: new commands do not end it", latched, "MODE_SAFE_HOLD", _mode_name(rig))


def _provoke(rig: Rig, report: ConformanceReport, what: str, push: Any, cause: int) -> None:
    _activate(rig)
    received = rig.run(0.1, commanding(rig, push))["robot/status"]
    received += rig.run(0.05 + rig.slack / 1e9, quiet(rig))["robot/status"]
    hold = _holds(rig, received)
    got = _how(hold)
    report.expect(
        f"{what} makes it hold", hold is not None and hold.message.cause == cause, f"MODE_SAFE_HOLD, cause {cause}", got
    )


def _invalid(rig: Rig, report: ConformanceReport) -> None:
    bad = _still(rig)
    bad[3] = np.nan
    _provoke(rig, report, "a command that is not a number", bad, RobotStatus.CAUSE_INVALID_COMMAND)
    huge = _still(rig)
    if _positions(rig):
        huge[0] = 1.0
        _provoke(rig, report, "a jump of a position", huge, RobotStatus.CAUSE_INVALID_COMMAND)
        return
    huge[0] = 10 * _arm(rig).torque_nm[0]
    _provoke(rig, report, "a torque beyond its limit", huge, RobotStatus.CAUSE_TORQUE_LIMIT)


def _stop(rig: Rig, report: ConformanceReport) -> None:
    _activate(rig)
    rig.send("operator/request", OperatorRequest(header(rig.t), OperatorRequest.STOP, "conformance check"))
    received = rig.run(0.1 + rig.slack / 1e9, commanding(rig, _still(rig)))["robot/status"]
    hold = _holds(rig, received)
    got = _how(hold)
    ok = hold is not None and hold.message.cause == RobotStatus.CAUSE_STOP_REQUESTED
    report.expect("an operator's stop makes it hold", ok, "MODE_SAFE_HOLD, CAUSE_STOP_REQUESTED", got)


def _emergency(rig: Rig, report: ConformanceReport) -> None:
    _activate(rig)
    received = rig.run(0.1 + rig.slack / 1e9, commanding(rig, _still(rig), SupervisorState.LEVEL_EMERGENCY))["robot/status"]
    hold = _holds(rig, received)
    got = _how(hold)
    report.expect("the supervisor's emergency stop makes it hold", hold is not None, "MODE_SAFE_HOLD", got)


def _pressing(rig: Rig, force_W: Any) -> Feed:
    wrench = Wrench(Vector3(*map(float, force_W)), Vector3(0.0, 0.0, 0.0))
    return {**quiet(rig), "sim/contact_wrench": lambda t: WrenchStamped(header(t, "world"), wrench)}


def _force(rig: Rig, report: ConformanceReport) -> None:
    """Check the sign of `ft/wrench`, the wrench of tool and environment on the sensor in its axes."""
    if not rig.log["sim/tool_state"]:
        report.skip("the F/T sensor's sign", "no sim/tool_state: no simulated arm; press the tool by hand and look at ft/wrench")
        return
    _activate(rig)
    rig.run(0.4, quiet(rig))
    before = _mean_force(rig.run(0.1, quiet(rig))["ft/wrench"])
    force_W = np.array([0.0, 0.0, PRESS_N])
    pressed = _mean_force(rig.run(0.1, _pressing(rig, force_W))["ft/wrench"])
    R_WI = rotation(rig.last("sim/tool_state").pose.orientation)
    expected = R_WI.T @ force_W
    got = pressed - before
    rig.run(0.3, quiet(rig))
    ok = bool(np.linalg.norm(got - expected) < 0.3 * PRESS_N)
    report.expect(
        "ft/wrench shows a push of 10 N with its sign", ok, f"{expected.round(1)} N in the sensor's axes", f"{got.round(1)} N"
    )


def _mean_force(received: list[ReceivedMessage]) -> np.ndarray[Any, Any]:
    forces = [item.message.wrench.force for item in received]
    return np.mean([(f.x, f.y, f.z) for f in forces], axis=0) if forces else np.full(3, np.nan)


def _twist(rig: Rig, report: ConformanceReport) -> None:
    """Check that the twist is the pose's rate of change, over the whole suite."""
    states = [item.message for item in rig.log["sim/tool_state"]]
    if not states:
        report.skip("sim/tool_state: twist", "not simulated")
        return
    t = np.array([m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in states])
    p = np.array([(m.pose.position.x, m.pose.position.y, m.pose.position.z) for m in states])
    v = np.array([(m.twist.linear.x, m.twist.linear.y, m.twist.linear.z) for m in states])
    dt = t[2:] - t[:-2]
    steady = (dt > 0) & (dt < 0.0025)  # neighbouring ticks only; a live check has pauses
    error = np.linalg.norm((p[2:] - p[:-2])[steady] / dt[steady, None] - v[1:-1][steady], axis=1)
    worst, speed = float(np.quantile(error, 0.99)), float(np.max(np.linalg.norm(v, axis=1)))
    report.expect(
        "sim/tool_state: twist is the rate of the pose",
        worst < 0.02 + 0.05 * speed,
        f"within {0.02 + 0.05 * speed:.3f} m/s",
        f"{worst:.4f} m/s",
    )


def _lost(rig: Rig, report: ConformanceReport) -> None:
    _activate(rig)
    rig.lose("control")
    received = rig.run(0.1 + rig.slack / 1e9, quiet(rig))["robot/status"]
    hold = _holds(rig, received)
    got = _how(hold)
    causes = (RobotStatus.CAUSE_COMMANDER_LOST, RobotStatus.CAUSE_COMMAND_EXPIRED)
    report.expect("the loss of control makes it hold", hold is not None and hold.message.cause in causes, "MODE_SAFE_HOLD", got)


def _limits(rig: Rig, report: ConformanceReport) -> None:
    """Check the limits over the whole suite."""
    arm, states = (
        _arm(rig),
        [item.message for item in rig.log["joint_states"] if np.shape(item.message.effort) == (_arm(rig).joints,)],
    )
    if not _positions(rig):
        worst = np.max(np.abs([state.effort for state in states]), axis=0)
        ok = bool(np.all(worst <= arm.torque_nm))
        report.expect("applied torques never leave their limits", ok, f"{arm.torque_nm} N m", worst.round(1))
    speeds = np.max(np.abs([state.velocity for state in states]), axis=0)
    margin = arm.velocity_radps * 1.05
    report.expect(
        "joint speeds never leave their limits", bool(np.all(speeds <= margin)), f"{margin.round(2)} rad/s", speeds.round(2)
    )
