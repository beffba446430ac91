"""Forces to foundation modulus: Bayesian inversion of the footprint's blur, with its uncertainty.

What the indenter feels is the modulus averaged over its footprint (contact.py). With z = log k_w on the grid's nodes and H the
footprints of the samples (rows sum to 1),

    log(F / F_ref) = f(z) + noise,   f(z) = 1/p log(H exp(p z)),   z ~ N(m, K)

The posterior's mode follows by Gauss-Newton; its covariance is the Gaussian one at the mode.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular
from scipy.spatial.distance import cdist

from palpate_assessment.contact import REACH, ReferenceContact
from palpate_assessment.grid import MapGrid
from palpate_assessment.prior import Field
from palpate_assessment.sampling import ForceSample
from palpate_models.frames import Array

POWER = 0.8
"""Exponent p of the mean over the footprint: 1 to first order; a wall that gives way beside a stiff area makes it a little less
(fitted on transient solutions with lesions of contrast 2.5 and 4: residual 2 % RMS)."""
Z90 = 1.6449
"""Two-sided 90 % quantile of the normal distribution."""


@dataclass(frozen=True)
class Noise:
    """What the samples get wrong. How large the depth's errors are is estimated from the scan itself (`estimate_noise`)."""

    depth_white: float = 0.0002
    """Depth error of a sample by itself [m]: mesh ripple, control, sensor."""
    depth_smooth: float = 0.0004
    """Error of the perceived surface [m], correlated over `depth_length`."""
    depth_length: float = 0.015
    """[m]"""
    depth_common: float = 0.0001
    """Error of the perceived surface that is common to all samples [m]. A scan cannot tell it from a stiffer patient."""
    model_common: float = 0.015
    """Relative error of the contact model that is common to all samples [1]: the wall's discretisation and constants."""
    model_white: float = 0.01
    """That of a sample by itself [1]."""
    model_edge: float = 0.06
    """Relative error of the footprint, over the spread of log k_w under it [1]: the residual that POWER leaves."""
    edge_length: float = 0.010
    """Over which it is correlated [m]."""

    def covariance(self, steep: Array, squared_distance: Array, relative: Array, spread: Array) -> Array:
        """Covariance of log(F / F_ref), shape (m, m).

        `steep`: d log F / d depth [1/m]; `squared_distance` of the samples [m^2], shape (m, m); `relative` force noise [1];
        `spread`: standard deviation of log k_w under each footprint [1].
        """
        covariance = self.of_depth(steep, squared_distance) + self.of_model(squared_distance, relative, spread)
        covariance[np.diag_indices(len(steep))] += (steep * self.depth_white) ** 2
        return np.asarray(covariance)

    def of_depth(self, steep: Array, squared_distance: Array) -> Array:
        """The part of `covariance` that errors of depth make, but for the white one, which is on the diagonal alone."""
        smooth = self.depth_smooth**2 * np.exp(squared_distance * (-0.5 / self.depth_length**2)) + self.depth_common**2
        return np.asarray(np.outer(steep, steep) * smooth)

    def of_model(self, squared_distance: Array, relative: Array, spread: Array) -> Array:
        """The part of `covariance` that is not of depth: the contact model's errors and the noise of the force."""
        covariance = np.full_like(squared_distance, self.model_common**2)
        if spread.any():
            edge = self.model_edge * spread
            covariance += np.outer(edge, edge) * np.exp(squared_distance * (-0.5 / self.edge_length**2))
        covariance[np.diag_indices(len(relative))] += relative**2 + self.model_white**2
        return covariance


@dataclass(frozen=True)
class Observations:
    """Samples as observations of log k_w."""

    value: Array
    """log(F / F_ref), log of an effective k_w in N/m^3, shape (m,)."""
    noise: Noise
    steep: Array
    """d log F / d depth [1/m], shape (m,)."""
    squared_distance: Array
    """Squared distances between the samples [m^2], shape (m, m)."""
    relative: Array
    """Noise of the force over the force [1], shape (m,)."""
    footprint: Array
    """Weight of each node in each sample, rows sum to 1, shape (m, n)."""
    spread: Array
    """Standard deviation of log k_w under each footprint [1], shape (m,); zero before anything is known."""

    @cached_property
    def covariance(self) -> Array:
        """Covariance of the noise, shape (m, m)."""
        return self.noise.covariance(self.steep, self.squared_distance, self.relative, self.spread)


@dataclass(frozen=True)
class Posterior:
    """log k_w given the samples, on the grid's nodes."""

    mean: Array
    """Shape (n,)."""
    jacobian: Array
    """J = df/dz at the mode, shape (m, n)."""
    residual: Array
    """Linearised data minus the prior's mean, y - f(z) + J (z - m), shape (m,)."""
    weights: Array
    """(J K J' + R)^-1 residual, shape (m,): a component's own posterior mean is its covariance times J' weights."""
    prior: Field
    """The field that was assumed."""
    seen: Array
    """J B with the prior's factor K = B B', shape (m, modes)."""
    triangle: Array
    """Lower Cholesky factor of J K J' + R, shape (m, m); above the diagonal it is anything."""

    def sd_of(self, rows: Array) -> Array:
        """Standard deviation of rows [k, n] times log k_w, shape (k,)."""
        own = self.prior.factor(rows)
        half = solve_triangular(self.triangle, self.seen @ own.T, lower=True, overwrite_b=True)
        variance = np.einsum("ij,ij->i", own, own) - np.einsum("ij,ij->j", half, half)
        return np.asarray(np.sqrt(np.maximum(variance, 1e-8)))


