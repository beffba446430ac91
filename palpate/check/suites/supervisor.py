"""Role supervisor: the suite plays arm and planning, violates one limit after another, and expects a stop for each."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from palpate.check.report import ConformanceReport
from palpate.check.rig import Feed, ReceivedMessage, Rig, sensed
from palpate.check.shapes import level
from palpate.exam_state import exam_state
from palpate_bus.contract import MS
from palpate_bus.messages import ExamState, OperatorRequest, RobotStatus, SupervisorState, Vector3, Wrench
from palpate_bus.messages.stamps import header
from palpate_models.numerics.frames import GRAVITY, Array, apply, inverse
from palpate_models.robot.arm import arm_of, urdf
from palpate_models.robot.kinematics import tool_jacobian, tool_pose
from palpate_models.scenario.load import exam_input

STATE, STATUS, EXAM, SURFACE = "supervisor/state", "robot/status", "exam/state", "perception/surface"


@dataclass(frozen=True)
class Expected:
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


class PlayedArm:
    """An arm at rest in the ready posture without contact, until an attribute is changed."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self.robot = exam_input(rig.settings.scenario).robot
        self._model = pin.buildModelFromXML(urdf(self.robot, geometry=False))
        self._data = self._model.createData()
        self.calm()

    def calm(self) -> None:
        """Return to rest."""
        self.home = arm_of(self.robot).home_rad
        self.q, self.qd = self.home.copy(), np.zeros_like(self.home)
        self.push_N = 0.0
        """Upward force on the tool [N]."""
        self.mode, self.reason = RobotStatus.MODE_ACTIVE, ""

    def feed(self, *without: str) -> Feed:
        """Return the periodic inputs of the supervisor without some topics."""
        return {name: source for name, source in ((STATUS, self._status), (EXAM, self._exam)) if name not in without}

    def _status(self, t: int) -> Any:
        q, push_W = np.nan_to_num(self.q), np.array((0.0, 0.0, self.push_N))
        force = tool_pose(q, self.robot)[:3, :3].T @ (push_W - np.array((0.0, 0.0, self.robot.tool_mass_kg * GRAVITY)))
        torque = pin.rnea(self._model, self._data, q, self.qd, np.zeros_like(q)) - tool_jacobian(q, self.robot)[:3].T @ push_W
        wrench = Wrench(Vector3(*sensed(force, t).tolist()), Vector3(*sensed(np.zeros(3), t).tolist()))
        cause = RobotStatus.CAUSE_COMMAND_EXPIRED if self.reason else RobotStatus.CAUSE_NONE
        q, qd, torque = sensed(self.q, t), sensed(self.qd, t), sensed(torque, t)
        return RobotStatus(header(t), self.mode, cause, self.reason, q, qd, wrench, np.zeros_like(q), 0, "", torque)

    def _exam(self, t: int) -> Any:
        return exam_state(t, ExamState.PHASE_SCAN, target_count=1)

    def surface(self, t: int, depth: float) -> Any:
        """Return a level surface that lies `depth` [m] above the sphere's lowest point."""
        x, y, z = tool_pose(self.q, self.robot)[:3, 3]
        return level(t, 0.1, 0.01, (x, y, z + depth - self.robot.indenter_radius_m))


