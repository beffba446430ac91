"""Role robot: a driver or plant of the arm, with its F/T sensor. The order matters, because holds are latched."""

from itertools import chain, repeat
from typing import Any, Final, NamedTuple

import numpy as np

from palpate.check.rig import Feed, ReceivedMessage, Rig, Source
from palpate_bus.messages import JointTorqueCommand, OperatorRequest, RobotStatus, SupervisorState, Vector3, Wrench, WrenchStamped
from palpate_bus.messages.geometry import rotation, vectors
from palpate_bus.messages.stamps import MS, duration_message, header, nanoseconds
from palpate_models.numerics.frames import Array
from palpate_models.robot.arm import arm_of
from palpate_models.robot.chain import Arm
from palpate_models.scenario.schema import CommandLevel

COMMAND = "control/joint_torque"


class RobotTouches(NamedTuple):
    """Pushes on the robot, and its largest motion without."""

    push_s: float = 0.06
    push_fraction: float = 0.02
    """Torque that moves a joint slightly in `push_s`, over its limit, on top of twice the friction."""
    push_rad: float = 0.01
    """Position step [rad] for an arm that takes positions."""
    ripple_nm: float = 1e-3
    """Alternating part of a torque for a live arm: its port refuses a command that repeats for half a second."""
    beyond: float = 1.02
    """Torque beyond its limit, over the limit: a driver that does not check it applies it."""
    jump_rad: float = 0.1
    """Jump of a position: more than the fastest joint travels within a few ms."""
    moved_rad: float = 2e-4
    drift_rad: float = 0.05
    press_n: float = 10.0


TOUCH: Final = RobotTouches()
CEASED = (RobotStatus.CAUSE_COMMAND_EXPIRED, RobotStatus.CAUSE_COMMANDER_LOST)


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