def reference_force(samples: Sequence[ForceSample], contact: ReferenceContact, curvature: Array) -> Array:
    """Force over k_w [m^3] that a homogeneous wall would show at each sample, shape (m,).

    Depth is led by the dashpot (u + tau du/dt); the path's memory is taken off.
    """
    depth = np.array([s.depth for s in samples])
    rate = np.array([s.depth_rate for s in samples])
    lost = np.array([s.lost for s in samples])
    instantaneous = contact.force(depth + contact.material.dashpot_s * rate, curvature)
    return np.asarray(np.maximum(instantaneous * (1.0 - lost / contact.force(depth)), 1e-12))


def observe(samples: Sequence[ForceSample], grid: MapGrid, contact: ReferenceContact, noise: Noise) -> Observations:
    """The samples as observations on a grid. Samples need positive depth and force."""
    position = np.array([s.position for s in samples])
    depth = np.array([s.depth for s in samples])
    force = np.array([s.force for s in samples])
    value = np.log(force / reference_force(samples, contact, grid.curvature(position)))
    return Observations(
        value=value,
        noise=noise,
        steep=contact.exponent(depth) / depth,
        squared_distance=cdist(position, position, "sqeuclidean"),
        relative=np.array([s.force_noise for s in samples]) / force,
        footprint=footprints(samples, grid, contact),
        spread=np.zeros(len(samples)),
    )


def spread_under(footprint: Array, z: Array) -> Array:
    """Standard deviation of log k_w `z`, shape (n,), under each footprint, shape (m,)."""
    mean = footprint @ z
    return np.asarray(np.sqrt(np.maximum(footprint @ z**2 - mean**2, 0.0)))


def footprints(samples: Sequence[ForceSample], grid: MapGrid, contact: ReferenceContact) -> Array:
    """Weight of each node in each sample, shape (m, n), rows sum to 1: distances along the surface are taken in space."""
    centre = np.array([s.position for s in samples]) + contact.advance(np.array([s.velocity for s in samples]))
    levels = np.round(np.clip([s.depth for s in samples], 0.002, 0.02) * 1000)
    distance = cdist(centre, grid.nodes)
    near = np.flatnonzero(distance <= REACH)
    sample, node = np.divmod(near, len(grid.area))
    apart, deep = distance.ravel()[near], levels[sample]
    weights = np.empty_like(apart)
    for level in np.unique(levels):
        mine = deep == level
        weights[mine] = np.interp(apart[mine], *contact.footprint(float(level) / 1000, grid.pitch))
    rows = np.zeros_like(distance)
    rows.ravel()[near] = weights * grid.area[node]
    rows /= rows.sum(axis=1, keepdims=True)
    return rows


def invert(observations: Observations, prior: Field, mean: float, start: Array | None = None, iterations: int = 6) -> Posterior:
    """The posterior of log k_w under a prior field about `mean` (log of N/m^3), by Gauss-Newton from `start`."""
    y, H = observations.value, observations.footprint
    z = np.full(H.shape[1], float(np.median(y))) if start is None else start
    for last in range(iterations):
        power = np.exp(POWER * (z - z.max()))
        total = H @ power
        jacobian = H * power
        jacobian /= total[:, None]
        residual = y - (np.log(total) / POWER + z.max()) + jacobian @ (z - mean)
        seen = prior.factor(jacobian)
        triangle, _ = cho_factor(seen @ seen.T + observations.covariance, lower=True)
        weights = cho_solve((triangle, True), residual)
        step = mean + prior.times((weights @ jacobian)[None])[0] - z
        size = float(np.abs(step).max())
        z = z + step * min(1.0, 1.5 / max(size, 1e-9))
        if size < 0.02 and last:
            break
    return Posterior(z, jacobian, residual, weights, prior, seen, triangle)


_SMOOTH = (0.03, 0.06, 0.12, 0.25, 0.5, 1.0)
_WHITE = (0.03, 0.12, 0.5)
"""Standard deviations of depth errors that are tried [mm]."""


def estimate_noise(observations: Observations, posterior: Posterior, prior: Field) -> Noise:
    """The noise under which the data are most likely, given the prior field: evidence of the problem linearised at the mode.

    Depth errors are told from stiffness by being rougher than the footprint lets a change of stiffness appear.
    What all samples share cannot be seen; half the perceived surface's own error is assumed, but not less than the default.
    """
    o = observations
    seen = prior.factor(posterior.jacobian)
    rest = seen @ seen.T + o.noise.of_model(o.squared_distance, o.relative, o.spread)
    diagonal = np.diag_indices(len(rest))
    chosen, best = o.noise, -np.inf
    for smooth in _SMOOTH:
        common = max(Noise.depth_common, 0.5e-3 * smooth)
        correlated = replace(o.noise, depth_smooth=1e-3 * smooth, depth_white=0.0, depth_common=common)
        covariance = rest + correlated.of_depth(o.steep, o.squared_distance)
        without_white = covariance[diagonal]
        for white in _WHITE:
            tried = replace(correlated, depth_white=1e-3 * white)
            covariance[diagonal] = without_white + (o.steep * tried.depth_white) ** 2
            half = cholesky(covariance, lower=True)
            scaled = solve_triangular(half, posterior.residual, lower=True)
            evidence = -0.5 * float(scaled @ scaled) - float(np.log(np.diag(half)).sum())
            if evidence > best:
                best, chosen = evidence, tried
    return chosen
