"""Planning as a service: messages to arrays and back. The examination itself is in `examination`."""

from collections import Counter
from collections.abc import Mapping
from functools import cache
from typing import Any, ClassVar

import numpy as np

from palpate_bus.contract import contract
from palpate_bus.messages import (
    CameraTrigger,
    ExamState,
    Message,
    PalpationTargets,
    Path,
    PoseStamped,
    RobotStatus,
    SearchRequest,
    SkinTouch,
    SupervisorState,
    SurfaceCorrection,
    SurfaceMotion,
)
from palpate_bus.messages.codes import Phase, Reason
from palpate_bus.messages.geometry import mesh_arrays, point_message, pose_message, vector_message, vectors, wrench
from palpate_bus.messages.stamps import MS, NS, header, nanoseconds
from palpate_bus.runtime.process import WORKER_NICENESS, lower_priority
from palpate_bus.service import Inbox, Outbox, Service
from palpate_bus.setpoint import TOPIC
from palpate_bus.settings import Settings
from palpate_errors import restate
from palpate_models.numerics.frames import Array
from palpate_models.scenario.load import Checkpoint, exam_input, read_checkpoint
from palpate_models.scenario.schema import ExamInput, Following, Scenario
from palpate_planning.contact import ContactMeasurement, SensorReading
from palpate_planning.course import NO_STOP, ArmStop, ExamStatus, Observation
from palpate_planning.examination import ExaminationSequence
from palpate_planning.free_motion import WORKER
from palpate_planning.reasons import NO_CAUSE, Cause
from palpate_planning.strokes.plan import PerceivedAbdomen, PressRequest
from palpate_planning.wall.surface import PerceivedSurface
from palpate_planning.wall.wall import HIDDEN_M, BreathObservation

COINCIDENT_M = 1e-4
"""Consecutive targets closer than this have no path between them."""


def state_message(t: int, status: ExamStatus, contact: ContactMeasurement | None) -> Message:
    """Return `palpation_msgs/ExamState`; without a contact (before the first reading of the robot) nothing is measured."""
    p, n = (np.zeros(3), np.array((0.0, 0.0, 1.0))) if contact is None else contact.wall_point
    fields = {name: value for name, value in vars(status).items() if name not in ("phase", "cause")}
    return ExamState(
        header=header(t, "world"),
        phase=int(status.phase),
        reason=int(status.cause.reason),
        culprit=status.cause.culprit,
        in_contact=contact is not None and contact.touching,
        depth=0.0 if contact is None else contact.depth,
        normal_force=0.0 if contact is None else contact.force,
        surface_point=point_message(p),
        surface_normal=vector_message(n),
        depth_uncertainty=0.0 if contact is None else contact.wall.sigma,
        wall_displacement=0.0 if contact is None else contact.wall.displacement,
        **fields,
    )


def abdomen_of(mesh: Message, targets: Message, X_WA: Array) -> PerceivedAbdomen:
    """Return surface and targets of perception; `X_WA`, shape (4, 4). Raises ValueError if the messages cannot be used."""
    count, lines = len(targets.positions), np.asarray(targets.lines, dtype=np.int64)
    if len(lines) != count:
        raise ValueError(f"perception/targets: {len(lines)} lines for {count} positions")
    positions = vectors(targets.positions)
    coincident = np.flatnonzero(np.linalg.norm(np.diff(positions, axis=0), axis=1) < COINCIDENT_M)
    if len(coincident):
        raise ValueError(f"perception/targets: {coincident[0]} and {coincident[0] + 1} coincide")
    with restate(ValueError, ValueError, "perception/surface"):
        vertices, normals, triangles, breathing = mesh_arrays(mesh)
        if triangles.max(initial=-1) >= len(vertices):
            raise ValueError(f"triangles of vertex {triangles.max()}, it has {len(vertices)}")
        surface = PerceivedSurface.from_mesh(vertices, normals, X_WA, breathing)
    return PerceivedAbdomen(positions, lines, vertices, triangles, surface)


