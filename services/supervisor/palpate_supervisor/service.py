"""Supervisor service: converts messages to numbers and publishes the latched stop."""

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np

from palpate_bus.contract import contract
from palpate_bus.messages import MS, NS, OperatorRequest, RobotStatus, SupervisorState, header, nanoseconds
from palpate_bus.messages.codes import StopCause, StopLevel
from palpate_bus.messages.geometry import vector, wrench
from palpate_bus.service import Inbox, Outbox, Service
from palpate_models.numerics.frames import inverse
from palpate_models.robot.arm import arm_of
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import CommandLevel, ExamInput, Scenario
from palpate_supervisor.judge import Breach, DepthAgreement, LimitWatch, MotionAgreement, SensorJudge
from palpate_supervisor.latch import RECOVERABLE, RECOVERABLE_STIFF, Latch
from palpate_supervisor.senses import Measurement, RestSurface, Tool, ToolSense

LOSS_LEVELS = (("control", StopLevel.EMERGENCY), ("planning", StopLevel.EMERGENCY), ("assessment", StopLevel.SOFT_STOP))
"""Stop level when a role is lost. Without control or planning the arm must stand still; without assessment pressing is
pointless."""
WATCHED = ("robot/status", "exam/state")
"""Topics whose age is checked."""


class ServiceTuning(NamedTuple):
    """Delays of the presence checks and the range of the published depth."""

    retreat_ns: int = 4000 * MS
    """Time that planning has to leave contact after a role is lost; a lost role does not come back."""
    settle_ns: int = 1000 * MS
    """Ages are not checked for this long after the start: processes start one by one."""
    no_depth_m: float = -1.0
    """Published depth while there is no surface, and its lower bound."""
    deepest_m: float = 0.2
    """Upper bound of the published depth."""
    clear_m: float = 0.1
    """A tool this high above the perceived surface, and at rest, touches nothing: both senses are tared."""


TUNING = ServiceTuning()


