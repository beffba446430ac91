"""Planning as a service: messages to arrays and back. The examination itself is `exam`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from math import isfinite
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from palpate_bus.contract import MS
from palpate_bus.messages import CameraTrigger, OperatorRequest, RobotStatus, SupervisorState
from palpate_bus.messages.codec import Message
from palpate_bus.messages.stamps import duration_message, header
from palpate_bus.runtime import priority
from palpate_bus.service import Inbox, Outbox, Service
from palpate_bus.settings import Settings
from palpate_models.load import exam_input
from palpate_models.scenario import ExamInput, Scenario
from palpate_planning.exam import Exam
from palpate_planning.measure import Reading
from palpate_planning.messages import path_message, setpoint_message, state_message
from palpate_planning.prepare import Seen
from palpate_planning.status import Observation, Phase, Unseen
from palpate_planning.surface import Surface
from palpate_planning.thinking import WORKER

Array = NDArray[np.float64]

VALID_FOR = 250 * MS
"""The contract's expiry of planning/setpoint."""
SUPERVISOR_AGE = 250 * MS
"""A supervisor that has said nothing for so long is gone: nothing is pressed that nobody watches."""
NEEDED = ("robot", "assessment", "supervisor")
"""Roles whose loss ends the exam, whatever its phase."""
NEEDED_TO_SEE = (*NEEDED, "camera", "perception")
"""Roles whose loss ends it until the targets are there."""
SEEING = frozenset({Phase.HOME, Phase.LOOK})
"""Phases in which they are not."""


class PlanningService(Service):
    """Runs the examination of a scenario."""

    role: ClassVar[str] = "planning"

    def __init__(self, known: ExamInput, *, lockstep: bool = True) -> None:
        """`lockstep` as in `Exam`."""
        self._known = known
        self._X_WA = np.array(known.X_WA)
        _let_the_worker_give_way()
        self._exam = Exam(known, lockstep=lockstep)
        self._reading: Reading | None = None
        self._surface: Message | None = None
        self._valid = duration_message(VALID_FOR)
        self._peak_force = 0.0
        self._unreadable = 0

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """One planning period: what is measured, what the exam makes of it, what is to be done."""
        status = inbox.latest("robot/status")
        if status is not None:
            self._read(status)
        requests = tuple(inbox.new("operator/request"))
        stop, soft = _stop(status, inbox.latest("supervisor/state"), requests)
        outcome = self._exam.step(
            Observation(
                t=t,
                reading=self._reading,
                seen=self._perceived(inbox),
                findings_final=any(message.final for message in inbox.new("assessment/findings")),
                stop=stop,
                soft=soft,
                end=_end(requests),
                lost=self._lost(t, inbox),
            )
        )
        contact = outcome.contact
        if contact is not None and contact.touching:
            self._peak_force = max(self._peak_force, contact.force)
        outbox: dict[str, Message | list[Message]] = {
            "planning/setpoint": setpoint_message(t, outcome.setpoint, self._valid),
            "exam/state": state_message(t, self._exam.status, contact),
        }
        if outcome.trigger:
            outbox["planning/camera_trigger"] = CameraTrigger(header(t), self._known.camera.frames)
        if outcome.path is not None:
            outbox["planning/path"] = path_message(t, outcome.path)
        return outbox

    def finish(self) -> Mapping[str, Any]:
        """Phase reached, targets, skipped targets with reasons, highest measured force [N]."""
        status = self._exam.status
        return {
            "phase": status.phase.name,
            "message": status.message,
            "targets": status.target_count,
            "skipped_targets": {str(i): why for i, why in sorted(self._exam.skipped.items())},
            "peak_force_N": self._peak_force,
            "unreadable_statuses": self._unreadable,
            "surface_offset_m": self._exam.surface_offset,
        }

    def _read(self, status: Message) -> None:
        """Joint positions and wrench as the robot averages them over a period: force and depth of the same moment."""
        force, moment = status.wrench.force, status.wrench.torque
        wrench = (force.x, force.y, force.z, moment.x, moment.y, moment.z)
        if not all(map(isfinite, (*status.position.tolist(), *status.velocity.tolist(), *wrench))):
            self._unreadable += 1  # nothing to go by: the supervisor stops the arm, the last reading stands until then
            return
        self._reading = Reading(status.position.copy(), np.array(wrench), status.velocity.copy())

    def _perceived(self, inbox: Inbox) -> Seen | Unseen | None:
        """Perception's newest answer, if one came."""
        for message in inbox.new("perception/surface"):
            self._surface = message
        answer = None
        for message in inbox.new("perception/targets"):
            answer = self._seen(message)
        return answer

    def _seen(self, targets: Message) -> Seen | Unseen:
        mesh = self._surface
        if not len(targets.positions) or mesh is None:
            return Unseen(targets.message or "perception found no targets")
        vertices = np.asarray(mesh.vertices, dtype=float).reshape(-1, 3)
        normals = np.asarray(mesh.normals, dtype=float).reshape(-1, 3)
        try:
            surface = Surface.from_mesh(vertices, normals, self._X_WA)
        except ValueError as error:
            return Unseen(f"perception/surface: {error}")
        return Seen(
            positions=np.array([(p.x, p.y, p.z) for p in targets.positions]),
            lines=np.asarray(targets.lines, dtype=np.int64),
            vertices=vertices,
            triangles=np.asarray(mesh.triangles, dtype=np.int64).reshape(-1, 3),
            surface=surface,
            noise=float(targets.surface_noise),
        )

    def _lost(self, t: int, inbox: Inbox) -> tuple[str, ...]:
        needed = NEEDED_TO_SEE if self._exam.status.phase in SEEING else NEEDED
        gone = tuple([role for role in needed if inbox.lost(role)])
        heard = inbox.stamp("supervisor/state")
        if heard is not None and t - heard > SUPERVISOR_AGE:
            gone += (f"the supervisor, silent for {(t - heard) / MS:.0f} ms",)
        return gone


def _stop(status: Message | None, state: Message | None, requests: tuple[Message, ...]) -> tuple[str, bool]:
    """Why the arm must rest, empty when all is well; and whether planning is to retreat rather than the driver to hold.

    `status` is the robot's newest, `state` the supervisor's.
    """
    for request in requests:
        if request.request == OperatorRequest.STOP:
            return f"stopped by the operator: {request.reason}", False
    if status is not None and status.mode == RobotStatus.MODE_SAFE_HOLD:
        return f"the driver holds safely: {status.reason}", False
    if state is None or state.level == SupervisorState.LEVEL_OK:
        return "", False
    soft = state.level == SupervisorState.LEVEL_SOFT_STOP
    return f"{'soft' if soft else 'emergency'} stop of the supervisor: {state.reason}", soft


def _end(requests: tuple[Message, ...]) -> str:
    """Why the exam is to end, if an operator has just said so."""
    for request in requests:
        if request.request == OperatorRequest.END:
            return f"ended by the operator: {request.reason}"
    return ""


@cache
def _let_the_worker_give_way() -> None:
    WORKER.submit(priority.give_way, priority.WORKER)


def create(scenario: Scenario) -> PlanningService:
    """The service for a scenario, of which it may know the exam input."""
    return PlanningService(exam_input(scenario), lockstep=Settings.read().runtime == "lockstep")
