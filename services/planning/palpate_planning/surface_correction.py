"""How wrong the perceived surface is, learned from touches: a Gaussian process over the abdomen's xy plane.

The surface lies c(x) outward of where the camera saw it. Camera and arm agree to centimetres, yet what is wrong is smooth: an
offset, a tilt, and a field that varies over a few centimetres,

    k(x, x') = OFFSET_M^2 + TILT_RAD^2 x.x' + FIELD_M^2 exp(-|x - x'|^2 / (2 FIELD_LENGTH_M^2)).

Each touch measures c at its place with an error of its own, and from n of them (Rasmussen and Williams 2006, eq. 2.25 and 2.26)

    c(x) = k(x)^T (K + S)^-1 y,     var c(x) = k(x, x) - k(x)^T (K + S)^-1 k(x).
"""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from palpate_models.frames import Array

OFFSET_M = 0.012
"""Standard deviations before any touch, after `docs/errors.md`: camera and its calibration, arm and warming up together [C];"""
TILT_RAD = 0.010
"""hand-eye and arm about two axes [C];"""
FIELD_M = 0.002
"""the camera's bias field and wander [A],"""
FIELD_LENGTH_M = 0.050
"""which a bias field varies over [A]."""


class SurfaceCorrection:
    """The correction c(x) [m] outward, and how sure it is. Places are in A's xy plane [m]."""

    def __init__(self) -> None:
        self._places = np.empty((0, 2))
        self._heights, self._variances, self._weights = np.empty(0), np.empty(0), np.empty(0)
        self._precision: Array = np.empty((0, 0))
        """(K + S)^-1 [1/m^2]: places are asked about at every step, and touched seldom."""

    def touch(self, xy_A: Array, height: float, sigma: float) -> None:
        """The surface was felt at `xy_A`, shape (2,), `height` [m] outward of where it was perceived, within `sigma` [m]."""
        self._places = np.vstack((self._places, xy_A))
        self._heights = np.append(self._heights, height)
        self._variances = np.append(self._variances, sigma**2)
        factor = cho_factor(_covariance(self._places, self._places) + np.diag(self._variances), lower=True)
        self._weights = cho_solve(factor, self._heights)
        self._precision = cho_solve(factor, np.eye(len(self._heights)))

    def height(self, xy_A: Array) -> float:
        """C [m] at a place, shape (2,)."""
        return float(_covariance(xy_A, self._places) @ self._weights)

    def sigma(self, xy_A: Array) -> float:
        """Standard deviation of c [m] at a place, shape (2,)."""
        prior = OFFSET_M**2 + TILT_RAD**2 * float(xy_A @ xy_A) + FIELD_M**2
        k = _covariance(xy_A, self._places)
        return math.sqrt(max(prior - float(k @ self._precision @ k), 0.0))


def _covariance(a: Array, b: Array) -> Array:
    """The covariance of places a, shape (..., 2), with places b, shape (n, 2): shape (..., n)."""
    apart = ((a[..., None, :] - b) ** 2).sum(axis=-1)
    return np.asarray(OFFSET_M**2 + TILT_RAD**2 * (a @ b.T) + FIELD_M**2 * np.exp(-apart / (2 * FIELD_LENGTH_M**2)))
