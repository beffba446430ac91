"""Planning as a service: messages to arrays and back. The examination itself is in `exam_sequence`."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any, ClassVar

import numpy as np

from palpate_bus.contract import MS, contract
from palpate_bus.contract.conformance import Checker
from palpate_bus.messages import CameraTrigger, OperatorRequest, RobotStatus, SearchRequest, SupervisorState, SurfaceMotion
from palpate_bus.messages.codec import Message
from palpate_bus.messages.geometry import vector, wrench
from palpate_bus.messages.stamps import header
from palpate_bus.runtime.process import WORKER_NICENESS, lower_priority
from palpate_bus.service import Inbox, Outbox, Service
from palpate_bus.settings import Settings
from palpate_models.numerics.frames import Array
from palpate_models.scenario.checkpoint import Checkpoint, read_checkpoint
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import ExamInput, Following, Scenario
from palpate_planning.contact import SensorReading
from palpate_planning.exam_sequence import ExamSequence
from palpate_planning.free_motion import WORKER
from palpate_planning.messages import correction_message, motion_of, path_message, state_message, touch_message
from palpate_planning.periods import Periods
from palpate_planning.status import Observation, PerceptionFailure, Phase
from palpate_planning.strokes.plan import PerceivedAbdomen
from palpate_planning.strokes.requests import PressRequest
from palpate_planning.wall.breath import BreathObservation
from palpate_planning.wall.surface import PerceivedSurface

NEEDED = ("robot", "assessment", "supervisor", "conductor")
"""Roles whose loss ends the exam, whatever its phase. Without the conductor no operator could stop it."""
NEEDED_TO_SEE = (*NEEDED, "camera", "perception")
"""Roles whose loss ends the exam before there are targets."""
SEEN = ("perception/surface", "perception/targets", "perception/motion", "perception/correction")
"""Topics of perception that the arm is moved by: a message that breaks the contract is passed over."""
ONE_PLACE_M = 1e-4
"""Two targets in turn that are nearer to each other than this have no way between them."""
SEEING = frozenset({Phase.HOME, Phase.LOOK})
"""Phases before there are targets."""


class PlanningService(Service):
    """Runs the examination of a scenario."""

    role: ClassVar[str] = "planning"

    def __init__(self, known: ExamInput, before: Checkpoint | None = None, *, lockstep: bool = True) -> None:
        """`before` and `lockstep` as in `ExamSequence`."""
        roles = contract().roles
        self._known = known
        self._X_WA = np.array(known.X_WA)
        _lower_worker_priority()
        self._exam = ExamSequence(known, Periods(roles["planning"].period, roles["camera"].period), before, lockstep=lockstep)
        self._supervisor_silence = contract().topics["planning/setpoint"].expiry
        self._reading: SensorReading | None = None
        self._mesh: Message | None = None
        self._peak_force = 0.0
        self._unreadable = self._refused = 0
        self._checks = {topic: Checker(contract().topics[topic]) for topic in SEEN}

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """One planning period: what is measured, what the examination makes of it, what is to be done."""
        status = inbox.latest("robot/status")
        if status is not None:
            self._read(status)
        requests = tuple(inbox.new("operator/request"))
        stop, soft = _stop(status, inbox.latest("supervisor/state"), requests)
        step = self._exam.step(
            Observation(
                t=t,
                reading=self._reading,
                perceived=self._perceived(inbox),
                motion=self._motion(inbox),
                averaged=self._averaged(inbox),
                findings_final=any(message.final for message in inbox.new("assessment/findings")),
                stop=stop,
                soft=soft,
                end=_end(requests),
                lost=self._lost(t, inbox),
                request=self._request(inbox),
            )
        )
        if step.contact is not None and step.contact.touching:
            self._peak_force = max(self._peak_force, step.contact.load)
        outbox: dict[str, Message | list[Message]] = {
            "planning/setpoint": step.setpoint.message(),
            "exam/state": state_message(t, self._exam.status, step.contact),
        }
        if step.trigger:
            outbox["planning/camera_trigger"] = CameraTrigger(header(t), self._known.camera.frames)
        if step.touched is not None:
            outbox["exam/touches"] = touch_message(t, step.touched)
        if step.correction is not None:
            outbox["exam/correction"] = correction_message(t, *step.correction)
        if step.path is not None:
            outbox["planning/path"] = path_message(t, step.path)
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
            "refused_messages": self._refused,
        }

    def _fitting(self, inbox: Inbox, topic: str) -> Iterator[Message | None]:
        """The new messages of a topic; None for one that breaks its row of the contract, which is counted and told in the log."""
        for message in inbox.new(topic):
            wrong = self._checks[topic](message) or _too_short(message)
            if wrong:
                self._refused += 1
                logging.getLogger(self.role).warning("%s of %s refused: %s", topic, contract().topics[topic].producer, wrong[0])
            yield None if wrong else message

    def _read(self, status: Message) -> None:
        """Takes joint positions and wrench, averaged by the robot over one period: force and depth of the same moment.

        A status with values that are not finite is passed over: the supervisor stops the arm, until then the last reading stands.
        """
        reading = SensorReading(status.position.copy(), wrench(status.wrench), status.velocity.copy())
        if np.isfinite(np.concatenate(reading)).all():
            self._reading = reading
        else:
            self._unreadable += 1

    def _perceived(self, inbox: Inbox) -> PerceivedAbdomen | PerceptionFailure | None:
        """Perception's newest answer, if one came."""
        for mesh in self._fitting(inbox, "perception/surface"):
            self._mesh = mesh
        answer: PerceivedAbdomen | PerceptionFailure | None = None
        for targets in self._fitting(inbox, "perception/targets"):
            answer = PerceptionFailure("perception/targets: refused") if targets is None else self._answer(targets)
        return answer

    def _answer(self, targets: Message) -> PerceivedAbdomen | PerceptionFailure:
        mesh = self._mesh
        if not len(targets.positions) or mesh is None:
            return PerceptionFailure(targets.message or "perception found no targets, or no surface that can be used")
        if len(targets.lines) != len(targets.positions):
            return PerceptionFailure(f"perception/targets: {len(targets.lines)} lines for {len(targets.positions)} positions")
        try:
            vertices = np.asarray(mesh.vertices, dtype=float).reshape(-1, 3)
            normals = np.asarray(mesh.normals, dtype=float).reshape(-1, 3)
            triangles = np.asarray(mesh.triangles, dtype=np.int64).reshape(-1, 3)
            if triangles.max(initial=-1) >= len(vertices):
                return PerceptionFailure(f"perception/surface: triangles of vertex {triangles.max()}, it has {len(vertices)}")
            surface = PerceivedSurface.from_mesh(vertices, normals, self._X_WA, np.asarray(mesh.breathing))
        except ValueError as error:
            return PerceptionFailure(f"perception/surface: {error}")
        positions = np.array([vector(p) for p in targets.positions])
        at_one_place = np.flatnonzero(np.linalg.norm(np.diff(positions, axis=0), axis=1) < ONE_PLACE_M)
        if len(at_one_place):
            return PerceptionFailure(f"perception/targets: {at_one_place[0]} and {at_one_place[0] + 1} are at one place")
        return PerceivedAbdomen(
            positions=positions,
            lines=np.asarray(targets.lines, dtype=np.int64),
            vertices=vertices,
            triangles=triangles,
            surface=surface,
        )

    def _motion(self, inbox: Inbox) -> BreathObservation | None:
        """The wall's newest motion, if there is one and it is to be followed."""
        heard = [motion_of(message) for message in self._fitting(inbox, "perception/motion") if message is not None]
        return heard[-1] if heard and self._known.exam.breathing is not Following.IGNORE else None

    def _averaged(self, inbox: Inbox) -> Array | None:
        """Where the mean of all images shows the wall, if that has just come and is of the surface that is examined."""
        for message in self._fitting(inbox, "perception/correction"):
            if message is not None and self._mesh is not None and len(message.outward) == len(self._mesh.vertices) // 3:
                return np.asarray(message.outward, dtype=float)
        return None

    def _request(self, inbox: Inbox) -> PressRequest | None:
        """What the search asks for, if it has just asked."""
        if not self._known.exam.searched:
            return None
        for message in inbox.new("exam/request"):
            over = message.request == SearchRequest.DONE
            xy = None if over else np.array((message.place.x, message.place.y))
            depth = min(float(message.depth), self._known.limits.depth_m)  # a policy may ask for more
            return PressRequest(int(message.number), xy, depth, message.reason)
        return None

    def _lost(self, t: int, inbox: Inbox) -> tuple[str, ...]:
        """Roles that are needed and gone. A supervisor silent for longer than a set-point is valid is gone, too."""
        searching = ("search",) if self._known.exam.searched else ()
        needed = (*(NEEDED_TO_SEE if self._exam.status.phase in SEEING else NEEDED), *searching)
        gone = tuple([role for role in needed if inbox.lost(role)])
        heard = inbox.stamp("supervisor/state")
        if heard is not None and t - heard > self._supervisor_silence:
            gone += (f"the supervisor, silent for {(t - heard) / MS:.0f} ms",)
        return gone