class SupervisorService(Service):
    """Watches the examination and stops it. Of control and planning it uses only whether they are alive."""

    role: ClassVar[str] = "supervisor"

    def __init__(self, known: ExamInput) -> None:
        self._radius = known.robot.indenter_radius_m
        self._sense = ToolSense(known.robot)
        self._watch = LimitWatch(known.limits, inverse(np.array(known.X_WA)))
        self._surface: RestSurface | None = None
        arm = arm_of(known.robot)
        still = Measurement(arm.home_rad.copy(), np.zeros(arm.joints), np.zeros(6), np.zeros(arm.joints))
        ToolSense(known.robot).sense(still, 0.01)  # compiles it before the first deadline
        RestSurface(np.zeros((1, 3)), np.zeros((1, 3)), self._radius).depth(np.zeros(3))  # compiles it before the first deadline
        self._max_age = contract().topics["planning/setpoint"].expiry
        """Age limit of watched topics [ns]: the expiry of set-points. Control and driver check their own inputs faster."""
        self._judge, self._agreement, self._stated = SensorJudge(), MotionAgreement(), DepthAgreement(self._radius)
        self._disagreeing: list[Breach] = []
        self._latch = Latch(RECOVERABLE_STIFF if known.robot.level is CommandLevel.POSITION else RECOVERABLE)
        self._began: int | None = None
        self._tool = Tool(np.zeros(3), 0.0, 0.0)
        self._measured: list[Breach] = []
        self._stamp: int | None = None
        self._depth = TUNING.no_depth_m
        self._peak_force = self._peak_speed = 0.0

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Run one period: measure, judge, latch."""
        release = False
        breaches = self._presence(t, inbox)
        for request in inbox.new("operator/request"):
            if request.request == OperatorRequest.STOP:
                breaches.append(Breach(StopLevel.EMERGENCY, StopCause.OPERATOR, f"stopped by the operator: {request.reason}"))
            elif request.request == OperatorRequest.SOFT_STOP:
                breaches.append(Breach(StopLevel.SOFT_STOP, StopCause.OPERATOR, f"soft stop by the operator: {request.reason}"))
            elif request.request in (OperatorRequest.RELEASE, OperatorRequest.END):
                release = True
            else:
                reason = f"operator/request: unknown request {request.request} is treated as a stop"
                breaches.append(Breach(StopLevel.EMERGENCY, StopCause.INVALID, reason, culprit="operator/request"))
        for mesh in inbox.new("perception/surface"):
            breaches += self._take_surface(mesh)
        if measured := list(inbox.new("robot/status")):  # several after a late step: the joints' force follows from each
            self._measured = [breach for status in measured for breach in self._measure(t, status)]
            newest = measured[-1]
            if newest.mode == RobotStatus.MODE_SAFE_HOLD:
                held = f"safe hold of the driver: {newest.reason}"
                self._measured += [Breach(StopLevel.EMERGENCY, StopCause.DRIVER, held, culprit=newest.culprit, hold=newest.cause)]
        breaches += self._measured  # valid until the next measurement
        for stated in inbox.new("exam/state"):
            skin_W = vector(stated.surface_point), vector(stated.surface_normal)
            breaches += self._stated.judge(stated, skin_W, self._tool.p_W)
        self._latch.update(t, breaches, release)
        latch, tool = self._latch, self._tool
        state = SupervisorState(
            header(t), int(latch.level), int(latch.cause), latch.reason, latch.releases, tool.force, self._depth, tool.speed,
            latch.refusals, latch.culprit, tool.joint_force,
        )  # fmt: skip
        return {"supervisor/state": state}

    def finish(self) -> Mapping[str, Any]:
        """Return all stops with their cause, all and own releases, and the largest force [N] and speed [m/s]."""
        stops = [
            {"t_s": stop.t / NS, "level": stop.level.name, "cause": stop.cause.name, "reason": stop.reason}
            for stop in self._latch.stops
        ]
        return {
            "stops": stops,
            "releases": self._latch.releases,
            "own_releases": self._latch.own_releases,
            "peak_external_force_N": self._peak_force,
            "peak_tool_speed_mps": self._peak_speed,
        }

    def _presence(self, t: int, inbox: Inbox) -> list[Breach]:
        """Return breaches for lost roles and for watched topics that are too old."""
        found = [
            Breach(level, StopCause.LOST, f"the service of role {role} is lost", TUNING.retreat_ns, culprit=role)
            for role, level in LOSS_LEVELS
            if inbox.lost(role)
        ]
        self._began = t if self._began is None else self._began
        if t - self._began <= TUNING.settle_ns:
            return found
        for name in WATCHED:
            received = inbox.stamp(name)
            if received is not None and t - received > self._max_age:
                reason = f"no message on {name} for {(t - received) / 1e6:.0f} ms, limit {self._max_age / 1e6:.0f} ms"
                found.append(Breach(StopLevel.EMERGENCY, StopCause.SILENT, reason, culprit=name))
        return found

    def _take_surface(self, mesh: Any) -> list[Breach]:
        if not len(mesh.vertices):
            return []
        try:
            vertices = np.asarray(mesh.vertices, dtype=float).reshape(-1, 3)
            normals = np.asarray(mesh.normals, dtype=float).reshape(-1, 3)
            self._surface = RestSurface(vertices, normals, self._radius)
        except ValueError as error:
            return [Breach(StopLevel.SOFT_STOP, StopCause.INVALID, f"perception/surface: {error}", culprit="perception/surface")]
        return []

    def _measure(self, t: int, status: Any) -> list[Breach]:
        if not len(status.position):  # the arm reports none
            self._agreement = MotionAgreement()
            return []
        # Arrays of messages are read-only, a different type for numba.
        measured = Measurement(
            np.array(status.position), np.array(status.velocity), wrench(status.wrench), np.array(status.measured_torque)
        )
        stamp = nanoseconds(status.header.stamp)
        if stamp != self._stamp:
            since_s = 0.0 if self._stamp is None else (stamp - self._stamp) / NS
            self._stamp = stamp
            clear = self._surface is not None and self._depth < -TUNING.clear_m
            self._tool = self._sense.sense(measured, since_s, clear)
            self._disagreeing = self._agreement.judge(measured, since_s)
        tool = self._tool
        self._peak_force = max(self._peak_force, tool.force)
        self._peak_speed = max(self._peak_speed, tool.speed)
        depth, above = (TUNING.no_depth_m, False) if self._surface is None else self._surface.depth(tool.p_W)
        self._depth = min(max(depth, TUNING.no_depth_m), TUNING.deepest_m)
        known = depth if above else None
        found = self._watch.judge(tool, known, stamp, t) + self._judge.judge(self._sense.comparison, known)
        return found + self._disagreeing


def create(scenario: Scenario) -> SupervisorService:
    """Return the supervisor of a scenario; it uses the exam input only."""
    return SupervisorService(exam_input(scenario))