def motion_of(message: Message) -> BreathObservation:
    """Return the motion in a `palpation_msgs/SurfaceMotion`. While the wall is hidden the forecast is used if it is certain."""
    seen = bool(message.state != SurfaceMotion.LOST)
    calm = message.state == SurfaceMotion.QUIET or (not seen and message.uncertainty < HIDDEN_M)
    moved = bool(message.state == SurfaceMotion.MOVED)
    shift = (float(message.shift.x), float(message.shift.y))
    return BreathObservation(
        nanoseconds(message.header.stamp), np.asarray(message.forecast), float(message.uncertainty), calm, moved, shift, seen
    )


NEEDED = ("robot", "assessment", "supervisor", "conductor")
"""Roles whose loss ends the examination in any phase. Without the conductor no operator could stop it."""
NEEDED_BEFORE_TARGETS = (*NEEDED, "camera", "perception")
"""Roles whose loss ends the examination before there are targets."""
CULPRITS = {
    PalpationTargets.NONE: "perception",
    PalpationTargets.NO_CAMERA: "camera",
    PalpationTargets.NO_CALIBRATION: "camera/depth/camera_info",
}
"""Role or topic behind the reason why perception has no targets; any other reason is seen in the images."""
NOT_RELEASABLE = frozenset({SupervisorState.CAUSE_SENSOR})
"""Causes of a stop that no release ends."""
STATUS_AGE = contract().topics["robot/status"].max_age
"""An older measurement [ns] stops the arm: it would press without a known depth and force."""
STARTUP = NS
"""The supervisor may be this much later than planning [ns] at the start: processes start one by one."""
BEFORE_TARGETS = frozenset({Phase.HOME, Phase.LOOK})
"""Phases before there are targets."""


