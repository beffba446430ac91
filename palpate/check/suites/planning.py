"""Role planning: the suite plays an arm that follows, up to the burst of depth frames; then an operator stops it."""

from typing import Any, Final, NamedTuple

import numpy as np

from palpate.check.rig import Feed, ReceivedMessage, Rig, robot_status
from palpate_bus.messages import (
    MS,
    ExamState,
    ImpedanceSetpoint,
    OperatorRequest,
    RobotStatus,
    SupervisorState,
    header,
    nanoseconds,
)
from palpate_models.numerics.frames import Array
from palpate_models.robot.arm import arm_of
from palpate_models.robot.chain import Arm

SETPOINT, STATE = "planning/setpoint", "exam/state"


class PlanningRig(NamedTuple):
    """The simulated arm and the patience of the suite."""

    weight_n: float = 6.0
    await_s: float = 20.0
    settle_setpoints: int = 20
    """Set-points after the stop in which the arm may still come to rest."""


RIG: Final = PlanningRig()
STOP_REASON = "conformance check of the stop"


class PerfectFollower:
    """An arm that is always at the last joint set-point; it starts at the ready posture."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self.arm: Arm = arm_of(rig.settings.scenario.robot)
        self.q = self.arm.home_rad.copy()
        self.mode = RobotStatus.MODE_ACTIVE

    def feed(self) -> Feed:
        """Return the inputs of planning."""
        return {"robot/status": self._status, "supervisor/state": _supervise}

    def _status(self, t: int) -> Any:
        setpoint = self._rig.last(SETPOINT)
        velocity = np.zeros_like(self.q)
        if setpoint is not None and setpoint.mode == ImpedanceSetpoint.MODE_JOINT and self.mode == RobotStatus.MODE_ACTIVE:
            self.q, velocity = np.array(setpoint.joint_position), np.array(setpoint.joint_velocity)
        cause = RobotStatus.CAUSE_STOP_REQUESTED if self.mode == RobotStatus.MODE_SAFE_HOLD else RobotStatus.CAUSE_NONE
        reason = "conformance check" if cause else ""
        return robot_status(t, self.q, velocity, (0.0, 0.0, RIG.weight_n), np.zeros_like(self.q), self.mode, cause, reason)


def _supervise(t: int) -> Any:
    return SupervisorState(header(t), SupervisorState.LEVEL_OK, SupervisorState.CAUSE_NONE, "", 0, 0.0, -1.0, 0.0, 0, "", 0.0)


def suite(rig: Rig) -> None:
    """Check set-points, the phases up to the first camera burst, and a stop."""
    rig.section("set-points")
    arm = PerfectFollower(rig)
    rig.run(0.5, arm.feed())
    received = rig.log[SETPOINT]
    if not rig.expect("set-points come", bool(received), "100 Hz", len(received)):
        return
    _first(rig, arm.arm, received)
    rig.section("examination")
    triggers = rig.await_message("planning/camera_trigger", RIG.await_s, arm.feed())
    if rig.arrives("asks for depth frames", triggers, f"a camera_trigger within {RIG.await_s:.0f} s"):
        rig.equal("as many as in the scenario", triggers[0].message.frames, rig.settings.scenario.camera.frames)
    _safe(rig, arm.arm, rig.log[SETPOINT])
    _phases(rig, rig.log[STATE])
    rig.section("stop")
    rig.send("operator/request", OperatorRequest(header(rig.t), OperatorRequest.STOP, STOP_REASON))
    arm.mode = RobotStatus.MODE_SAFE_HOLD  # as the driver, which obeys at once
    after = rig.run(1.0, arm.feed())
    state = rig.last(STATE)
    ok = state is not None and state.phase in (ExamState.PHASE_ABORTED, ExamState.PHASE_HELD) and STOP_REASON in state.message
    got = "no state" if state is None else f"phase {state.phase}: {state.message}"
    rig.expect("an operator's stop ends or holds the examination, with the operator's reason", ok, "aborted or held", got)
    q = np.array([item.message.joint_position for item in after[SETPOINT][RIG.settle_setpoints :]])
    if rig.expect("set-points continue after the stop", len(q) > 1, "100 Hz", len(q)):
        rig.below("and stand still", np.max(np.abs(q - q[0])), 0.05, "rad in a second")
    rig.section("silence")
    quiet = rig.run(0.5, {})
    rig.expect("continues without robot/status", len(quiet[STATE]) > 0, "exam/state at its rate", len(quiet[STATE]))


def _first(rig: Rig, arm: Arm, received: list[ReceivedMessage]) -> None:
    """Check that the first set-point is at the arm's position."""
    message = received[0].message
    if message.mode == ImpedanceSetpoint.MODE_JOINT:
        off = np.max(np.abs(np.asarray(message.joint_position) - arm.home_rad))
        rig.below("the first set-point is where the arm is", off, 0.02, "rad off")
    else:
        rig.skip("the first set-point is where the arm is", "it is not of mode JOINT")


def _safe(rig: Rig, arm: Arm, received: list[ReceivedMessage]) -> None:
    rig.within("every set-point expires", [nanoseconds(item.message.valid_for) / MS for item in received], 1e-6, 250, "ms")
    cartesian = [item.message for item in received if item.message.mode == ImpedanceSetpoint.MODE_CARTESIAN]
    quaternions = [m.pose.orientation for m in cartesian]
    off = max((abs(np.linalg.norm((q.x, q.y, q.z, q.w)) - 1) for q in quaternions), default=0.0)
    rig.below("orientations are unit quaternions", off, 1e-3, "off a length of 1")
    joint = [item.message for item in received if item.message.mode == ImpedanceSetpoint.MODE_JOINT]
    if not joint:
        rig.skip("joint targets stay within the limits of position and velocity", "no set-point of mode JOINT")
        return
    q = np.array([m.joint_position for m in joint])
    t = np.array([nanoseconds(m.header.stamp) / 1e9 for m in joint])
    inside = bool(np.all((q >= arm.lower_rad) & (q <= arm.upper_rad)))
    rig.expect("joint targets stay within the limits", inside, "the arm's", np.abs(q).max(axis=0).round(2))
    speed: Array = np.abs(np.diff(q, axis=0)) / np.maximum(np.diff(t), 1e-3)[:, None]
    worst = speed.max(axis=0) if len(speed) else np.zeros(arm.joints)
    slow = bool(np.all(worst <= arm.velocity_radps))
    rig.expect("and move no faster than the joints can", slow, arm.velocity_radps.round(2), worst.round(2))


def _phases(rig: Rig, received: list[ReceivedMessage]) -> None:
    phases = list(dict.fromkeys(int(item.message.phase) for item in received))
    ok = bool(phases) and phases == sorted(phases) and phases[-1] <= ExamState.PHASE_PLAN
    rig.expect("phases follow their order", ok, "HOME, LOOK, PLAN", phases)
    rig.expect("no end is announced yet", all(item.message.end_tick < 0 for item in received), "end_tick -1")
