"""How the wall rises and falls as the patient breathes."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field

from palpate_models.section import Section


class Breathing(Section):
    """Abdominal breathing: the wall rises and falls."""

    amplitude_m: Annotated[float, Field(ge=0, le=0.02)] = 0.0
    """Half of the peak-to-peak excursion; 0 switches it off."""
    rate_per_min: Annotated[float, Field(ge=4, le=40)] = 15.0


class BreathingCurve:
    """The breaths of one patient: a function of time."""

    def __init__(self, breathing: Breathing, seed: int) -> None:
        """Equal settings and seed give equal breaths."""
        self.largest_m = breathing.amplitude_m
        """Largest excursion [m] there will ever be."""
        self._pulse = 2 * math.pi * breathing.rate_per_min / 60

    def excursion(self, t_s: float) -> float:
        """Displacement [m] of the wall at time `t_s` [s], outward positive, where the breathing profile is 1."""
        return self.largest_m * math.sin(self._pulse * t_s) if self.largest_m else 0.0


STILL = BreathingCurve(Breathing(), 0)
"""A patient who does not breathe."""
