"""What goes into a step of the examination and what comes out of it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final, NamedTuple

from palpate_bus.setpoint import Setpoint
from palpate_models.numerics.frames import Array
from palpate_planning.contact import ContactMeasurement, SensorReading
from palpate_planning.reasons import Reason
from palpate_planning.stages import StrokeStage
from palpate_planning.strokes.plan import PerceivedAbdomen
from palpate_planning.strokes.requests import PressRequest
from palpate_planning.wall.breath import BreathObservation
from palpate_planning.wall.wall import TouchedSkin


class Phase(IntEnum):
    """Phases of the examination; values of `palpation_msgs/ExamState`."""

    HOME = 0
    LOOK = 1
    PLAN = 2
    APPROACH = 3
    INDENT = 4
    SCAN = 5
    RETRACT = 6
    RETURN = 7
    ASSESS = 8
    DONE = 9
    ABORTED = 10
    HELD = 11


PHASE_OF: Final = {
    StrokeStage.REST: Phase.INDENT,
    StrokeStage.DESCEND: Phase.INDENT,
    StrokeStage.SETTLE: Phase.INDENT,
    StrokeStage.SLIDE: Phase.SCAN,
    StrokeStage.HOLD: Phase.SCAN,
    StrokeStage.LIFT: Phase.RETRACT,
    StrokeStage.TRANSFER: Phase.RETRACT,
    StrokeStage.WAIT: Phase.RETRACT,
    StrokeStage.DONE: Phase.RETRACT,
}
"""The phase to which each stage of a stroke belongs."""
PALPATING: Final = frozenset(PHASE_OF.values())
"""Phases in which the strokes of the plan are carried out."""
OVER: Final = frozenset({Phase.DONE, Phase.ABORTED})
"""Phases that end the examination."""


@dataclass(frozen=True, slots=True)
class PerceptionFailure:
    """Perception's answer when it could not give targets."""

    message: str


class Observation(NamedTuple):
    """All that planning knows at a step."""

    t: int
    """[ns]"""
    reading: SensorReading | None
    """None before the first joint states."""
    perceived: PerceivedAbdomen | PerceptionFailure | None = None
    """Perception's answer, at the step at which it came."""
    motion: BreathObservation | None = None
    """Perception's newest word about the breath, at the step at which it came."""
    findings_final: bool = False
    """Whether the assessment has sent its final findings."""
    stop: str = ""
    """Why the arm must rest; empty when all is well."""
    soft: bool = False
    """Whether the stop leaves the arm to planning, which is to retreat along the normal; else the driver holds."""
    end: str = ""
    """Why the exam is to go home and end; given at one step only."""
    lost: tuple[str, ...] = ()
    """Roles whose services are gone."""
    request: PressRequest | None = None
    """What the search asks for, at the step at which it came."""
    averaged: Array | None = None
    """How far outward of the surface's vertices the mean of the images since shows the wall [m], at the step at which it came."""


@dataclass(slots=True)
class ExamStatus:
    """What exam/state says beside the measured contact."""

    phase: Phase = Phase.HOME
    message: str = "waiting for the robot"
    reason: Reason = Reason.NONE
    target_index: int = 0
    target_count: int = 0
    targets_skipped: int = 0
    steady: bool = False
    force_limited: bool = False
    view_blocked: bool = False
    depth_setpoint: float = 0.0
    """[m]"""
    end_tick: int = -1
    """When the run is to end [ns]; -1 until that is known."""
    stroke: int = 0
    """Number of the latest descent, 0 before the first."""
    patient_moved: bool = False
    """Whether the patient has moved since the surface was perceived."""


@dataclass(slots=True)
class ExamStep:
    """What a step asks for."""

    setpoint: Setpoint
    contact: ContactMeasurement | None
    """None before the robot has been heard of."""
    trigger: bool = False
    """Ask the camera for a burst now."""
    path: Array | None = None
    """Planned poses of the indenter at depth, shape (n, 4, 4), once."""
    touched: TouchedSkin | None = None
    """The touch of this step, if there was one."""
    correction: tuple[Array, Array] | None = None
    """Of the perceived surface's vertices, as `Wall.corrected` has it, once: when the strokes are over."""