class PlanningService(Service):
    """Runs the examination of a scenario."""

    role: ClassVar[str] = "planning"

    def __init__(self, known: ExamInput, before: Checkpoint | None = None, *, lockstep: bool = True) -> None:
        """`before` and `lockstep` as in `ExaminationSequence`."""
        roles = contract().roles
        self._known, self._lockstep = known, lockstep
        self._X_WA = np.array(known.X_WA)
        if not lockstep:
            _lower_worker_priority()
        step_s, frame_ns = roles["planning"].period / NS, roles["camera"].period
        setpoints = contract().topics[TOPIC]
        self._exam = ExaminationSequence(known, step_s, frame_ns, setpoints.rates, before, lockstep=lockstep)
        self._max_silence = setpoints.expiry
        self._began: int | None = None
        """Time of the first step [ns]."""
        self._reading: SensorReading | None = None
        self._mesh: Message | None = None
        self._targets: Message | None = None
        """Targets that await their surface."""
        self._peak_force = 0.0
        self._commanded = False
        """True once the driver has accepted a command."""

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Advance one planning period: read the measurements, step the examination, write set-point and state."""
        self._began = t if self._began is None else self._began
        status = inbox.latest("robot/status")
        if status is not None and len(status.position):
            stamp, force = nanoseconds(status.header.stamp), wrench(status.wrench)
            self._reading = SensorReading(stamp, status.position.copy(), force, status.velocity.copy())
            self._commanded = self._commanded or status.mode == RobotStatus.MODE_ACTIVE
        requests = tuple(inbox.new("operator/request"))
        state = inbox.latest("supervisor/state")
        step = self._exam.step(
            Observation(
                t=t,
                reading=self._reading,
                perceived=self._new_surface(inbox),
                motion=self._motion(inbox),
                averaged=self._mean_height(inbox),
                findings_final=any(message.final for message in inbox.new("assessment/findings")),
                stop=_stop(status, state, requests, self._unready(t, status)),
                end=_end(requests),
                lost=self._disconnection(t, inbox),
                request=self._request(inbox),
                joint_force=0.0 if state is None else state.joint_force,
            )
        )
        if step.contact is not None and step.contact.touching:
            self._peak_force = max(self._peak_force, step.contact.load)
        world = header(t, "world")
        outbox: dict[str, Message | list[Message]] = {}
        if self._lockstep or step.contact is not None:  # before the first reading, an arm of positions would move to a set-point
            outbox["planning/setpoint"] = step.setpoint.message()
        outbox["exam/state"] = state_message(t, self._exam.status, step.contact)
        if step.trigger:
            outbox["planning/camera_trigger"] = CameraTrigger(header(t), self._known.camera.frames)
        if step.touched is not None:
            outbox["exam/touches"] = SkinTouch(world, point_message(step.touched.p_W), *step.touched[1:])
        if step.correction is not None:
            outbox["exam/correction"] = SurfaceCorrection(header(t, "abdomen"), *(x.astype(np.float32) for x in step.correction))
        if step.path is not None:
            outbox["planning/path"] = Path(world, [PoseStamped(world, pose_message(X[:3, :3], X[:3, 3])) for X in step.path])
        return outbox

    def finish(self) -> Mapping[str, Any]:
        """Return phase, targets, skipped ones with causes, those not felt by `Loss`, and the highest measured force [N]."""
        status = self._exam.status
        return {
            "phase": status.phase.name,
            "message": status.message,
            "targets": status.target_count,
            "skipped_targets": {str(i): cause.text for i, cause in sorted(self._exam.skipped.items())},
            "unfelt_targets": Counter(cause.loss.value for cause in self._exam.unfelt.values()),
            "peak_force_N": self._peak_force,
        }

    def _new_surface(self, inbox: Inbox) -> PerceivedAbdomen | Cause | None:
        """Return perception's newest answer, once its targets and the surface of the same time have arrived."""
        for message in inbox.new("perception/surface"):
            self._mesh = message
        for message in inbox.new("perception/targets"):
            self._targets = message
        targets, mesh = self._targets, self._mesh
        if targets is None:
            return None
        if len(targets.positions) and (mesh is None or mesh.header.stamp != targets.header.stamp):
            return None
        self._targets = None
        return self._answer(targets, mesh)

    def _answer(self, targets: Message, mesh: Message | None) -> PerceivedAbdomen | Cause:
        if not len(targets.positions):
            text = targets.message or "perception found no targets"
            blocked = targets.reason == PalpationTargets.VIEW_BLOCKED
            reason = Reason.VIEW_BLOCKED if blocked else Reason.VIEW_FAILED
            return Cause(reason, text, CULPRITS.get(targets.reason, "camera/depth/image_raw"))
        try:
            return abdomen_of(mesh, targets, self._X_WA)
        except ValueError as error:
            return Cause(Reason.VIEW_FAILED, str(error), "perception")

    def _motion(self, inbox: Inbox) -> BreathObservation | None:
        """Return the newest motion of the wall, if one arrived and the scenario follows it."""
        whole = (message for message in inbox.new("perception/motion") if len(message.forecast) >= SurfaceMotion.FORECASTS)
        received = [motion_of(message) for message in whole]  # the contract has no lengths
        return received[-1] if received and self._known.exam.breathing is not Following.IGNORE else None

    def _mean_height(self, inbox: Inbox) -> Array | None:
        """Return the height of the wall averaged over all images, if it arrived and belongs to the present surface."""
        heights: Array | None = None
        for message in inbox.new("perception/correction"):
            if self._mesh is not None and len(message.outward) == len(self._mesh.vertices) // 3:
                heights = np.asarray(message.outward, dtype=float)
        return heights

    def _request(self, inbox: Inbox) -> PressRequest | None:
        """Return the newest request of the search, if one arrived: the search waits for its execution before the next."""
        received = list(inbox.new("exam/request")) if self._known.exam.searched else []
        if not received:
            return None
        message = received[-1]
        over = message.request == SearchRequest.DONE
        xy = None if over else np.array((message.place.x, message.place.y))
        depth = min(float(message.depth), self._known.limits.depth_m)  # a policy may request more
        return PressRequest(int(message.number), xy, depth, message.reason)

    def _unready(self, t: int, status: Message | None) -> Cause:
        """Return why the robot cannot be used, if it cannot: a driver that is idle again, after a release, awaits a command."""
        if status is None:
            return NO_CAUSE
        if status.mode == RobotStatus.MODE_IDLE and (self._commanded or status.cause != RobotStatus.CAUSE_NONE):
            return Cause(Reason.ROBOT_NOT_READY, f"the robot is not ready: {status.reason or 'no command yet'}", "robot")
        age = 0 if self._reading is None else t - self._reading.stamp
        text = f"robot/status: measured {age / MS:.0f} ms ago, limit {STATUS_AGE / MS:.0f} ms"
        return Cause(Reason.ROBOT_NOT_READY, text, "robot/status") if age > STATUS_AGE else NO_CAUSE

    def _disconnection(self, t: int, inbox: Inbox) -> Cause:
        """Return the cause if needed roles are disconnected, or the supervisor is silent for longer than a set-point is valid."""
        searching = ("search",) if self._known.exam.searched else ()
        needed = (*(NEEDED_BEFORE_TARGETS if self._exam.status.phase in BEFORE_TARGETS else NEEDED), *searching)
        gone = [role for role in needed if inbox.lost(role)]
        culprit = gone[0] if gone else "supervisor/state"
        last = inbox.stamp("supervisor/state")
        if last is None:
            last = STARTUP + (t if self._began is None else self._began)
        if t - last > self._max_silence:
            gone.append(f"the supervisor, silent for {(t - last) / MS:.0f} ms")
        return Cause(Reason.SERVICE_LOST, f"lost {', '.join(gone)}", culprit) if gone else NO_CAUSE


