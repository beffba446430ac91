"""How wrong the perceived surface is, learned from touches: a Gaussian process over the abdomen's xy plane.

The surface lies c(x) outward of where the camera saw it. Camera and arm agree to centimetres, yet what is wrong is smooth: an
offset, a tilt, and what the camera sees bent,

    k(x, x') = OFFSET_M^2 + TILT_RAD^2 x.x' + a^2 FIELD_M^2 exp(-|x - x'|^2 / (2 FIELD_LENGTH_M^2)).

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
"""the same about two axes: a camera that is off sideways sees a curved wall tilted, by 18 mrad on 12 patients of tuning seeds;"""
FIELD_M, FIELD_LENGTH_M = 0.0006, 0.020
"""what an offset and a tilt leave of the camera's field and of its wander, which outlasts the frames that are fused: 0.50 mm on
these patients, and the length of their variogram; nothing that varies over more is left."""
ROUGHNESSES = 2.0 ** np.arange(-5, 2)
"""What a may be, ..."""
ROUGHNESS_SD = 0.5
"""... and the standard deviation of its logarithm about that of what is expected [A]."""
AVERAGED = 0.35
"""How rough the error is expected to be of a surface that the images of a whole examination show in the mean."""


class SurfaceCorrection:
    """The correction c(x) [m] outward, and how sure it is. Places are in A's xy plane [m]."""

    def __init__(self, expected_roughness: float = 1.0) -> None:
        """Of a surface whose error is expected to be so rough, over that of one burst."""
        self._expected = expected_roughness
        self._places = np.empty((0, 2))
        self._heights, self._variances = np.empty(0), np.empty(0)
        self._fit = _Fit(expected_roughness, np.empty((0, 0)), np.empty(0), 0.0)

    @property
    def roughness(self) -> float:
        """How rough the error is, over what it is expected to be: a."""
        return self._fit.roughness

    def touch(self, xy_A: Array, height: float, sigma: float) -> None:
        """The surface was felt at `xy_A`, shape (2,), `height` [m] outward of where it was perceived, within `sigma` [m]."""
        self._places = np.vstack((self._places, xy_A))
        self._heights = np.append(self._heights, height)
        self._variances = np.append(self._variances, sigma**2)
        self._learn()

    def revise(self, height: float, sigma: float) -> None:
        """The latest touch was at another height [m] than was said, and another standard deviation holds [m]."""
        self._heights[-1], self._variances[-1] = height, sigma**2
        self._learn()

    def blur(self) -> None:
        """The wall is seen anew: of the touches so far the offset and the tilt hold, the field is another one."""
        if len(self._heights):
            self._variances = self._variances + 2 * (self._fit.roughness * FIELD_M) ** 2
            self._learn()

    def _learn(self) -> None:
        fits = (_fit(float(a), self._expected, self._places, self._heights, self._variances) for a in ROUGHNESSES)
        self._fit = max(fits, key=lambda fit: fit.log_probability)

    def averaged(self, outward: Callable[[Array], Array]) -> SurfaceCorrection:
        """What the same touches tell of a better surface, which lies `outward` [m] of this one at places (n, 2)."""
        better = SurfaceCorrection(AVERAGED)
        better._places, better._variances = self._places, self._variances
        better._heights = self._heights - outward(self._places)
        better._learn()
        return better

    def height(self, xy_A: Array) -> float:
        """C [m] at a place, shape (2,)."""
        return float(_covariance(xy_A, self._places, self._fit.roughness) @ self._fit.weights)

    def sigma(self, xy_A: Array) -> float:
        """Standard deviation of c [m] at a place, shape (2,)."""
        return self.at(xy_A)[1]

    def at(self, xy_A: Array) -> tuple[float, float]:
        """C and its standard deviation [m] at a place, shape (2,)."""
        height, sigma = self.over(xy_A[None])
        return float(height[0]), float(sigma[0])

    def over(self, xy_A: Array) -> tuple[Array, Array]:
        """C and its standard deviation [m] at places, shape (n, 2): shape (n,) each."""
        prior = OFFSET_M**2 + TILT_RAD**2 * (xy_A**2).sum(axis=1) + self._fit.roughness**2 * FIELD_M**2
        k = _covariance(xy_A, self._places, self._fit.roughness)
        known = ((k @ self._fit.precision) * k).sum(axis=1)
        return k @ self._fit.weights, np.sqrt(np.maximum(prior - known, 0.0))


class _Fit(NamedTuple):
    """The process given the touches, for one roughness."""

    roughness: float
    precision: Array
    """(K + S)^-1 [1/m^2]: places are asked about at every step, and touched seldom."""
    weights: Array
    """(K + S)^-1 y [1/m]."""
    log_probability: float
    """Logarithm of the probability of the touches and the roughness, but for a constant."""


def _fit(roughness: float, expected: float, places: Array, heights: Array, variances: Array) -> _Fit:
    """The process, whose roughness is `expected`, given touches at places (n, 2) of heights (n,) [m] within variances [m^2]."""
    factor = cho_factor(_covariance(places, places, roughness) + np.diag(variances), lower=True)
    weights = cho_solve(factor, heights)
    prior = -0.5 * (math.log(roughness / expected) / ROUGHNESS_SD) ** 2
    evidence = -0.5 * float(heights @ weights) - float(np.log(np.diag(factor[0])).sum())
    return _Fit(roughness, cho_solve(factor, np.eye(len(heights))), weights, prior + evidence)


def _covariance(a: Array, b: Array, roughness: float) -> Array:
    """The covariance of places a, shape (..., 2), with places b, shape (n, 2): shape (..., n)."""
    apart = ((a[..., None, :] - b) ** 2).sum(axis=-1)
    field = FIELD_M**2 * np.exp(-apart / (2 * FIELD_LENGTH_M**2))
    return np.asarray(OFFSET_M**2 + TILT_RAD**2 * (a @ b.T) + roughness**2 * field)
