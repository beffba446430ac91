"""Role supervisor: the suite plays arm and planning, violates one limit after another, and expects a stop for each."""

from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from palpate.check.rig import Feed, ReceivedMessage, Rig, robot_status
from palpate.check.shapes import level
from palpate.exam_state import exam_state
from palpate_bus.messages import MS, NS, ExamState, OperatorRequest, RobotStatus, SupervisorState, header
from palpate_models.numerics.frames import GRAVITY, Array, apply, inverse
from palpate_models.robot.arm import arm_of, tool_jacobian, tool_pose, urdf
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import CommandLevel, Limits

STATE, STATUS, EXAM, SURFACE = "supervisor/state", "robot/status", "exam/state", "perception/surface"


class Expected(NamedTuple):
    """Tolerances and time limits of the supervisor, and the rise of the played force."""

    force_error_n: float = 3.0
    """Includes the sensor's bias, because the force is untared."""
    react_ms: float = 150.0
    """For an emergency stop."""
    soft_ms: float = 400.0
    """For a soft stop, which may wait for a reaction of planning."""
    silent_s: float = 0.6
    rise_nps: float = 10.0
    step_s: float = 0.02
    swing_rad: float = 0.3
    """Amplitude and angular frequency of the motion in which the tool is weighed."""
    swing_radps: float = 1.0


EXPECTED = Expected()
AWAY_RAD = (2.9, -2.9, 1.57, -1.57)
"""Turns of the first joint away from the patient; at least one of them, or the arm at zero, is probably outside the workspace."""
STOPPED = (SupervisorState.LEVEL_SOFT_STOP, SupervisorState.LEVEL_EMERGENCY)
EMERGENCY = (SupervisorState.LEVEL_EMERGENCY,)
OK = (SupervisorState.LEVEL_OK,)


class PlayedArm:
    """An arm at rest in the ready posture without contact, until an attribute is changed."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self.robot = exam_input(rig.settings.scenario).robot
        self._model = pin.buildModelFromXML(urdf(self.robot, geometry=False))
        self._data = self._model.createData()
        self._t = rig.t
        self.calm()

    def calm(self) -> None:
        """Return to rest."""
        self.home = arm_of(self.robot).home_rad
        self.q, self.qd = self.home.copy(), np.zeros_like(self.home)
        self.push_N = 0.0
        """Upward force on the tool [N]."""
        self.mode, self.reason = RobotStatus.MODE_ACTIVE, ""
        self.turns = False
        """True if the positions follow the velocities."""

    def feed(self, *without: str) -> Feed:
        """Return the periodic inputs of the supervisor without some topics."""
        return {name: source for name, source in ((STATUS, self._status), (EXAM, self._exam)) if name not in without}

    def _status(self, t: int) -> Any:
        if self.turns:
            self.q = self.q + self.qd * (t - self._t) / NS
        self._t = t
        q, push_W = np.nan_to_num(self.q), np.array((0.0, 0.0, self.push_N))
        force = tool_pose(q, self.robot)[:3, :3].T @ (push_W - np.array((0.0, 0.0, self.robot.tool_mass_kg * GRAVITY)))
        torque = pin.rnea(self._model, self._data, q, self.qd, np.zeros_like(q)) - tool_jacobian(q, self.robot)[:3].T @ push_W
        cause = RobotStatus.CAUSE_COMMAND_EXPIRED if self.reason else RobotStatus.CAUSE_NONE
        return robot_status(t, self.q, self.qd, force, torque, self.mode, cause, self.reason)

    def _exam(self, t: int) -> Any:
        return exam_state(t, ExamState.PHASE_SCAN, target_count=1)

    def surface(self, t: int, depth: float) -> Any:
        """Return a level surface that lies `depth` [m] above the sphere's lowest point."""
        x, y, z = tool_pose(self.q, self.robot)[:3, 3]
        return level(t, 0.1, 0.01, (x, y, z + depth - self.robot.indenter_radius_m))


