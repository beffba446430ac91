"""Estimated abdominal wall: the perceived surface, corrected by touches and moved by the breath.

At a position x in A's xy plane the wall is outward of the perceived surface by

    c(x) + m(x) w(t)

with the correction c (`correction`), the breathing mode m (`perception/surface`) and the displacement w where m is 1 (`breath`).
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
    """One touch of the skin, as published on `exam/touches`."""

    p_W: Array
    """Point of the perceived surface [m], shape (3,)."""
    stroke: int
    height: float
    """Measured height of the skin above the perceived surface at the end of expiration [m]."""
    sigma: float
    """SD of `height` [m]."""
    expected: float
    """Height predicted before the touch [m]."""
    expected_sigma: float
    """SD of `expected` [m]."""


class WallPlace(NamedTuple):
    """Estimated wall at one position, outward of the perceived surface at the end of expiration."""

    correction: float
    """Correction from touches [m]."""
    displacement: float
    """Displacement by the breath [m]."""
    sigma: float
    """SD of the sum [m]."""


class Wall:
    """Estimated position of the skin and its uncertainty."""

    def __init__(self, perceived: PerceivedSurface, breath: Breath) -> None:
        """Starts without correction."""
        self.perceived, self.breath = perceived, breath
        self.correction = SurfaceCorrection()
        self.shift_A = np.zeros(2)
        """Shift of the body along the table since the first scan of the surface, in A [m], shape (2,)."""
        self._first = perceived
        self._touched: tuple[Foot, float] | None = None
        """Foot of the latest touch and the correction there before it [m]."""

    def seen_again(self, perceived: PerceivedSurface) -> Wall:
        """Return the wall for a new perceived surface; keeps the offset and tilt learned from touches."""
        wall = Wall(perceived, self.breath)
        wall.correction, wall._first = self.correction, self._first
        wall.correction.blur()
        return wall

    def corrected(self, vertices_W: Array, averaged: Array | None) -> tuple[Array, Array]:
        """Return the height of the skin above vertices of the perceived surface and its SD [m], shapes (n,).

        Uses all touches, and the height of the mean of all images above these vertices [m] if `averaged` is given.
        """
        xy = np.array([self.perceived.xy(p) for p in vertices_W])
        if averaged is None:
            return self.correction.over(xy)
        height, sigma = self.correction.averaged(NearestNDInterpolator(xy, averaged)).over(xy)
        return averaged + height, sigma

    def skin(self, foot: Foot, correction: float) -> tuple[Array, Array]:
        """Return the skin point `correction` [m] above `foot` and its outward normal, shapes (3,).

        Both refer to the body's position at the first scan, at the end of expiration, so that all samples share one frame.
        """
        if not self.shift_A.any():
            return foot.p_W + correction * foot.n_W, foot.n_W
        p, n = self._first.at((foot.xy_A - self.shift_A)[None])
        return p[0] + correction * n[0], n[0]

    def outward(self, p_W: Array, t: int) -> float:
        """Return the height of the wall above the perceived surface [m] at its point p_W, shape (3,), at `t` [ns]."""
        xy = self.perceived.xy(p_W)
        return self.correction.height(xy) + self.displacement(xy, t)

    def displacement(self, xy_A: Array, t: int) -> float:
        """Return the outward displacement by the breath [m] at a position, shape (2,), at `t` [ns]."""
        return self.perceived.breathing(xy_A) * self.breath.displacement(t)

    def sigma(self, xy_A: Array, t: int) -> float:
        """Return the SD of the wall's height [m] at a position, shape (2,), at `t` [ns]."""
        return self.at(xy_A, t).sigma

    def at(self, xy_A: Array, t: int) -> WallPlace:
        """Return the wall at a position, shape (2,), at `t` [ns]."""
        (correction, sigma), share = self.correction.at(xy_A), self.perceived.breathing(xy_A)
        return WallPlace(correction, share * self.breath.displacement(t), math.hypot(sigma, share * self.breath.uncertainty(t)))

    def touched(self, foot: Foot, touch: SkinDepth, stroke: int, t: int) -> tuple[TouchedSkin, float]:
        """Updates the correction with a touch under `foot` at `t` [ns]; returns the touch and the change in wall height [m]."""
        before, before_sigma = self.correction.at(foot.xy_A)
        moved = self.perceived.breathing(foot.xy_A) * self.breath.uncertainty(t)
        felt = FeltHeight(foot.xy_A, before - touch.depth, touch.sigma, moved, t / SECOND)
        self.correction.touch(felt)
        self._touched = foot, before
        observed = TouchedSkin(foot.p_W, stroke, felt.height, math.hypot(touch.sigma, moved), before, before_sigma)
        return observed, self.correction.height(foot.xy_A) - before

    def revise(self, onset: Onset) -> float | None:
        """Refits the last touch with measured instead of forecast breathing; returns the change in wall height [m].

        Returns None while the breathing is not measured. With the forecast the error of a touch is 0.5 to 1.2 mm, with measured
        breathing half of that.
        """
        seen = self.breath.seen(onset.times)
        if seen is None or self._touched is None:
            return None
        foot, before = self._touched
        share, previous = self.perceived.breathing(foot.xy_A), self.correction.height(foot.xy_A)
        touch = onset.touch_again(share * seen)
        moved = share * self.breath.seen_uncertainty
        self.correction.revise(FeltHeight(foot.xy_A, before - touch.depth, touch.sigma, moved, float(onset.times[-1]) / SECOND))
        return self.correction.height(foot.xy_A) - previous


def plane(X_WA: Array) -> Wall:
    """Return the xy plane of A at rest, used before the first perceived surface."""
    wall = Wall(PerceivedSurface.plane(X_WA), Breath())
    wall.perceived.nearest(np.zeros(3))  # compiles it before the first deadline
    return wall
