"""What goes into a step of the examination and what comes out of it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_planning.measure import Contact, Reading
from palpate_planning.palpation import Doing
from palpate_planning.prepare import Seen
from palpate_planning.setpoint import Setpoint

Array = NDArray[np.float64]


class Phase(IntEnum):
    """As in palpation_msgs/ExamState."""

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
    Doing.DESCEND: Phase.INDENT,
    Doing.SETTLE: Phase.INDENT,
    Doing.SLIDE: Phase.SCAN,
    Doing.HOLD: Phase.SCAN,
    Doing.LIFT: Phase.RETRACT,
    Doing.TRANSFER: Phase.RETRACT,
    Doing.DONE: Phase.RETRACT,
}


@dataclass(frozen=True, slots=True)
class Unseen:
    """Perception's answer when it could not give targets."""

    message: str


class Observation(NamedTuple):
    """All that planning knows at a step."""

    t: int
    """[ns]"""
    reading: Reading | None
    """None before the first joint states."""
    seen: Seen | Unseen | None = None
    """Perception's answer, at the step at which it came."""
    findings_final: bool = False
    stop: str = ""
    """Why the arm must rest; empty when all is well."""
    soft: bool = False
    """Whether the stop leaves the arm to planning, which is to retreat along the normal; else the driver holds."""
    end: str = ""
    """Why the exam is to go home and end, once."""
    lost: tuple[str, ...] = ()
    """Roles whose services are gone."""


@dataclass(slots=True)
class ExamStatus:
    """What exam/state says. World frame; the contact values are those of `contact`."""

    phase: Phase = Phase.HOME
    message: str = "waiting for the robot"
    target_index: int = 0
    target_count: int = 0
    targets_skipped: int = 0
    steady: bool = False
    force_limited: bool = False
    view_blocked: bool = False
    depth_setpoint: float = 0.0
    end_tick: int = -1


@dataclass(slots=True)
class Outcome:
    """What a step asks for."""

    setpoint: Setpoint
    contact: Contact | None
    """None before the robot has been heard of."""
    trigger: bool = False
    """Ask the camera for a burst now."""
    path: Array | None = None
    """Planned poses of the indenter at depth, shape (n, 4, 4), once."""
