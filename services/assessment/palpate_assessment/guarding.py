"""Guarding: what tells a tensed muscle from a lump. All about it is stiff, too, and it may let go under the touch.

A muscle is tensed over a hand's breadth, so that a candidate on it lies on a rise of the smooth fields. Voluntary guarding fades
while the indenter slides gently, so that the same places feel softer the longer a stroke lasts: with w(x) a muscle's shape about
the candidate and t the time since the touch, the strength of f = w(x) exp(-t / LETTING_GO_S) with a prior of FADE_SD,
f' S^-1 y / (f' S^-1 f + FADE_SD^-2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from palpate_assessment.model import Bump, Regression
from palpate_models.numerics.frames import Array

MUSCLE_M, MUSCLE_EDGE_M = 0.06, 0.025
"""Radius of a muscle that is tensed, and how soft its edge is [assumption]."""
LETTING_GO_S = 2.0
"""How long a muscle takes to let go [assumption]: no measurement says it. A stroke takes five seconds."""
FADE_SD = 0.3
"""Prior of the logarithm that fades."""
SOFTEST = 0.1
"""Part of the samples that is taken for the relaxed wall."""


@dataclass(frozen=True)
class Signs:
    """What of a muscle is seen about a candidate, in logarithms of stiffness."""

    rise: float
    """How much stiffer it is there over a hand's breadth than where the region is softest."""
    fade: float
    """How much of that fades under the touch."""

    @property
    def features(self) -> Array:
        """Both, shape (2,)."""
        return np.array((self.rise, self.fade))


def signs(regression: Regression, lump: Bump) -> Signs:
    """What of a muscle is seen about a lump of a regression."""
    o = regression.observations
    smooth = regression.smooth(np.vstack(((lump.x, lump.y), o.xy)))
    fading = regression.whiten(Bump(lump.x, lump.y, MUSCLE_M, MUSCLE_EDGE_M)(o.xy) * np.exp(-o.touched_for / LETTING_GO_S))
    fade = regression.whitened @ fading / (fading @ fading + FADE_SD**-2)
    return Signs(rise=float(smooth[0] - np.quantile(smooth[1:], SOFTEST)), fade=float(fade))