def _too_short(message: Message) -> list[str]:
    """What is wrong with the lengths of a message of perception's, which the contract's rows do not tell."""
    if isinstance(message, SurfaceMotion) and len(message.forecast) < SurfaceMotion.FORECASTS:
        return [f"forecast has {len(message.forecast)} values, {SurfaceMotion.FORECASTS} are wanted"]
    return []


def _stop(status: Message | None, state: Message | None, requests: tuple[Message, ...]) -> tuple[str, bool]:
    """Why the arm must rest, empty when all is well; and whether planning is to retreat (else the driver holds).

    `status` is the robot's newest, `state` the supervisor's.
    """
    for request in requests:
        if request.request == OperatorRequest.STOP:
            return f"stopped by the operator: {request.reason}", False
    if status is not None and status.mode == RobotStatus.MODE_SAFE_HOLD:
        return f"the driver holds safely: {status.reason}", False
    if status is not None and status.mode == RobotStatus.MODE_IDLE and status.reason:
        return f"the robot is not ready: {status.reason}", False
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
def _lower_worker_priority() -> None:
    WORKER.submit(lower_priority, WORKER_NICENESS)


def create(scenario: Scenario) -> PlanningService:
    """The service for a scenario; it is given the exam input only."""
    settings = Settings.read()
    return PlanningService(exam_input(scenario), read_checkpoint(settings.checkpoint), lockstep=settings.runtime == "lockstep")
