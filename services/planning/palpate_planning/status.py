"""Inputs and outputs of a step of the examination, and its phases."""

from dataclasses import dataclass
from typing import Final, NamedTuple

from palpate_bus.messages.codes import Phase
from palpate_bus.setpoint import Setpoint
from palpate_models.numerics.frames import Array
from palpate_planning.contact import ContactMeasurement, SensorReading
from palpate_planning.reasons import NO_CAUSE, Cause
from palpate_planning.setpoints import AT_REST
from palpate_planning.stroke import StrokeStage
from palpate_planning.strokes.plan import PerceivedAbdomen, PressRequest
from palpate_planning.wall.wall import BreathObservation, PublishedTouch

PHASE_OF: Final = {
    **dict.fromkeys((StrokeStage.REST, StrokeStage.DESCEND, StrokeStage.SETTLE), Phase.INDENT),
    **dict.fromkeys((StrokeStage.SLIDE, StrokeStage.HOLD), Phase.SCAN),
    **dict.fromkeys((StrokeStage.LIFT, StrokeStage.TRANSFER, StrokeStage.WAIT, StrokeStage.DONE), Phase.RETRACT),
}
"""The phase to which each stage of a stroke belongs."""
PALPATING: Final = frozenset(PHASE_OF.values())
"""Phases in which the strokes of the plan are carried out."""
OVER: Final = frozenset({Phase.DONE, Phase.ABORTED})
"""Phases that end the examination."""


class ArmStop(NamedTuple):
    """A stop of the arm. False if there is none."""

    cause: Cause = NO_CAUSE
    planning_retreats: bool = False
    """True if planning moves the arm, back along the normal; else the driver holds it."""
    final: bool = False
    """True if no release ends it."""

    def __bool__(self) -> bool:
        return bool(self.cause)


NO_STOP: Final = ArmStop()


class Observation(NamedTuple):
    """Inputs of one step. A message appears only in the step in which it arrived."""

    t: int
    """Time [ns]."""
    reading: SensorReading | None
    """None before the first `robot/status`."""
    perceived: PerceivedAbdomen | Cause | None = None
    """Perception's answer, if it arrived."""
    motion: BreathObservation | None = None
    """The newest motion of the wall, if it arrived."""
    findings_final: bool = False
    """True if the final findings of the assessment arrived."""
    stop: ArmStop = NO_STOP
    end: Cause = NO_CAUSE
    """Cause for which the examination is to go home and end, if that was just requested."""
    lost: Cause = NO_CAUSE
    """Cause if needed roles are disconnected."""
    request: PressRequest | None = None
    """The request of the search, if it arrived."""
    averaged: Array | None = None
    """Height of the wall above the surface's vertices in the mean of later images [m], if it arrived."""
    joint_force: float = 0.0
    """Force at the tool by the joints alone [N]."""


@dataclass
class ExamStatus:
    """Fields of exam/state other than the measured contact, by their names there."""

    phase: Phase = Phase.HOME
    message: str = "waiting for the robot"
    cause: Cause = NO_CAUSE
    target_index: int = 0
    target_count: int = 0
    targets_skipped: int = 0
    steady: bool = False
    force_limited: bool = False
    view_blocked: bool = False
    depth_setpoint: float = 0.0
    """Target depth [m], negative above the wall."""
    end_tick: int = -1
    """When the run is to end [ns]; -1 while undecided."""
    stroke: int = 0
    """Number of the latest descent, 0 before the first."""
    patient_moved: bool = False
    """True if the patient has moved since the surface was perceived."""


@dataclass(slots=True)
class ExamStep:
    """Outputs of one step."""

    contact: ContactMeasurement | None
    """None before the first reading of the robot."""
    setpoint: Setpoint = AT_REST
    trigger: bool = False
    """Ask the camera for a burst now."""
    path: Array | None = None
    """Planned poses of the indenter at depth, shape (n, 4, 4), once."""
    touched: PublishedTouch | None = None
    """The touch of this step, if there was one."""
    correction: tuple[Array, Array] | None = None
    """Correction of the perceived surface's vertices, from `Wall.heights_above`, once: when the strokes are over."""