def suite(rig: Rig) -> None:
    """Check measures, each limit, the latch, operator requests, silence and loss."""
    arm = PlayedArm(rig)
    limits = exam_input(rig.settings.scenario).limits
    rig.section("rest")
    rest = rig.run(2.0, arm.feed())[STATE]
    if not rig.arrives("supervisor/state comes", rest, "100 Hz"):
        return
    _expect_level(rig, "an arm at rest is not stopped", rest)
    _swing(rig, arm)
    _measures(rig, arm)

    rig.section("limits")
    _force(rig, arm, limits)
    rig.send(SURFACE, arm.surface(rig.t, limits.depth_m + 0.035))
    _stops(rig, arm, "too deep, pressed", STOPPED, SupervisorState.CAUSE_DEPTH)
    rig.send(SURFACE, arm.surface(rig.t, -0.05))
    _expect_release(rig, arm, "and is released above the surface")
    arm.qd = _turning(arm, 1.5 * limits.speed_mps)
    jump = (SupervisorState.CAUSE_SPEED, SupervisorState.CAUSE_SENSOR)  # the played arm jumps to that speed without torques
    _stops(rig, arm, "a tool too fast", EMERGENCY, *jump, released="at rest")
    _workspace(rig, arm)

    rig.section("others")
    arm.q = np.full_like(arm.home, np.nan)
    invalid = (SupervisorState.CAUSE_INVALID, SupervisorState.CAUSE_SILENT)  # its port refuses them
    _stops(rig, arm, "positions that are not numbers", EMERGENCY, *invalid, released="with numbers")
    arm.mode, arm.reason = RobotStatus.MODE_SAFE_HOLD, "conformance check"
    _stops(rig, arm, "a driver that holds by itself", EMERGENCY, SupervisorState.CAUSE_DRIVER, released="with the driver")
    rig.send("operator/request", OperatorRequest(header(rig.t), OperatorRequest.STOP, "enough"))
    _stops(rig, arm, "an operator's stop", EMERGENCY, SupervisorState.CAUSE_OPERATOR)
    received = rig.run(0.5, arm.feed())[STATE]
    ok = _level(received) in EMERGENCY and "enough" in received[-1].message.reason
    rig.expect("it stays, with the operator's reason", ok, "level 2, 'enough'", _text(received))
    _expect_release(rig, arm, "and is released by the operator")
    for silent in (STATUS, EXAM):
        received = rig.run(EXPECTED.silent_s, arm.feed(silent))[STATE]
        _expect_level(rig, f"stops when {silent} is silent", received, EMERGENCY)
        _expect_release(rig, arm, f"and is released when {silent} is back")
    rig.lose("control")
    _stops(rig, arm, "the loss of control", EMERGENCY, SupervisorState.CAUSE_LOST)


def _measures(rig: Rig, arm: PlayedArm) -> None:
    """Check the reported force, speed and depth."""
    rig.section("measures")
    arm.qd, arm.turns = _turning(arm, 0.05), True
    rig.send(SURFACE, arm.surface(rig.t, 0.004))
    received = _press(rig, arm, 10.0)
    state = received[-1].message
    rig.below("force is that on the tool", abs(state.force - 10.0), EXPECTED.force_error_n, "N off")
    rig.below("speed is that of the sphere", abs(state.speed - 0.05), 0.005, "m/s off")
    rig.below("depth is below the perceived surface", abs(state.depth - 0.004), 1e-3, "mm off", 1e3)
    _expect_level(rig, "and none of them is a reason to stop", received)
    arm.calm()
    rig.send(SURFACE, arm.surface(rig.t, -0.05))


def _swing(rig: Rig, arm: PlayedArm) -> None:
    """Tilt the tool to and fro by the last joint but one, so that its weight can be measured, as on the way to a first target."""
    for phase in np.arange(0.0, 2 * np.pi, EXPECTED.swing_radps * EXPECTED.step_s):
        arm.q[-2] = arm.home[-2] + EXPECTED.swing_rad * np.sin(phase)
        arm.qd[-2] = EXPECTED.swing_rad * EXPECTED.swing_radps * np.cos(phase)
        rig.run(EXPECTED.step_s, arm.feed())
    arm.calm()


def _press(rig: Rig, arm: PlayedArm, force: float) -> list[ReceivedMessage]:
    """Press up to `force` [N] as slowly as an examination does, and hold for half a second."""
    for push in np.linspace(arm.push_N, force, 2 + int(abs(force - arm.push_N) / EXPECTED.rise_nps / EXPECTED.step_s)):
        arm.push_N = float(push)
        rig.run(EXPECTED.step_s, arm.feed())
    return rig.run(0.5, arm.feed())[STATE]


def _turning(arm: PlayedArm, speed: float) -> Array:
    """Return joint velocities [rad/s] that move the tool at `speed` [m/s] by the first joint alone."""
    lever = float(np.linalg.norm(tool_jacobian(arm.q, arm.robot)[:3, 0]))
    return np.append(speed / lever, np.zeros(len(arm.home) - 1))


