"""Follows the wall from one small depth image to the next.

Of each image the outward displacements of the wall's pixels, y = (z - z_ref) / g, are explained by the breath and by how a body
moves that lies on a table, shifts along it by s_x, s_y and turns about its long axis by theta:

    y_i = m_i d + n_i . (s_x, s_y, 0) + theta n_i . (e_y x p_i) + noise

First d alone, robustly, for the breath filter; then what is left, over some images, by all four with a prior of each.

Neighbouring pixels err together for seconds, so that d errs by more than their number tells, and no filter of breaths takes that
off. How much it is, is told by patches P of the wall that are wider than such errors, by how d changes when one is left out (a
jackknife, Efron and Stein 1981): with w the weights

    var d = sum_P (d - d_P)^2,   d - d_P = sum_{i in P} w_i m_i (y_i - m_i d) / sum_{i not in P} w_i m_i^2,

of which half is what the images erred by from which the wall was learnt.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import Final

import numpy as np
from numpy.typing import NDArray

from palpate_models.numerics.frames import Array
from palpate_perception.average import WallAverage
from palpate_perception.breath_filter import BreathFilter
from palpate_perception.registration import PRIOR, reasons
from palpate_perception.wall import SeenWall

FORECAST_S: Final[Array] = 0.050 * np.arange(11.0)
"""How long after an exposure the displacement is forecast for [s]."""
PATCH_M: Final = 0.11
"""Neighbours err together over less than this: 25 pixels of a poor camera, 5 cm on the wall (docs/errors.md)."""
SHARED_M: Final = 1.5e-4
"""What an image's displacement errs by with its neighbours, before images have told it ..."""
SHARED_S: Final = 20.0
"""... and for so long an image counts for that."""
REACH_M: Final = 0.06
"""What is farther from where the wall is expected is something else."""
TUKEY: Final = 5.0
"""Tukey's biweight, in standard deviations of a pixel."""
LEAST_SHARE: Final = 0.015
"""With less of the wall in view, by what it tells of the displacement, it is lost."""
SURPRISE: Final = 5.0
"""A displacement so many standard deviations from what the filter expects is none of its breaths ..."""
SURPRISE_M: Final = 2.5e-3
"""... if it is as far off as this, too."""
DEEP: Final = 2.2
"""A breath so many times as deep as usual is a deep one."""
CALM_S: Final = 0.6
"""So long after the last surprise the wall is as expected again."""
KEPT: Final = 0.7
"""Part of what was left over that counts on at the next image. Over the six images that count so, white noise falls to what
neighbours and successive images share, which does not fall: their mean is about as certain as one image's white noise says."""
MOVED_M: Final = 0.002
"""A region that moved by more than this, root mean square over its corners, a rise of them all apart, has been moved ..."""
MOVED_SQUARED: Final = 14.0
"""... if its motion's squared Mahalanobis distance from none is so many times the usual one ...

In three images in a row: of 35 persons who breathe quietly 8.5 at most in 89 minutes, of 10 seen by poor equipment 8.9 in 25;
of 60 shifts of 10 mm 73 or more, of one along a body that is much the same along its length 23 (tuning seeds)."""
USUAL_S: Final = 20.0
"""... which is its mean over so long, 1 at least: what pixels err by together is not in the covariance, and makes it more ..."""
UNUSUAL: Final = 3.0
"""... and more than so many times the usual does not count for more: it may be a motion that has begun."""
DRIFT_S: Final = 8.0
"""What comes more slowly than this is no motion of the patient, but the camera's drift: bodies shift at once."""
GAP_S: Final = 0.2
"""An image does not speak for more time than this, however long nothing was seen before it: the patient may have moved then."""
MOVED_IMAGES: Final = 3
"""... if so many images in a row say so."""


class State(Enum):
    """What the wall does; SurfaceMotion.msg explains the names."""

    QUIET = auto()
    SPOILED = auto()
    MOVED = auto()
    LOST = auto()


