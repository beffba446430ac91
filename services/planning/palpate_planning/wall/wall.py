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
from scipy.interpolate import NearestNDInterpolator

from palpate_models.numerics.frames import Array
from palpate_planning.periods import SECOND
from palpate_planning.wall.breath import Breath
from palpate_planning.wall.correction import FeltHeight, SurfaceCorrection
from palpate_planning.wall.surface import Foot, PerceivedSurface
from palpate_planning.wall.touch import Onset, SkinDepth


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


class WallPlace(NamedTuple):
    """Where the wall is believed to be at one place, outward of the perceived surface at the end of expiration."""

    correction: float
    """How far the skin is from there, as touch has told [m]."""
    displacement: float
    """How far the breath has moved it from there [m]."""
    sigma: float
    """Standard deviation of both together [m]."""


class Wall:
    """Where the skin is, and how sure that is."""

    def __init__(self, perceived: PerceivedSurface, breath: Breath) -> None:
        """Uncorrected until it is touched."""
        self.perceived, self.breath = perceived, breath
        self.correction = SurfaceCorrection()
        self.shift_A = np.zeros(2)
        """How far the body lies from where the first look saw it, along the table in A [m], shape (2,)."""
        self._first = perceived
        self._touched: tuple[Foot, float] | None = None
        """Where the latest touch was, and the correction there before it [m]."""

    def seen_again(self, perceived: PerceivedSurface) -> Wall:
        """The wall as a later look sees it; what the touches told of camera and arm holds on."""
        wall = Wall(perceived, self.breath)
        wall.correction, wall._first = self.correction, self._first
        wall.correction.blur()
        return wall

    def corrected(self, vertices_W: Array, averaged: Array | None) -> tuple[Array, Array]:
        """How far the skin lies outward of vertices of the perceived surface, and its standard deviation [m], shape (n,) each.

        By all touches so far, and by how far outward the mean of all images shows the wall there [m], if that is known.
        """
        xy = np.array([self.perceived.xy(p) for p in vertices_W])
        if averaged is None:
            return self.correction.over(xy)
        height, sigma = self.correction.averaged(NearestNDInterpolator(xy, averaged)).over(xy)
        return averaged + height, sigma

    def skin(self, foot: Foot, correction: float) -> tuple[Array, Array]:
        """The point of the skin [m] that is now `correction` [m] above `foot`, and its outward normal, shape (3,) each.

        Both as the body lay at the first look, at the end of expiration: there all that is felt is in one frame.
        """
        if not self.shift_A.any():
            return foot.p_W + correction * foot.n_W, foot.n_W
        p, n = self._first.at((foot.xy_A - self.shift_A)[None])
        return p[0] + correction * n[0], n[0]

    def outward(self, p_W: Array, t: int) -> float:
        """How far the wall lies outward of the perceived surface at its point p_W, shape (3,), at `t` [ns]; in metres."""
        xy = self.perceived.xy(p_W)
        return self.correction.height(xy) + self.displacement(xy, t)

    def displacement(self, xy_A: Array, t: int) -> float:
        """How far the breath has moved the wall at a place, shape (2,), at `t` [ns]; in metres outward."""
        return self.perceived.breathing(xy_A) * self.breath.displacement(t)

    def sigma(self, xy_A: Array, t: int) -> float:
        """Standard deviation of where the wall is [m] at a place, shape (2,), at `t` [ns]."""
        return self.at(xy_A, t).sigma

    def at(self, xy_A: Array, t: int) -> WallPlace:
        """The wall at a place, shape (2,), at `t` [ns]."""
        (correction, sigma), share = self.correction.at(xy_A), self.perceived.breathing(xy_A)
        return WallPlace(correction, share * self.breath.displacement(t), math.hypot(sigma, share * self.breath.uncertainty(t)))

    def touched(self, foot: Foot, touch: SkinDepth, stroke: int, t: int) -> tuple[TouchedSkin, float]:
        """Learns from a touch under `foot` at `t` [ns]; also returns how far the wall there moved outward by it [m]."""
        before, before_sigma = self.correction.at(foot.xy_A)
        moved = self.perceived.breathing(foot.xy_A) * self.breath.uncertainty(t)
        felt = FeltHeight(foot.xy_A, before - touch.depth, touch.sigma, moved, t / SECOND)
        self.correction.touch(felt)
        self._touched = foot, before
        observed = TouchedSkin(foot.p_W, stroke, felt.height, math.hypot(touch.sigma, moved), before, before_sigma)
        return observed, self.correction.height(foot.xy_A) - before

    def revise(self, onset: Onset) -> float | None:
        """Finds the latest touch anew, once the wall's motion in it was seen; how far that moves the wall there outward [m].

        None while it has not been seen: by the forecast a touch errs by 0.5 to 1.2 mm, by what is seen by half of that.
        """
        seen = self.breath.seen(onset.times)
        if seen is None or self._touched is None:
            return None
        foot, before = self._touched
        share, reckoned = self.perceived.breathing(foot.xy_A), self.correction.height(foot.xy_A)
        touch = onset.touch_again(share * seen)
        moved = share * self.breath.seen_uncertainty
        self.correction.revise(FeltHeight(foot.xy_A, before - touch.depth, touch.sigma, moved, float(onset.times[-1]) / SECOND))
        return self.correction.height(foot.xy_A) - reckoned


def plane(X_WA: Array) -> Wall:
    """The xy plane of A at rest: what is assumed while nothing has been perceived."""
    wall = Wall(PerceivedSurface.plane(X_WA), Breath())
    wall.perceived.nearest(np.zeros(3))  # compiles it ahead of any deadline
    return wall
