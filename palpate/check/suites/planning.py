"""Role planning: the suite plays an arm that follows, up to the burst of depth frames; then an operator stops it."""

from typing import Any

import numpy as np

from palpate.check.report import ConformanceReport
from palpate.check.rig import Feed, ReceivedMessage, Rig, sensed
from palpate_bus.contract import MS
from palpate_bus.messages import ExamState, ImpedanceSetpoint, OperatorRequest, RobotStatus, Vector3, Wrench
from palpate_bus.messages.stamps import header, nanoseconds
from palpate_models.numerics.frames import Array
from palpate_models.robot.arm import arm_of
from palpate_models.robot.chain import Arm

SETPOINT, STATE = "planning/setpoint", "exam/state"
WEIGHT_N = 6.0
AWAIT_S = 20.0


class PerfectFollower:
    """An arm that is always at the last joint set-point; it starts at the ready posture."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self.arm: Arm = arm_of(rig.settings.scenario.robot)
        self.q = self.arm.home_rad.copy()
        self.mode = RobotStatus.MODE_ACTIVE

    def feed(self) -> Feed:
        """Return the inputs of planning."""
        return {"robot/status": self._status}

    def _status(self, t: int) -> Any:
        setpoint = self._rig.last(SETPOINT)
        velocity = np.zeros_like(self.q)
        if setpoint is not None and setpoint.mode == ImpedanceSetpoint.MODE_JOINT and self.mode == RobotStatus.MODE_ACTIVE:
            self.q, velocity = np.array(setpoint.joint_position), np.array(setpoint.joint_velocity)
        weight = Wrench(Vector3(*sensed((0.0, 0.0, WEIGHT_N), t).tolist()), Vector3(*sensed(np.zeros(3), t).tolist()))
        cause = RobotStatus.CAUSE_STOP_REQUESTED if self.mode == RobotStatus.MODE_SAFE_HOLD else RobotStatus.CAUSE_NONE
        reason = "conformance check" if cause else ""
        return RobotStatus(
            header(t),
            self.mode,
            cause,
            reason,
            sensed(self.q, t),
            sensed(velocity, t),
            weight,
            np.zeros_like(self.q),
            0,
            "",
            sensed(np.zeros_like(self.q), t),
        )


def suite(rig: Rig, report: ConformanceReport) -> None:
    """Check set-points, the phases up to the first camera burst, and a stop."""
    report.section("set-points")
    arm = PerfectFollower(rig)
    rig.run(0.5, arm.feed())
    received = rig.log[SETPOINT]
    if not report.expect("set-points come", bool(received), "100 Hz", len(received)):
        return
    _first(arm.arm, received, report)
    report.section("examination")
    waited = 0.0
    while not rig.log["planning/camera_trigger"] and waited < AWAIT_S:
        rig.run(0.5, arm.feed())
        waited += 0.5
    triggers = rig.log["planning/camera_trigger"]
    report.expect(
        "asks for depth frames",
        bool(triggers),
        f"a camera_trigger within {AWAIT_S:.0f} s",
        f"{len(triggers)} after {waited:.1f} s",
    )
    wanted = rig.settings.scenario.camera.frames
    if triggers:
        report.expect("as many as in the scenario", triggers[0].message.frames == wanted, wanted, triggers[0].message.frames)
    _safe(arm.arm, rig.log[SETPOINT], report)
    _phases(rig.log[STATE], report)
    report.section("stop")
    arm.mode = RobotStatus.MODE_SAFE_HOLD
    rig.send("operator/request", OperatorRequest(header(rig.t), OperatorRequest.STOP, "conformance check"))
    after = rig.run(1.0, arm.feed())
    held = {getattr(ExamState, name) for name in ("PHASE_ABORTED", "PHASE_HELD") if hasattr(ExamState, name)}
    state = rig.last(STATE)
    ok = state is not None and int(state.phase) in held and bool(state.message)
    report.expect(
        "an operator's stop ends or holds the examination, with the reason",
        ok,
        "aborted or held",
        "no state" if state is None else f"phase {state.phase}: {state.message}",
    )
    q = np.array([item.message.joint_position for item in after[SETPOINT][20:]])
    moved = float(np.max(np.abs(q - q[0]))) if len(q) else 0.0
    report.expect("and its set-points stand still", moved < 0.05, "below 0.05 rad in a second", f"{moved:.3f} rad")
    report.section("silence")
    quiet = rig.run(0.5, {})
    report.expect("continues without robot/status", len(quiet[STATE]) > 0, "exam/state at its rate", len(quiet[STATE]))


def _first(arm: Arm, received: list[ReceivedMessage], report: ConformanceReport) -> None:
    """Check that the first set-point is at the arm's position."""
    message = received[0].message
    if message.mode == ImpedanceSetpoint.MODE_JOINT:
        off = float(np.max(np.abs(np.asarray(message.joint_position) - arm.home_rad)))
        report.expect("the first set-point is where the arm is", off < 0.02, "within 0.02 rad", f"{off:.4f} rad")
    else:
        report.skip("the first set-point is where the arm is", "it is not of mode JOINT")


def _safe(arm: Arm, received: list[ReceivedMessage], report: ConformanceReport) -> None:
    joint = [item.message for item in received if item.message.mode == ImpedanceSetpoint.MODE_JOINT]
    q = np.array([m.joint_position for m in joint])
    t = np.array([nanoseconds(m.header.stamp) / 1e9 for m in joint])
    inside = bool(np.all((q >= arm.lower_rad) & (q <= arm.upper_rad)))
    report.expect("joint targets stay within the limits", inside, "the arm's", np.abs(q).max(axis=0).round(2))
    speed: Array = np.abs(np.diff(q, axis=0)) / np.maximum(np.diff(t), 1e-3)[:, None]
    worst = speed.max(axis=0) if len(speed) else np.zeros(arm.joints)
    report.expect(
        "and move no faster than the joints can",
        bool(np.all(worst <= arm.velocity_radps)),
        arm.velocity_radps.round(2),
        worst.round(2),
    )
    valid = [nanoseconds(item.message.valid_for) for item in received]
    ok = all(0 < value <= 250 * MS for value in valid)
    report.expect("every set-point expires", ok, "0 to 250 ms", f"{min(valid) / MS:.0f} to {max(valid) / MS:.0f} ms")
    cartesian = [item.message for item in received if item.message.mode == ImpedanceSetpoint.MODE_CARTESIAN]
    unit = max((abs(_norm(m.pose.orientation) - 1) for m in cartesian), default=0.0)
    report.expect("orientations are unit quaternions", unit < 1e-3, "length 1", f"{unit:.2g} off")


def _norm(q: Any) -> float:
    return float(np.sqrt(q.x**2 + q.y**2 + q.z**2 + q.w**2))


def _phases(received: list[ReceivedMessage], report: ConformanceReport) -> None:
    phases = list(dict.fromkeys(int(item.message.phase) for item in received))
    ok = phases == sorted(phases) and phases[-1] <= ExamState.PHASE_PLAN
    report.expect("phases follow their order", ok, "HOME, LOOK, PLAN", phases)
    undecided = all(item.message.end_tick < 0 for item in received)
    report.expect("no end is announced yet", undecided, "end_tick -1", "as expected" if undecided else "decided")
