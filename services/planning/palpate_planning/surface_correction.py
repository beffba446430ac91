"""How wrong the perceived surface is, learned from touches: a Gaussian process over the abdomen's xy plane.

The surface lies c(x) outward of where the camera saw it. Camera and arm agree to centimetres, yet what is wrong is smooth: an
offset, a tilt, a shift along the table, which moves the skin outward where its normal n leans that way, and what the camera sees
bent,

    k(x, x') = OFFSET_M^2 + TILT_RAD^2 x.x' + SHIFT_M^2 n_xy(x).n_xy(x') + a^2 FIELD_M^2 exp(-|x - x'|^2 / (2 FIELD_LENGTH_M^2)).

Each touch measures c at its place with an error of its own, and from n of them (Rasmussen and Williams 2006, eq. 2.25 and 2.26)

    c(x) = k(x)^T (K + S)^-1 y,     var c(x) = k(x, x) - k(x)^T (K + S)^-1 k(x).

How rough the error is, a, is the touches' to tell: of a few values the one that makes them most probable, given a prior about
what is expected (their eq. 2.30). A camera without error leaves a small a, and a surface that is known within what a touch gets
wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from palpate_models.frames import Array

OFFSET_M = 0.012
"""Standard deviations before any touch, after `docs/errors.md`: camera and its calibration, arm and warming up together [C];"""
TILT_RAD = 0.025
"""the same about two axes;"""
SHIFT_M = 0.008
"""the same along two axes: 5 mm of a camera that is turned by 0.3 degrees, and some of its place and of the arm [C];"""
FIELD_M, FIELD_LENGTH_M = 0.0006, 0.020
"""what an offset and a tilt leave of the camera's field and of its wander, which outlasts the frames that are fused: 0.50 mm on
these patients, and the length of their variogram; nothing that varies over more is left."""
ROUGHNESSES = 2.0 ** np.arange(-5, 3)
"""What a may be, ..."""
ROUGHNESS_SD = 0.5
"""... and the standard deviation of its logarithm about that of what is expected [A]."""
AVERAGED = 0.35
"""How rough the error is expected to be of a surface that the images of a whole examination show in the mean."""


Leaning = Callable[[Array], Array]
"""The xy parts of the outward unit normals of a surface over places, (n, 2) of both."""


def level(xy_A: Array) -> Array:
    """The leaning of a level surface."""
    return np.zeros_like(xy_A)


class SurfaceCorrection:
    """The correction c(x) [m] outward, and how sure it is. Places are in A's xy plane [m]."""

    def __init__(self, leaning: Leaning = level, expected_roughness: float = 1.0) -> None:
        """Of a surface that leans so, and whose error is expected to be so rough, over that of one burst."""
        self._leaning, self._expected = leaning, expected_roughness
        self._touched = _Places(np.empty((0, 2)), np.empty((0, RIGID)))
        self._heights, self._variances = np.empty(0), np.empty(0)
        self._fit = _Fit(expected_roughness, np.empty((0, 0)), np.empty(0), 0.0)

    @property
    def roughness(self) -> float:
        """How rough the error is, over what it is expected to be: a."""
        return self._fit.roughness

    def touch(self, xy_A: Array, height: float, sigma: float) -> None:
        """The surface was felt at `xy_A`, shape (2,), `height` [m] outward of where it was perceived, within `sigma` [m]."""
        self._touched = _Places(*map(np.vstack, zip(self._touched, self._places(xy_A[None]), strict=True)))
        self._heights = np.append(self._heights, height)
        self._variances = np.append(self._variances, sigma**2)
        self._learn()

    def revise(self, height: float, sigma: float) -> None:
        """The latest touch was at another height [m] than was said, and another standard deviation holds [m]."""
        self._heights[-1], self._variances[-1] = height, sigma**2
        self._learn()

    def seen_again(self, leaning: Leaning) -> None:
        """The wall is seen anew, and leans so: of the touches so far all holds that is rigid, the field is another one."""
        self._leaning = leaning
        if len(self._heights):
            self._variances = self._variances + 2 * (self._fit.roughness * FIELD_M) ** 2
            self._learn()

    def _learn(self) -> None:
        fits = (_fit(float(a), self._expected, self._touched, self._heights, self._variances) for a in ROUGHNESSES)
        self._fit = max(fits, key=lambda fit: fit.log_probability)

    def averaged(self, outward: Callable[[Array], Array]) -> SurfaceCorrection:
        """What the same touches tell of a better surface, which lies `outward` [m] of this one at places (n, 2)."""
        better = SurfaceCorrection(self._leaning, AVERAGED)
        better._touched, better._variances = self._touched, self._variances
        better._heights = self._heights - outward(self._touched.xy)
        better._learn()
        return better

    def height(self, xy_A: Array) -> float:
        """C [m] at a place, shape (2,)."""
        return float((_covariance(self._places(xy_A[None]), self._touched, self._fit.roughness) @ self._fit.weights)[0])

    def sigma(self, xy_A: Array) -> float:
        """Standard deviation of c [m] at a place, shape (2,)."""
        return self.at(xy_A)[1]

    def at(self, xy_A: Array) -> tuple[float, float]:
        """C and its standard deviation [m] at a place, shape (2,)."""
        height, sigma = self.over(xy_A[None])
        return float(height[0]), float(sigma[0])

    def over(self, xy_A: Array) -> tuple[Array, Array]:
        """C and its standard deviation [m] at places, shape (n, 2): shape (n,) each."""
        places = self._places(xy_A)
        prior = (places.rigid**2).sum(axis=1) + self._fit.roughness**2 * FIELD_M**2
        k = _covariance(places, self._touched, self._fit.roughness)
        known = ((k @ self._fit.precision) * k).sum(axis=1)
        return k @ self._fit.weights, np.sqrt(np.maximum(prior - known, 0.0))

    def _places(self, xy_A: Array) -> _Places:
        offset = np.full((len(xy_A), 1), OFFSET_M)
        return _Places(xy_A, np.hstack((offset, TILT_RAD * xy_A, SHIFT_M * self._leaning(xy_A))))