def suite(rig: Rig, report: ConformanceReport) -> None:
    """Check measures, each limit, the latch, operator requests, silence and loss."""
    arm = PlayedArm(rig)
    limits = exam_input(rig.settings.scenario).limits
    report.section("rest")
    rest = rig.run(2.0, arm.feed())[STATE]
    if not report.expect("supervisor/state comes", bool(rest), "100 Hz", len(rest)):
        return
    report.expect("an arm at rest is not stopped", _level(rest) == SupervisorState.LEVEL_OK, "LEVEL_OK", _text(rest))
    _swing(rig, arm)
    _measures(rig, arm, report)

    report.section("limits")
    _press(rig, arm, limits.force_soft_stop_n - 1.0)
    arm.push_N = limits.force_soft_stop_n + 1.0
    _stops(rig, arm, report, "a force over the soft-stop limit", STOPPED, SupervisorState.CAUSE_FORCE, EXPECTED.soft_ms)
    received = rig.run(1.0, arm.feed())[STATE]
    report.expect(
        "a soft stop that does not help becomes an emergency stop", _level(received) in EMERGENCY, "level 2", _text(received)
    )
    _refuses(rig, arm, report)
    _released(rig, arm, report, "and is released")
    arm.push_N = limits.force_emergency_n + 10.0
    _stops(rig, arm, report, "a force over the emergency limit", EMERGENCY, SupervisorState.CAUSE_FORCE, EXPECTED.react_ms)
    _released(rig, arm, report, "and is released after it")
    received = _press(rig, arm, limits.force_working_n)
    report.expect(
        "a steady force below the limits is not stopped", _level(received) == SupervisorState.LEVEL_OK, "0", _text(received)
    )
    rig.send(SURFACE, arm.surface(rig.t, limits.depth_m + 0.035))
    _stops(rig, arm, report, "too deep, pressed", STOPPED, SupervisorState.CAUSE_DEPTH, EXPECTED.soft_ms)
    rig.send(SURFACE, arm.surface(rig.t, -0.05))
    _released(rig, arm, report, "and is released above the surface")
    arm.qd = _turning(arm, 2.0 * limits.speed_mps)
    jump = (SupervisorState.CAUSE_SPEED, SupervisorState.CAUSE_SENSOR)  # the played arm jumps to that speed without torques
    _stops(rig, arm, report, "a tool too fast", EMERGENCY, jump, EXPECTED.react_ms)
    _released(rig, arm, report, "and is released at rest")
    _workspace(rig, arm, report)

    report.section("others")
    arm.q = np.full_like(arm.home, np.nan)
    _stops(rig, arm, report, "positions that are not numbers", EMERGENCY, SupervisorState.CAUSE_INVALID, EXPECTED.react_ms)
    _released(rig, arm, report, "and is released with numbers")
    arm.mode, arm.reason = RobotStatus.MODE_SAFE_HOLD, "conformance check"
    _stops(rig, arm, report, "a driver that holds by itself", EMERGENCY, SupervisorState.CAUSE_DRIVER, EXPECTED.react_ms)
    _released(rig, arm, report, "and is released with the driver")
    rig.send("operator/request", OperatorRequest(header(rig.t), OperatorRequest.STOP, "enough"))
    _stops(rig, arm, report, "an operator's stop", EMERGENCY, SupervisorState.CAUSE_OPERATOR, EXPECTED.react_ms)
    received = rig.run(0.5, arm.feed())[STATE]
    ok = _level(received) in EMERGENCY and "enough" in received[-1].message.reason
    report.expect("it stays, with the operator's reason", ok, "level 2, 'enough'", _text(received))
    _released(rig, arm, report, "and is released by the operator")
    for silent in (STATUS, EXAM):
        received = rig.run(EXPECTED.silent_s, arm.feed(silent))[STATE]
        report.expect(
            f"stops when {silent} is silent",
            _level(received) in EMERGENCY,
            f"level 2 within {EXPECTED.silent_s:g} s",
            _text(received),
        )
        _released(rig, arm, report, f"and is released when {silent} is back")
    rig.lose("control")
    _stops(rig, arm, report, "the loss of control", EMERGENCY, SupervisorState.CAUSE_LOST, EXPECTED.react_ms)


def _measures(rig: Rig, arm: PlayedArm, report: ConformanceReport) -> None:
    """Check the reported force, speed and depth."""
    report.section("measures")
    arm.qd = _turning(arm, 0.05)
    rig.send(SURFACE, arm.surface(rig.t, 0.004))
    received = _press(rig, arm, 10.0)
    state = received[-1].message
    report.expect("force is that on the tool", abs(state.force - 10.0) < EXPECTED.force_error_n, "10 N", f"{state.force:.2f} N")
    report.expect("speed is that of the sphere", abs(state.speed - 0.05) < 0.005, "0.05 m/s", f"{state.speed:.4f} m/s")
    report.expect("depth is below the perceived surface", abs(state.depth - 0.004) < 1e-3, "4 mm", f"{state.depth * 1e3:.2f} mm")
    report.expect("and none of them is a reason to stop", state.level == SupervisorState.LEVEL_OK, "LEVEL_OK", _text(received))
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


