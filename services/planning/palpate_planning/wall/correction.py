"""How wrong the perceived surface is, learned from touches: a Gaussian process over the abdomen's xy plane.

The surface lies c(x) outward of where the camera saw it. Camera and arm agree to centimetres, yet what is wrong is smooth: an
offset, a tilt, and what the camera sees bent,

    k(x, x') = OFFSET_M^2 + TILT_RAD^2 x.x' + a^2 FIELD_M^2 exp(-|x - x'|^2 / (2 FIELD_LENGTH_M^2)).

Each touch measures c at its place with an error of its own, s_i, and with what the camera got wrong of the breath then, b_i,
which lasts for some seconds and is partly the next touch's, too. From n of them (Rasmussen and Williams 2006, eq. 2.25 and 2.26)

    c(x) = k(x)^T (K + S)^-1 y,     var c(x) = k(x, x) - k(x)^T (K + S)^-1 k(x),
    S_ij = s_i^2 [i = j] + b_i b_j exp(-|t_i - t_j| / LASTING_S).

How rough the error is, a, is the touches' to tell: of a few values the one that makes them most probable, given a prior about
what is expected (their eq. 2.30). A camera without error leaves a small a, and a surface that is known within what a touch gets
wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from palpate_models.numerics.frames import Array

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
LASTING_S = 10.0
"""How long errors last that neighbouring pixels share, after `docs/errors.md`."""
AVERAGED = 0.35
"""How rough the error is expected to be of a surface that the images of a whole examination show in the mean."""


class FeltHeight(NamedTuple):
    """The surface was felt."""

    xy_A: Array
    """Where, shape (2,)."""
    height: float
    """How far outward of where it was perceived [m]."""
    sigma: float
    """Standard deviation of its own error [m]."""
    breath_sigma: float = 0.0
    """Standard deviation of what the breath that was followed erred by, which goes on for a while [m]."""
    t_s: float = 0.0
    """When [s]."""


class SurfaceCorrection:
    """The correction c(x) [m] outward, and how sure it is. Places are in A's xy plane [m]."""

    def __init__(self, expected_roughness: float = 1.0) -> None:
        """Of a surface whose error is expected to be so rough, over that of one burst."""
        self._expected = expected_roughness
        self._touches: tuple[FeltHeight, ...] = ()
        self._blurred = np.empty(0)
        """Variance that later looks have added to each touch's own [m^2]."""
        self._learn()

    @property
    def roughness(self) -> float:
        """How rough the error is, over what it is expected to be: a."""
        return self._fit.roughness

    def touch(self, touch: FeltHeight) -> None:
        """Learns from another touch."""
        self._touches = (*self._touches, touch)
        self._blurred = np.append(self._blurred, 0.0)
        self._learn()

    def revise(self, touch: FeltHeight) -> None:
        """The latest touch was otherwise than was said."""
        self._touches = (*self._touches[:-1], touch)
        self._learn()

    def blur(self) -> None:
        """The wall is seen anew: of the touches so far the offset and the tilt hold, the field is another one."""
        self._blurred = self._blurred + 2 * (self._fit.roughness * FIELD_M) ** 2
        self._learn()

    def _learn(self) -> None:
        self._places = np.array([touch.xy_A for touch in self._touches]).reshape(-1, 2)
        heights = np.array([touch.height for touch in self._touches])
        errors = _errors(self._touches) + np.diag(self._blurred)
        fits = (_fit(float(a), self._expected, self._places, heights, errors) for a in ROUGHNESSES)
        self._fit = max(fits, key=lambda fit: fit.log_probability)

    def averaged(self, outward: Callable[[Array], Array]) -> SurfaceCorrection:
        """What the same touches tell of a better surface, which lies `outward` [m] of this one at places (n, 2)."""
        better = SurfaceCorrection(AVERAGED)
        less = outward(self._places)
        better._touches = tuple(t._replace(height=t.height - h) for t, h in zip(self._touches, less.tolist(), strict=True))
        better._blurred = self._blurred
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


def _errors(touches: Sequence[FeltHeight]) -> Array:
    """S, the covariance of what n touches err by [m^2], shape (n, n)."""
    own, breath, t = np.array([(touch.sigma, touch.breath_sigma, touch.t_s) for touch in touches]).reshape(-1, 3).T
    return np.asarray(np.diag(own**2) + np.outer(breath, breath) * np.exp(-np.abs(t[:, None] - t) / LASTING_S))


def _fit(roughness: float, expected: float, places: Array, heights: Array, errors: Array) -> _Fit:
    """The process, whose roughness is `expected`, given touches at places (n, 2) of heights (n,) [m] with errors S."""
    factor = cho_factor(_covariance(places, places, roughness) + errors, lower=True)
    weights = cho_solve(factor, heights)
    prior = -0.5 * (math.log(roughness / expected) / ROUGHNESS_SD) ** 2
    evidence = -0.5 * float(heights @ weights) - float(np.log(np.diag(factor[0])).sum())
    return _Fit(roughness, cho_solve(factor, np.eye(len(heights))), weights, prior + evidence)


def _covariance(a: Array, b: Array, roughness: float) -> Array:
    """The covariance of places a, shape (..., 2), with places b, shape (n, 2): shape (..., n)."""
    apart = ((a[..., None, :] - b) ** 2).sum(axis=-1)
    field = FIELD_M**2 * np.exp(-apart / (2 * FIELD_LENGTH_M**2))
    return np.asarray(OFFSET_M**2 + TILT_RAD**2 * (a @ b.T) + roughness**2 * field)