def _workspace(rig: Rig, arm: PlayedArm) -> None:
    known = exam_input(rig.settings.scenario)
    low, high = np.array(known.limits.workspace_min_m), np.array(known.limits.workspace_max_m)
    X_AW = inverse(np.array(known.X_WA))
    for q in (np.zeros_like(arm.home), *(np.append(arm.home[0] + turn, arm.home[1:]) for turn in AWAY_RAD)):
        p_A = apply(X_AW, tool_pose(q, arm.robot)[:3, 3])
        if bool(np.any(p_A < low - 0.02) or np.any(p_A > high + 0.02)):
            arm.q = q
            _stops(rig, arm, "a tool outside the workspace", EMERGENCY, SupervisorState.CAUSE_WORKSPACE, released="inside")
            return
    rig.skip("stops for a tool outside the workspace", "all postures of this check lie in the workspace")


def _force(rig: Rig, arm: PlayedArm, limits: Limits) -> None:
    _press(rig, arm, limits.force_soft_stop_n - 1.0)
    arm.push_N = limits.force_soft_stop_n + 1.0
    _stops(rig, arm, "a force over the soft-stop limit", STOPPED, SupervisorState.CAUSE_FORCE)
    received = rig.run(1.0, arm.feed())[STATE]
    _expect_level(rig, "a soft stop that does not help becomes an emergency stop", received, EMERGENCY)
    rig.send("operator/request", OperatorRequest(header(rig.t), OperatorRequest.RELEASE, "conformance check"))
    received = rig.run(0.3, arm.feed())[STATE]
    if arm.robot.level is CommandLevel.POSITION:
        _expect_level(rig, "an arm that cannot yield is released, so that it can lift", received)
    else:
        _expect_level(rig, "a release is refused while its cause is present", received, STOPPED)
        _expect_release(rig, arm, "and is released")
    arm.push_N = limits.force_emergency_n + 10.0
    _stops(rig, arm, "a force over the emergency limit", EMERGENCY, SupervisorState.CAUSE_FORCE, released="after it")
    _expect_level(rig, "a steady force below the limits is not stopped", _press(rig, arm, limits.force_working_n))


def _stops(rig: Rig, arm: PlayedArm, what: str, levels: tuple[int, ...], *causes: int, released: str = "") -> None:
    """Expect a stop with the right cause, or one of several, and a reason; with `released`, then a release."""
    start = rig.t
    received = rig.run(0.5, arm.feed())[STATE]
    first = next((item for item in received if item.message.level in levels), None)
    wanted = f"level {' or '.join(map(str, levels))}, cause {' or '.join(map(str, causes))}, a reason"
    rig.expect(f"stops for {what}", first is not None, wanted, _text(received))
    if first is not None:
        state = first.message
        rig.expect(f"and states the cause: {what}", state.cause in causes and bool(state.reason), wanted, _text([first]))
        within_ms = EXPECTED.react_ms if levels == EMERGENCY else EXPECTED.soft_ms
        within_ms = 1e3 * EXPECTED.silent_s if state.cause == SupervisorState.CAUSE_SILENT else within_ms
        rig.below(f"in time: {what}", (first.t - start - rig.slack) / MS, within_ms + 1, "ms")
    if released:
        _expect_release(rig, arm, f"and is released {released}")


def _expect_release(rig: Rig, arm: PlayedArm, name: str) -> None:
    """Expect that a stop stays when its cause is gone, and ends on release, which is counted."""
    arm.calm()
    received = rig.run(0.5, arm.feed())[STATE]
    stays = _level(received) in STOPPED
    before = received[-1].message.releases if received else 0
    rig.send("operator/request", OperatorRequest(header(rig.t), OperatorRequest.RELEASE, "conformance check"))
    received = rig.run(0.5, arm.feed())[STATE]
    ok = stays and _level(received) == SupervisorState.LEVEL_OK and received[-1].message.releases == before + 1
    got = _text(received) if stays else "the stop ended without a release"
    rig.expect(name, ok, "stopped until released, then level 0 and one more release", got)


def _expect_level(rig: Rig, name: str, received: list[ReceivedMessage], levels: tuple[int, ...] = OK) -> None:
    rig.expect(name, _level(received) in levels, f"level {' or '.join(map(str, levels))}", _text(received))


def _level(received: list[ReceivedMessage]) -> int | None:
    return int(received[-1].message.level) if received else None


def _text(received: list[ReceivedMessage]) -> str:
    if not received:
        return "nothing"
    state = received[-1].message
    return f"level {state.level}, cause {state.cause}{f': {state.reason}' if state.reason else ''}"