@dataclass(frozen=True, slots=True)
class Followed:
    """What one image tells."""

    state: State
    displacement: float
    """[m] at the exposure."""
    forecast: Array
    """[m] FORECAST_S after it."""
    sigma: float
    """Standard deviation of the displacement [m]."""
    shift: Array
    """Displacement of the body since the first look, in A [m], shape (3,)."""


NOTHING: Final = Followed(State.LOST, 0.0, np.zeros(len(FORECAST_S)), 0.1, np.zeros(3))
"""What is told before a wall is known."""


class Tracker:
    """Follows one wall."""

    def __init__(self, wall: SeenWall, t_s: Array, d: Array, corners: Array) -> None:
        """A wall displaced by `d` [m] at times `t_s` [s], shape (n,) each; `corners` of the region in A, shape (m, 3)."""
        self.wall = wall
        self.average = WallAverage(wall, len(t_s))
        """What the images of a quiet wall show in the mean."""
        self._filter = BreathFilter(t_s, d)
        middle = corners.mean(axis=0)
        self._reasons = reasons(wall.lifts, wall.n_A, wall.p_A - middle)
        self._corners = corners - middle
        self._patch = _patches(wall.p_A)
        self._shared = SHARED_M**2
        self._certainty = (wall.gain / wall.sigma) ** 2
        self._whole = float(self._certainty @ wall.lifts**2)
        self._precision = np.zeros((4, 4))
        self._pull = np.zeros(4)
        self._prior = np.diag(np.array(PRIOR) ** -2.0)
        self._calm_s = float(t_s[-1])
        self._drift = np.zeros(4)
        self._usual = 1.0
        self._last_s = float(t_s[-1])
        self._votes = 0
        self._moved = False

    @property
    def moved(self) -> bool:
        """Whether the patient lies elsewhere than where the wall was learnt."""
        return self._moved

    def follow(self, t_s: float, depth: Array, hidden: NDArray[np.bool_]) -> Followed:
        """Takes the wall's pixels of an image exposed at `t_s` [s]: depth [m], and whether the arm may hide it, (n,) each."""
        expected, spread = self._filter.forward(t_s)
        y = (depth - self.wall.depth) / self.wall.gain
        use = np.isfinite(depth) & ~hidden & (np.abs(y - self.wall.lifts * expected) < REACH_M)
        y = np.where(use, y, 0.0)
        weight = np.where(use, self._certainty, 0.0)
        if float(weight @ self.wall.lifts**2) < LEAST_SHARE * self._whole:
            return self._told(State.MOVED if self._moved else State.LOST, expected)
        d, weight = self._displacement(y, weight, expected)
        if not weight.any():
            return self._told(State.MOVED if self._moved else State.LOST, expected)
        still = y - self.wall.lifts * d
        elapsed = min(t_s - self._last_s, GAP_S)
        self._weigh_error(elapsed, still, weight)
        self._weigh_motion(elapsed, still, weight)
        self._last_s = t_s
        noise = float(np.sqrt(1 / (weight @ self.wall.lifts**2) + self._shared))
        surprise = abs(d - expected)
        if surprise > max(SURPRISE * np.hypot(spread, noise), SURPRISE_M) or d > DEEP * self._filter.depth + SURPRISE_M:
            self._calm_s = t_s + CALM_S
        if surprise > SURPRISE * np.hypot(spread, noise) and surprise > SURPRISE_M:
            self._filter.forget(d)
        else:
            self._filter.update(d, noise)
        self._filter.remember(d)
        if self._moved:
            return self._told(State.MOVED, d)
        quiet = t_s >= self._calm_s
        if quiet:
            self.average.add(still, weight > 0)
        return self._told(State.QUIET if quiet else State.SPOILED, float(self._filter.forecast(np.zeros(1))[0]))

    def _told(self, state: State, d: float) -> Followed:
        shift = np.append((self._motion - self._drift)[1:3], 0.0) if state is State.MOVED else np.zeros(3)
        sigma = float(np.hypot(self._filter.sigma, np.sqrt(self._shared)))
        return Followed(state, float(d), self._filter.forecast(FORECAST_S), sigma, shift)

    def _displacement(self, y: Array, weight: Array, expected: float) -> tuple[float, Array]:
        """The breath alone [m], and the weights with which pixels count for it: Tukey's biweight, about the median first."""
        lifts = self.wall.lifts
        clear = (weight > 0) & (lifts > 0.3)
        d = float(np.median(y[clear] / lifts[clear])) if clear.any() else expected
        robust = weight
        for _ in range(2):
            away = (y - lifts * d) ** 2 * self._certainty / TUKEY**2
            robust = weight * np.clip(1 - away, 0, None) ** 2
            d = float(robust @ (lifts * y)) / max(float(robust @ lifts**2), 1e-9)
        return d, robust

    def _weigh_error(self, elapsed_s: float, left: Array, weight: Array) -> None:
        """Counts what an image, `elapsed_s` [s] after the last, leaves over [m], shape (n,), for what pixels err by together."""
        variance = jackknife(left, weight, self.wall.lifts, self._patch)
        if variance is not None:
            self._shared += (1 - np.exp(-elapsed_s / SHARED_S)) * (0.5 * variance - self._shared)

    def _weigh_motion(self, elapsed_s: float, left: Array, weight: Array) -> None:
        """Counts what an image, `elapsed_s` [s] after the last, leaves over [m], shape (n,), for the rigid motion."""
        weighted = weight[:, np.newaxis] * self._reasons
        self._precision = KEPT * self._precision + (1 - KEPT) * self._reasons.T @ weighted
        self._pull = KEPT * self._pull + (1 - KEPT) * weighted.T @ left
        moving = self.moved_by > MOVED_M and self.evidence > MOVED_SQUARED * self._usual
        self._votes = self._votes + 1 if moving else 0
        if not self._votes and not self._moved:
            evidence = min(self.evidence, UNUSUAL * self._usual)
            self._usual = max(1.0, self._usual + (1 - np.exp(-elapsed_s / USUAL_S)) * (evidence - self._usual))
            self._drift += (1 - np.exp(-elapsed_s / DRIFT_S)) * (self._motion - self._drift)
        self._moved = self._moved or self._votes >= MOVED_IMAGES

    @property
    def _motion(self) -> Array:
        """What is left of d, s_x, s_y and theta, shape (4,)."""
        return np.asarray(np.linalg.solve(self._precision + self._prior, self._pull))

    @property
    def evidence(self) -> float:
        """Squared Mahalanobis distance of the body's motion from none, by its posterior covariance."""
        covariance = np.linalg.inv(self._precision + self._prior)[1:, 1:]
        motion = (self._motion - self._drift)[1:]
        return float(motion @ np.linalg.solve(covariance, motion))

    @property
    def moved_by(self) -> float:
        """How far the region has moved [m], root mean square over its corners, without a rise that they share."""
        _, s_x, s_y, theta = self._motion - self._drift
        moved = np.array((s_x, s_y, 0.0)) + np.cross((0.0, theta, 0.0), self._corners)
        moved[:, 2] -= moved[:, 2].mean()
        return float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))


def jackknife(left: Array, weight: Array, lifts: Array, patch: NDArray[np.intp]) -> float | None:
    """The variance [m^2] of d by patches, from what it leaves over [m], weights, the mode and the patch of each pixel, (n,) each.

    None where one patch tells more than all others together, so that nothing is known of what they share.
    """
    told, pull = np.bincount(patch, weight * lifts**2), np.bincount(patch, weight * lifts * left)
    if not told.any() or told.max() > 0.5 * told.sum():
        return None
    return float(np.sum((pull / (told.sum() - told)) ** 2))


def _patches(p_A: Array) -> NDArray[np.intp]:
    """The number of the patch of the wall in which each place lies [m], shape (n, 3) -> (n,)."""
    cell = np.floor((p_A[:, :2] - p_A[:, :2].min(axis=0)) / PATCH_M).astype(np.intp)
    return np.asarray(np.unique(cell, axis=0, return_inverse=True)[1]).ravel()