RIGID = 5
"""Motions of the whole surface: an offset, two tilts, two shifts."""


class _Places(NamedTuple):
    """Places, and what each rigid motion moves the skin outward there."""

    xy: Array
    """In A [m], shape (n, 2)."""
    rigid: Array
    """By a motion of one standard deviation [m], shape (n, RIGID)."""


class _Fit(NamedTuple):
    """The process given the touches, for one roughness."""

    roughness: float
    precision: Array
    """(K + S)^-1 [1/m^2]: places are asked about at every step, and touched seldom."""
    weights: Array
    """(K + S)^-1 y [1/m]."""
    log_probability: float
    """Logarithm of the probability of the touches and the roughness, but for a constant."""


def _fit(roughness: float, expected: float, touched: _Places, heights: Array, variances: Array) -> _Fit:
    """The process, whose roughness is `expected`, given n touches of heights (n,) [m] within variances [m^2]."""
    factor = cho_factor(_covariance(touched, touched, roughness) + np.diag(variances), lower=True)
    weights = cho_solve(factor, heights)
    prior = -0.5 * (math.log(roughness / expected) / ROUGHNESS_SD) ** 2
    evidence = -0.5 * float(heights @ weights) - float(np.log(np.diag(factor[0])).sum())
    return _Fit(roughness, cho_solve(factor, np.eye(len(heights))), weights, prior + evidence)


def _covariance(a: _Places, b: _Places, roughness: float) -> Array:
    """The covariance of m places with n, shape (m, n)."""
    apart = ((a.xy[:, None] - b.xy) ** 2).sum(axis=-1)
    field = FIELD_M**2 * np.exp(-apart / (2 * FIELD_LENGTH_M**2))
    return np.asarray(a.rigid @ b.rigid.T + roughness**2 * field)
