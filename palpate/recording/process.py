"""A Gaussian process over places, whose variance, length and noise maximise the marginal likelihood."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.optimize import Bounds, minimize
from scipy.spatial.distance import cdist

from palpate_models.numerics.frames import Array

_TOGETHER = 200
Correlation = Callable[[Array], Array]
"""Correlation of values at two places, by their distance over the length, any shape."""


def gaussian(distance: Array) -> Array:
    """Return the squared-exponential correlation."""
    return np.asarray(np.exp(-0.5 * distance**2))


def matern(distance: Array) -> Array:
    """Return Matern's correlation with nu = 3/2."""
    return np.asarray((1 + np.sqrt(3) * distance) * np.exp(-np.sqrt(3) * distance))


def _parts(places: Array) -> list[Array]:
    """Return places in parts, whose covariances take little memory."""
    return np.array_split(places, len(places) // _TOGETHER + 1)


@dataclass(frozen=True, eq=False)
class PlaceProcess:
    """A process of mean 0 and its observations at n places."""

    places: Array
    """Shape (n, 2)."""
    values: Array
    """Shape (n,)."""
    known_noise: Array
    """Variance of each value, shape (n,)."""
    log_parameters: Array
    """Logarithms of variance, length and variance of further noise, shape (3,)."""
    correlation: Correlation = gaussian

    @cached_property
    def cholesky(self) -> Array:
        """Lower Cholesky factor of the covariance of the values, shape (n, n)."""
        noise = self.known_noise + np.exp(self.log_parameters[2])
        return np.asarray(cholesky(self._covariance(self.places) + np.diag(noise), lower=True))

    @cached_property
    def weights(self) -> Array:
        """Inverse of the covariance times the values, shape (n,)."""
        return np.asarray(cho_solve((self.cholesky, True), self.values))

    def fit(self, bounds: Sequence[tuple[float, float]]) -> "PlaceProcess":
        """Return the process with the most probable parameters within `bounds` of variance, length and further noise."""

        def misfit(parameters: Array) -> float:
            tried = replace(self, log_parameters=parameters)
            return float(0.5 * tried.values @ tried.weights + np.log(np.diag(tried.cholesky)).sum())

        found = minimize(misfit, self.log_parameters, method="L-BFGS-B", bounds=Bounds(*np.log(bounds).T))
        return replace(self, log_parameters=found.x)

    def mean(self, places: Array) -> Array:
        """Return the mean at places, shape (k, 2) -> (k,)."""
        return np.concatenate([self._covariance(part) @ self.weights for part in _parts(places)])

    def sd(self, places: Array) -> Array:
        """Return the SD of the mean at places, shape (k, 2) -> (k,)."""
        parts = (solve_triangular(self.cholesky, self._covariance(part).T, lower=True) for part in _parts(places))
        explained = np.concatenate([(part**2).sum(axis=0) for part in parts])
        return np.asarray(np.sqrt(np.maximum(np.exp(self.log_parameters[0]) - explained, 0)))

    def _covariance(self, places: Array) -> Array:
        """Return the covariance of values at places with the process at its own, shape (k, 2) -> (k, n)."""
        variance, length, _ = np.exp(self.log_parameters)
        return np.asarray(variance * self.correlation(cdist(places, self.places) / length))