def _stop(status: Message | None, state: Message | None, requests: tuple[Message, ...], unready: Cause) -> ArmStop:
    """Return the stop, if any.

    `status` is the latest `robot/status`, `state` the latest `supervisor/state`; `unready`: why the robot cannot be used.
    """
    wrong = None if state is None or state.level == SupervisorState.LEVEL_OK else state
    final = wrong is not None and wrong.cause in NOT_RELEASABLE
    for request in requests:
        if request.request == request.STOP:
            return ArmStop(Cause(Reason.OPERATOR_STOP, f"stopped by the operator: {request.reason}"), final=final)
    if status is not None and status.mode == RobotStatus.MODE_SAFE_HOLD:
        source = wrong if wrong is not None and final else status
        return ArmStop(Cause(Reason.ROBOT_HOLD, f"the driver is in safe hold: {source.reason}", source.culprit), final=final)
    if unready:
        return ArmStop(unready, final=final)
    if wrong is None:
        return NO_STOP
    if wrong.level == SupervisorState.LEVEL_SOFT_STOP:
        cause = Cause(Reason.SOFT_STOP, f"soft stop of the supervisor: {wrong.reason}", wrong.culprit)
        return ArmStop(cause, planning_retreats=True, final=final)
    return ArmStop(Cause(Reason.EMERGENCY_STOP, f"emergency stop of the supervisor: {wrong.reason}", wrong.culprit), final=final)


def _end(requests: tuple[Message, ...]) -> Cause:
    """Return the cause if an operator, or the conductor at its limit, has just ended the examination."""
    ends = [request for request in requests if request.request == request.END]
    return Cause(Reason.OPERATOR_END, f"ended on request: {ends[0].reason}") if ends else NO_CAUSE


@cache
def _lower_worker_priority() -> None:
    WORKER.submit(lower_priority, WORKER_NICENESS)


def create(scenario: Scenario) -> PlanningService:
    """Return the service for a scenario; it is given the exam input only."""
    settings = Settings.read()
    return PlanningService(exam_input(scenario), read_checkpoint(settings.checkpoint), lockstep=settings.runtime == "lockstep")