def commanding(rig: Rig, push: Any, level: int = SupervisorState.LEVEL_OK, first: Any | None = None) -> Feed:
    """Return the inputs with a command on every tick, `first` before all others if given.

    Torques [N m], or positions [rad] relative to the present; shape (n,).
    """
    positions, none = _positions(rig), np.zeros(0)
    start = rig.last("joint_states").position if positions else 0.0
    valid = duration_message(rig.contract.topics[COMMAND].expiry)
    ripple_nm = TOUCH.ripple_nm if rig.live and not positions else 0.0
    pushes = chain([] if first is None else [first], repeat(push))

    def command(t: int) -> Any:
        values = np.array(next(pushes), dtype=float) + start + ripple_nm * (t // MS % 2)
        torque, position = (none, values) if positions else (values, none)
        return JointTorqueCommand(header(t), torque, position, valid, "", "")

    return {**quiet(rig, level), COMMAND: command}


def suite(rig: Rig) -> None:
    """Check signs, gravity, holds, latches and limits."""
    rig.section("joints")
    rest = rig.run(0.5, quiet(rig))
    _joints(rig, _arm(rig), rest["joint_states"])
    _expect_mode(rig, "starts idle, without a command", RobotStatus.MODE_IDLE)
    _description(rig)
    if not rig.settings.motion:
        rig.section("commands")
        rig.skip("signs, expiry, limits, holds", "they move the arm; allow it with --motion")
        return
    rig.section("commands")
    _gravity(rig)
    _signs(rig)
    rig.section("safe hold")
    _expiry(rig)
    _invalid(rig)
    _stop(rig)
    rig.section("sensor")
    _force(rig)
    _twist(rig)
    rig.section("safe hold")
    _check_loss(rig)
    _limits(rig)


MODES = {RobotStatus.MODE_IDLE: "MODE_IDLE", RobotStatus.MODE_ACTIVE: "MODE_ACTIVE", RobotStatus.MODE_SAFE_HOLD: "MODE_SAFE_HOLD"}


def _expect_mode(rig: Rig, name: str, mode: int) -> None:
    """Expect the newest status to have a mode."""
    status = rig.last("robot/status")
    got = "no robot/status" if status is None else f"{MODES.get(status.mode)}, cause {status.cause}: {status.reason}"
    rig.expect(name, status is not None and status.mode == mode, MODES[mode], got)


def _joints(rig: Rig, arm: Arm, received: list[ReceivedMessage]) -> None:
    if not rig.arrives("joint_states come", received, "messages"):
        return
    last = received[-1].message
    rig.equal("joint names, in order", tuple(last.name), tuple(arm.joint_names))
    shapes = [np.shape(values) for values in (last.position, last.velocity, last.effort)]
    n = arm.joints
    rig.equal("a position, velocity and effort of each joint", shapes, [(n,)] * 3)
    q = np.array([item.message.position for item in received if np.shape(item.message.position) == (n,)])
    inside = bool(np.all((q >= arm.lower_rad) & (q <= arm.upper_rad)))
    limits = f"{np.rad2deg(arm.lower_rad).round()} to {np.rad2deg(arm.upper_rad).round()} deg"
    rig.expect("joints within their limits", inside, limits, np.rad2deg(q[-1]).round(1))
    rig.below("holds still without commands", np.max(np.abs(q[-1] - q[0])), TOUCH.drift_rad, "rad in 0.5 s")


def _description(rig: Rig) -> None:
    described = rig.last("robot_description")
    text = "" if described is None else str(described.data)
    missing = [name for name in (*_arm(rig).joint_names, "indenter") if f'name="{name}"' not in text]
    got = f"without {', '.join(missing)}" if missing else None
    rig.expect("robot_description is a URDF of the arm and tool", "<robot" in text and not missing, "all joints, indenter", got)


def _gravity(rig: Rig) -> None:
    """Check that commands exclude gravity: with zero torque, or at its position, the arm stays where it is."""
    moved = rig.run(0.4, commanding(rig, _still(rig)))["joint_states"]
    _expect_mode(rig, "obeys commands", RobotStatus.MODE_ACTIVE)
    drift = np.max(np.abs(moved[-1].message.position - moved[0].message.position)) if moved else np.inf
    rig.below("stays where it is when commanded nothing else: commands exclude gravity", drift, TOUCH.drift_rad, "rad in 0.4 s")


def _signs(rig: Rig) -> None:
    """Check that a positive command moves its joint positively and that its torque is reported with that sign."""
    wrong, unreported = [], []
    rig.run(0.4, quiet(rig))
    arm, robot = _arm(rig), rig.settings.scenario.robot
    for joint, name in enumerate(arm.joint_names):
        release(rig)
        push = _still(rig)
        torque = TOUCH.push_fraction * arm.torque_nm[joint] + 2 * robot.joint_friction_nm
        push[joint] = TOUCH.push_rad if _positions(rig) else torque
        received = rig.run(TOUCH.push_s, commanding(rig, push))["joint_states"]
        rig.run(0.4, quiet(rig))
        q = np.array([item.message.position[joint] for item in received])
        if len(q) < 10 or q[-5:].mean() - q[:5].mean() < TOUCH.moved_rad:
            wrong.append(name)
        if not any(abs(item.message.effort[joint] - push[joint]) < 0.2 * push[joint] for item in received):
            unreported.append(name)
    got = f"not {', '.join(wrong)}" if wrong else "all of them"
    rig.expect("a positive command moves its joint positively", not wrong, "all joints", got)
    if _positions(rig):
        return
    got = f"not {', '.join(unreported)}" if unreported else "all of them"
    rig.expect("effort reports the applied torque", not unreported, "within 20 % of the command", got)


def release(rig: Rig) -> None:
    """Send a release, as the supervisor grants it."""
    rig.run(0.02, quiet(rig))
    rig.memory["releases"] = rig.memory.get("releases", 0) + 1
    rig.run(0.05 + rig.slack_s, quiet(rig))


def _activate(rig: Rig) -> None:
    rig.run(0.1 + rig.slack_s, quiet(rig))  # earlier commands expire, and hold, before the release
    release(rig)
    rig.run(0.1 + rig.slack_s, commanding(rig, _still(rig)))


def _hold(received: list[ReceivedMessage]) -> ReceivedMessage | None:
    return next((item for item in received if item.message.mode == RobotStatus.MODE_SAFE_HOLD), None)


def _expect_hold(rig: Rig, name: str, received: list[ReceivedMessage], *causes: int) -> None:
    """Expect a safe hold among the statuses, for one of the causes if there are any, with a reason."""
    hold = _hold(received)
    got = "no hold" if hold is None else f"cause {hold.message.cause}: {hold.message.reason}"
    ok = hold is not None and (not causes or hold.message.cause in causes) and bool(hold.message.reason)
    rig.expect(name, ok, f"MODE_SAFE_HOLD{', cause ' if causes else ''}{' or '.join(map(str, causes))}, a reason", got)


def _expiry(rig: Rig) -> None:
    _activate(rig)
    _expect_mode(rig, "a release and a command make it active", RobotStatus.MODE_ACTIVE)
    ended = rig.t
    received = rig.run(0.5 + rig.slack_s, quiet(rig))["robot/status"]
    hold = _hold(received)
    expiry = rig.contract.topics[COMMAND].expiry_ms or 0
    limit = (expiry + rig.contract.topics["robot/status"].period_ms + 3) * MS + rig.slack
    rig.below("holds safely when commands cease", np.inf if hold is None else hold.t - ended, limit, "ms", 1 / MS)
    _expect_hold(rig, "and states the reason", received, *CEASED)
    rig.below("and comes to rest", np.abs(rig.last("joint_states").velocity).max(), 0.1, "rad/s")
    rig.run(0.3, commanding(rig, _still(rig)))
    _expect_mode(rig, "the hold is latched: new commands do not end it", RobotStatus.MODE_SAFE_HOLD)


def _provoke(rig: Rig, what: str, push: Any, cause: int, *, refusable: bool = True) -> None:
    """Expect a hold for a command that is sent once, while commands continue.

    One that is `refusable` the port may keep from the driver, which then stays active.
    """
    _activate(rig)
    received = rig.run(0.1 + rig.slack_s, commanding(rig, _still(rig), first=push))
    share = max((_effort_share(rig, item.message) for item in received["joint_states"]), default=np.inf)
    last = rig.last("robot/status")
    if refusable and share <= 1.0 and last is not None and last.mode == RobotStatus.MODE_ACTIVE:
        rig.expect(f"{what} is not applied", ok=True, expected="efforts within their limits", got=f"{share:.2g} of the limit")
    else:
        _expect_hold(rig, f"{what} makes it hold", received["robot/status"], cause)


def _effort_share(rig: Rig, state: Any) -> float:
    """Return the largest effort of joint states over its limit, 0 without efforts."""
    return float(np.max(np.abs(state.effort) / _arm(rig).torque_nm)) if len(state.effort) else 0.0


def _invalid(rig: Rig) -> None:
    bad = _still(rig)
    bad[3] = np.nan
    _provoke(rig, "a command that is not a number", bad, RobotStatus.CAUSE_INVALID_COMMAND)
    huge = _still(rig)
    if _positions(rig):
        huge[0] = TOUCH.jump_rad
        _provoke(rig, "a jump of a position", huge, RobotStatus.CAUSE_INVALID_COMMAND, refusable=False)
        return
    huge[0] = TOUCH.beyond * _arm(rig).torque_nm[0]
    _provoke(rig, "a torque beyond its limit", huge, RobotStatus.CAUSE_TORQUE_LIMIT)


def _stop(rig: Rig) -> None:
    _activate(rig)
    rig.send("operator/request", OperatorRequest(header(rig.t), OperatorRequest.STOP, "conformance check"))
    received = rig.run(0.1 + rig.slack_s, commanding(rig, _still(rig)))["robot/status"]
    _expect_hold(rig, "an operator's stop makes it hold", received, RobotStatus.CAUSE_STOP_REQUESTED)
    _activate(rig)
    received = rig.run(0.1 + rig.slack_s, commanding(rig, _still(rig), SupervisorState.LEVEL_EMERGENCY))["robot/status"]
    _expect_hold(rig, "the supervisor's emergency stop makes it hold", received)


def _force(rig: Rig) -> None:
    """Check the sign of `ft/wrench`, the wrench of tool and environment on the sensor in its axes."""
    if not rig.log["sim/tool_state"]:
        rig.skip("the F/T sensor's sign", "no sim/tool_state: no simulated arm; press the tool by hand and look at ft/wrench")
        return
    _activate(rig)
    rig.run(0.4, quiet(rig))
    before = _mean_force(rig.run(0.1, quiet(rig))["ft/wrench"])
    push = Wrench(Vector3(0.0, 0.0, TOUCH.press_n), Vector3(0.0, 0.0, 0.0))
    pressing = {**quiet(rig), "sim/contact_wrench": lambda t: WrenchStamped(header(t, "world"), push)}
    pressed = _mean_force(rig.run(0.1, pressing)["ft/wrench"])
    R_WI = rotation(rig.last("sim/tool_state").pose.orientation)
    off = np.linalg.norm(pressed - before - TOUCH.press_n * R_WI[2])
    rig.run(0.3, quiet(rig))
    rig.below("ft/wrench shows a push of 10 N with its sign", off, 0.3 * TOUCH.press_n, "N off in the sensor's axes")


def _mean_force(received: list[ReceivedMessage]) -> Array:
    return vectors(item.message.wrench.force for item in received).mean(axis=0) if received else np.full(3, np.nan)


def _twist(rig: Rig) -> None:
    """Check that the twist is the pose's rate of change, over the whole suite."""
    states = [item.message for item in rig.log["sim/tool_state"]]
    if not states:
        rig.skip("sim/tool_state: twist", "not simulated")
        return
    t = np.array([nanoseconds(m.header.stamp) / 1e9 for m in states])
    p, v = vectors(m.pose.position for m in states), vectors(m.twist.linear for m in states)
    dt = t[2:] - t[:-2]
    steady = (dt > 0) & (dt < 0.0025)  # neighbouring ticks only; a live check has pauses
    error = np.linalg.norm((p[2:] - p[:-2])[steady] / dt[steady, None] - v[1:-1][steady], axis=1)
    worst, speed = float(np.quantile(error, 0.99)), float(np.max(np.linalg.norm(v, axis=1)))
    rig.below("sim/tool_state: twist is the rate of the pose", worst, 0.02 + 0.05 * speed, "m/s off")


def _check_loss(rig: Rig) -> None:
    _activate(rig)
    rig.lose("control")
    received = rig.run(0.1 + rig.slack_s, quiet(rig))["robot/status"]
    _expect_hold(rig, "the loss of control makes it hold", received, *CEASED)


def _limits(rig: Rig) -> None:
    """Check the limits over the whole suite."""
    arm = _arm(rig)
    states = [item.message for item in rig.log["joint_states"] if np.shape(item.message.effort) == (arm.joints,)]
    if not _positions(rig):
        worst = max(_effort_share(rig, state) for state in states)
        rig.within("applied torques never leave their limits", worst, 0.0, 1.0, "of the limit")
    speeds = np.max(np.abs([state.velocity for state in states]), axis=0)
    rig.below("joint speeds never leave their limits", np.max(speeds / arm.velocity_radps), 1.05, "of the limit")
