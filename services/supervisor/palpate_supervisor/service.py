"""The supervisor on the bus: messages to numbers and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from palpate_bus.contract import MS, contract
from palpate_bus.messages import OperatorRequest, RobotStatus, SupervisorState
from palpate_bus.messages.geometry import wrench
from palpate_bus.messages.stamps import NS, header, nanoseconds
from palpate_bus.service import Inbox, Outbox, Service
from palpate_models.numerics.frames import inverse
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import ExamInput, Scenario
from palpate_supervisor.latch import Latch
from palpate_supervisor.tool import RestSurface, Tool, ToolSense
from palpate_supervisor.watch import Breach, Cause, Level, LimitWatch

NOWHERE = -1.0
"""Depth [m] while no surface is known."""
MISSED = (("control", Level.EMERGENCY), ("planning", Level.EMERGENCY), ("assessment", Level.SOFT_STOP))
"""Roles and what their loss calls for: without the first two the arm must stand still, without assessment there is no reason to
go on pressing."""
RETREAT = 4000 * MS
"""So long planning may take to be out of contact and on the way home after a loss [ns]; nothing brings the lost one back."""
WATCHED = ("robot/status", "exam/state")
"""Topics whose age is watched: the arm's and planning's."""
SETTLE = 1000 * MS
"""Ages are not judged for so long after the start [ns]: processes come up one by one."""


class SupervisorService(Service):
    """Watches the examination and stops it. It knows no more about control and planning than whether they are alive."""

    role: ClassVar[str] = "supervisor"

    def __init__(self, known: ExamInput) -> None:
        self._radius = known.robot.indenter_radius_m
        self._sense = ToolSense(known.robot)
        self._watch = LimitWatch(known.limits, inverse(np.array(known.X_WA)))
        self._surface: RestSurface | None = None
        RestSurface(np.zeros((1, 3)), np.zeros((1, 3)), self._radius).depth(np.zeros(3))  # compiles it ahead of any deadline
        self._max_age = contract().topics["planning/setpoint"].expiry
        """Age [ns] at which a topic counts as silent: when set-points expire. Control and driver watch their inputs, faster."""
        self._latch = Latch()
        self._began: int | None = None
        self._tool = Tool(np.zeros(3), 0.0, 0.0)
        self._measured: list[Breach] = []
        self._stamp: int | None = None
        self._stamped = 0
        """When the newest measurement was first heard [ns]."""
        self._depth = NOWHERE
        self._peak_force = self._peak_speed = 0.0

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """One period: measure, judge, latch."""
        release = False
        breaches = self._presence(t, inbox)
        for request in inbox.new("operator/request"):
            if request.request == OperatorRequest.STOP:
                breaches.append(Breach(Level.EMERGENCY, Cause.OPERATOR, f"stopped by the operator: {request.reason}"))
            elif request.request == OperatorRequest.SOFT_STOP:
                breaches.append(Breach(Level.SOFT_STOP, Cause.OPERATOR, f"stopped softly by the operator: {request.reason}"))
            elif request.request in (OperatorRequest.RELEASE, OperatorRequest.END):
                release = True
            else:
                words = f"operator/request: request = {request.request} is unknown, which counts as a stop"
                breaches.append(Breach(Level.EMERGENCY, Cause.INVALID, words))
        for mesh in inbox.new("perception/surface"):
            breaches += self._perceive(mesh)
        if inbox.new("robot/status"):
            self._measured = self._measure(t, inbox.latest("robot/status"))
        breaches += self._measured  # what was measured stands until it is measured again
        self._latch.update(t, breaches, release)
        latch, tool = self._latch, self._tool
        state = SupervisorState(
            header(t), int(latch.level), int(latch.cause), latch.reason, latch.releases, tool.force, self._depth, tool.speed,
            latch.refusals,
        )  # fmt: skip
        return {"supervisor/state": state}

    def finish(self) -> Mapping[str, Any]:
        """Every stop with its cause, granted releases, and the largest force [N] and speed [m/s] seen."""
        stops = [
            {"t_s": stop.t / NS, "level": stop.level.name, "cause": stop.cause.name, "reason": stop.reason}
            for stop in self._latch.stops
        ]
        return {
            "stops": stops,
            "releases": self._latch.releases,
            "peak_external_force_N": self._peak_force,
            "peak_tool_speed_mps": self._peak_speed,
        }

    def _presence(self, t: int, inbox: Inbox) -> list[Breach]:
        """Who is gone, and who has said nothing for too long."""
        gone = [(role, level) for role, level in MISSED if inbox.lost(role)]
        found = [Breach(level, Cause.LOST, f"the service of role {role} is gone", RETREAT) for role, level in gone]
        self._began = t if self._began is None else self._began
        if t - self._began <= SETTLE:
            return found
        for name in WATCHED:
            heard = inbox.stamp(name)
            if heard is not None and t - heard > self._max_age:
                words = f"nothing on {name} for {(t - heard) / 1e6:.0f} ms, limit {self._max_age / 1e6:.0f} ms"
                found.append(Breach(Level.EMERGENCY, Cause.SILENT, words))
        return found

    def _perceive(self, mesh: Any) -> list[Breach]:
        if not len(mesh.vertices):
            return []
        try:
            vertices = np.asarray(mesh.vertices, dtype=float).reshape(-1, 3)
            normals = np.asarray(mesh.normals, dtype=float).reshape(-1, 3)
            self._surface = RestSurface(vertices, normals, self._radius)
        except ValueError as error:
            return [Breach(Level.SOFT_STOP, Cause.INVALID, f"perception/surface: {error}")]
        return []

    def _measure(self, t: int, status: Any) -> list[Breach]:
        values = {"position": status.position, "velocity": status.velocity, "wrench": wrench(status.wrench)}
        for name, value in values.items():
            if not np.isfinite(value).all():
                return [Breach(Level.EMERGENCY, Cause.INVALID, f"robot/status: {name} = {value}: must be finite")]
        self._tool = tool = self._sense.sense(*values.values())
        self._peak_force = max(self._peak_force, tool.force)
        self._peak_speed = max(self._peak_speed, tool.speed)
        depth = None if self._surface is None else self._surface.depth(tool.p_W)
        self._depth = NOWHERE if depth is None else min(max(depth, NOWHERE), 0.2)
        stamp = nanoseconds(status.header.stamp)
        if stamp != self._stamp:
            self._stamp, self._stamped = stamp, t
        found = self._watch.judge(tool, depth, stamp, t)
        if t - self._stamped > self._max_age:
            words = f"robot/status repeats what was measured {(t - self._stamped) / 1e6:.0f} ms ago"
            found.append(Breach(Level.EMERGENCY, Cause.SILENT, f"{words}, limit {self._max_age / 1e6:.0f} ms"))
        if status.mode == RobotStatus.MODE_SAFE_HOLD:
            found.append(Breach(Level.EMERGENCY, Cause.DRIVER, f"the driver holds safely: {status.reason}"))
        return found


def create(scenario: Scenario) -> SupervisorService:
    """The supervisor of a scenario; it gets no phantom."""
    return SupervisorService(exam_input(scenario))
