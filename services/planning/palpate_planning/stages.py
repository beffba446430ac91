"""The stages of a stroke, and what a step of the palpation did."""

from __future__ import annotations

from enum import Enum
from typing import Final, NamedTuple

from palpate_bus.setpoint import Setpoint
from palpate_planning.wall.wall import TouchedSkin


class StrokeStage(Enum):
    """Part of a stroke."""

    REST = "resting above the skin"
    DESCEND = "descending"
    SETTLE = "settling at depth"
    SLIDE = "sliding at depth"
    HOLD = "holding at depth"
    LIFT = "lifting"
    TRANSFER = "moving to the next stroke"
    WAIT = "waiting for the next stroke"
    DONE = "done"


PRESSING: Final = (StrokeStage.SLIDE, StrokeStage.HOLD, StrokeStage.SETTLE, StrokeStage.DESCEND)
"""Stages in which the tissue is pressed, or is about to be."""
PUSHING: Final = (*PRESSING, StrokeStage.LIFT)
"""Stages in which the measured force is fed forward."""
AT_DEPTH: Final = (StrokeStage.SLIDE, StrokeStage.HOLD, StrokeStage.SETTLE)


class PalpationStep(NamedTuple):
    """What a step of the palpation did."""

    setpoint: Setpoint
    stage: StrokeStage
    depth_setpoint: float
    """[m]"""
    steady: bool
    """Whether a measurement of this step is a valid sample."""
    limited: bool
    """Whether force keeps the indenter from the depth asked for."""
    target: int
    """Index of the latest target reached."""
    taring: bool = False
    """Whether the arm rests in free air: what the sensor reads now is bias."""
    touched: TouchedSkin | None = None
    """The touch of this step, if there was one."""
