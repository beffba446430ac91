"""Signs that distinguish a tensed muscle from a lump: stiff surroundings, and relaxation under contact.

A muscle is tensed over a hand's breadth, so that a candidate on it lies on a rise of the smooth fields. Voluntary guarding fades
during a slow slide, so that the same place becomes softer during a stroke: with w(x) a muscle's shape around the candidate and t
the time since contact, the strength of f = w(x) exp(-t / RELAXATION_S) with a prior of FADE_SD,
f' S^-1 y / (f' S^-1 f + FADE_SD^-2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from palpate_assessment.model import Bump, Regression
from palpate_models.numerics.frames import Array

MUSCLE_M, MUSCLE_EDGE_M = 0.06, 0.025
"""Radius of a muscle that is tensed, and how soft its edge is [assumption]."""
RELAXATION_S = 2.0
"""Relaxation time of a muscle [s] [A]. A stroke takes five seconds."""
FADE_SD = 0.3
"""Prior of the logarithm that fades."""
SOFTEST = 0.1
"""Part of the samples that is taken for the relaxed wall."""


@dataclass(frozen=True)
class Signs:
    """Signs of a muscle around a candidate, in logarithms of stiffness."""

    rise: float
    """Stiffness over a hand's breadth relative to the softest part of the region."""
    fade: float
    """Part of it that fades under contact."""

    @property
    def features(self) -> Array:
        """Both, shape (2,)."""
        return np.array((self.rise, self.fade))


def signs(regression: Regression, lump: Bump) -> Signs:
    """Return the signs of a muscle around a lump of a regression."""
    o = regression.observations
    smooth = regression.smooth(np.vstack(((lump.x, lump.y), o.xy)))
    fading = regression.whiten(Bump(lump.x, lump.y, MUSCLE_M, MUSCLE_EDGE_M)(o.xy) * np.exp(-o.touched_for / RELAXATION_S))
    fade = regression.whitened @ fading / (fading @ fading + FADE_SD**-2)
    return Signs(rise=float(smooth[0] - np.quantile(smooth[1:], SOFTEST)), fade=float(fade))