def _workspace(rig: Rig, arm: PlayedArm, report: ConformanceReport) -> None:
    known = exam_input(rig.settings.scenario)
    low, high = np.array(known.limits.workspace_min_m), np.array(known.limits.workspace_max_m)
    X_AW = inverse(np.array(known.X_WA))
    for q in (np.zeros_like(arm.home), *(np.append(arm.home[0] + turn, arm.home[1:]) for turn in AWAY_RAD)):
        p_A = apply(X_AW, tool_pose(q, arm.robot)[:3, 3])
        if bool(np.any(p_A < low - 0.02) or np.any(p_A > high + 0.02)):
            arm.q = q
            _stops(
                rig, arm, report, "a tool outside the workspace", EMERGENCY, SupervisorState.CAUSE_WORKSPACE, EXPECTED.react_ms
            )
            _released(rig, arm, report, "and is released inside")
            return
    report.skip("stops for a tool outside the workspace", "all postures of this check lie in the workspace")


def _stops(
    rig: Rig,
    arm: PlayedArm,
    report: ConformanceReport,
    what: str,
    levels: tuple[int, ...],
    cause: int | tuple[int, ...],
    within_ms: float,
) -> None:
    """Expect a stop with the right cause, or one of several, and a reason."""
    causes = cause if isinstance(cause, tuple) else (cause,)
    start = rig.t
    received = rig.run(0.5, arm.feed())[STATE]
    first = next((item for item in received if item.message.level in levels), None)
    wanted = f"level {' or '.join(map(str, levels))}, cause {' or '.join(map(str, causes))}, a reason"
    if not report.expect(f"stops for {what}", first is not None, wanted, _text(received)):
        return
    assert first is not None
    state = first.message
    report.expect(f"and states the cause: {what}", state.cause in causes and bool(state.reason), wanted, _text([first]))
    after = (first.t - start - rig.slack) / MS
    report.expect(f"in time: {what}", after <= within_ms, f"within {within_ms:.0f} ms", f"{after:.0f} ms")


def _refuses(rig: Rig, arm: PlayedArm, report: ConformanceReport) -> None:
    """Expect that a release is refused while the force is still present."""
    rig.send("operator/request", OperatorRequest(header(rig.t), OperatorRequest.RELEASE, "conformance check"))
    received = rig.run(0.3, arm.feed())[STATE]
    report.expect(
        "a release is refused while its cause is present", _level(received) in STOPPED, "still stopped", _text(received)
    )


def _released(rig: Rig, arm: PlayedArm, report: ConformanceReport, name: str) -> None:
    """Expect that a stop stays when its cause is gone, and ends on release, which is counted."""
    arm.calm()
    received = rig.run(0.5, arm.feed())[STATE]
    stays = _level(received) in STOPPED
    before = received[-1].message.releases if received else 0
    rig.send("operator/request", OperatorRequest(header(rig.t), OperatorRequest.RELEASE, "conformance check"))
    received = rig.run(0.5, arm.feed())[STATE]
    ok = stays and _level(received) == SupervisorState.LEVEL_OK and received[-1].message.releases == before + 1
    got = _text(received) if stays else "the stop ended without a release"
    report.expect(name, ok, "stopped until released, then level 0 and one more release", got)


def _level(received: list[ReceivedMessage]) -> int | None:
    return int(received[-1].message.level) if received else None


def _text(received: list[ReceivedMessage]) -> str:
    if not received:
        return "nothing"
    state = received[-1].message
    return f"level {state.level}, cause {state.cause}{f': {state.reason}' if state.reason else ''}"
