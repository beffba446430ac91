"""The wall as planning believes it to be now: the perceived surface, corrected by touch, moved by the breath.

At a place x of A's xy plane the wall lies outward of the perceived surface by

    c(x) + m(x) w(t),

c the correction (`surface_correction`), m the shape of the breathing motion (`perception/surface`), w how far it moves where m
is 1 (`breath`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from palpate_models.frames import Array
from palpate_planning.breath import Breath
from palpate_planning.surface import Foot, PerceivedSurface
from palpate_planning.surface_correction import SurfaceCorrection
from palpate_planning.touch import Touch


class TouchedSkin(NamedTuple):
    """An observation of the skin, as `exam/touches` tells it."""

    p_W: Array
    """Where, on the perceived surface [m], shape (3,)."""
    stroke: int
    height: float
    """How far outward of the perceived surface, at the end of expiration, the skin was felt [m]."""
    sigma: float
    """Standard deviation of that [m]."""
    expected: float
    """What was expected before [m] ..."""
    expected_sigma: float
    """... and the standard deviation of that [m]."""


class Wall:
    """Where the skin is, and how sure that is."""

    def __init__(self, perceived: PerceivedSurface, breath: Breath) -> None:
        """Uncorrected until it is touched."""
        self.perceived, self.breath = perceived, breath
        self.correction = SurfaceCorrection()

    def outward(self, p_W: Array, t: int) -> float:
        """How far the wall lies outward of the perceived surface at its point p_W, shape (3,), at `t` [ns]; in metres."""
        xy = self.perceived.xy(p_W)
        return self.correction.height(xy) + self.displacement(xy, t)

    def displacement(self, xy_A: Array, t: int) -> float:
        """How far the breath has moved the wall at a place, shape (2,), at `t` [ns]; in metres outward."""
        return self.perceived.breathing(xy_A) * self.breath.displacement(t)

    def sigma(self, xy_A: Array, t: int) -> float:
        """Standard deviation of where the wall is [m] at a place, shape (2,), at `t` [ns]."""
        return math.hypot(self.correction.sigma(xy_A), self.perceived.breathing(xy_A) * self.breath.uncertainty(t))

    def touched(self, foot: Foot, touch: Touch, stroke: int, t: int) -> tuple[TouchedSkin, float]:
        """Learns from a touch under `foot` at `t` [ns]; also returns how far the wall there moved outward by it [m]."""
        before, before_sigma = self.correction.height(foot.xy_A), self.correction.sigma(foot.xy_A)
        sigma = math.hypot(touch.sigma, self.perceived.breathing(foot.xy_A) * self.breath.uncertainty(t))
        felt = before - touch.depth
        self.correction.touch(foot.xy_A, felt, sigma)
        observed = TouchedSkin(foot.p_W, stroke, felt, sigma, before, before_sigma)
        return observed, self.correction.height(foot.xy_A) - before


def plane(X_WA: Array) -> Wall:
    """The xy plane of A at rest: what is assumed while nothing has been perceived."""
    wall = Wall(PerceivedSurface.plane(X_WA), Breath())
    wall.perceived.nearest(np.zeros(3))  # compiles it ahead of any deadline
    return wall
