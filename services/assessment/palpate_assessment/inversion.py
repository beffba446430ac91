"""Forces to foundation modulus: Bayesian inversion of the footprint's blur, with its uncertainty.

What the indenter feels is the modulus averaged over its footprint (contact.py). With z = log k_w on the grid's nodes and H the
footprints of the samples (rows sum to 1),

    log(F / F_ref) = f(z) + noise,   f(z) = 1/p log(H exp(p z)),   z ~ N(m, K)

The posterior's mode follows by Gauss-Newton; its covariance is the Gaussian one at the mode.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.spatial.distance import cdist

from palpate_assessment.contact import REACH, ReferenceContact
from palpate_assessment.grid import MapGrid
from palpate_assessment.prior import Field
from palpate_assessment.sampling import Sample

Array = NDArray[np.float64]

POWER = 0.8
"""Exponent p of the mean over the footprint: 1 to first order; a wall that gives way beside a stiff area makes it a little less
(fitted on transient solutions with lesions of contrast 2.5 and 4: residual 2 % RMS)."""
Z90 = 1.6449
"""Two-sided 90 % quantile of the normal distribution."""


@dataclass(frozen=True)
class Noise:
    """What the samples get wrong."""

    depth_white: float = 0.00025
    """Depth error of a sample by itself [m]: control, sensor, mesh ripple."""
    depth_smooth: float = 0.0006
    """Error of the perceived surface [m], correlated over `depth_length`."""
    depth_length: float = 0.015
    """[m]"""
    depth_common: float = 0.0003
    """Error of the perceived surface that is common to all samples [m]."""
    model: float = 0.03
    """Relative error of the contact model [1]."""


@dataclass(frozen=True)
class Observations:
    """Samples as observations of log k_w."""

    value: Array
    """log(F / F_ref), log of an effective k_w in N/m^3, shape (m,)."""
    covariance: Array
    """Of their noise, shape (m, m)."""
    footprint: Array
    """Weight of each node in each sample, rows sum to 1, shape (m, n)."""


@dataclass(frozen=True)
class Posterior:
    """log k_w given the samples, on the grid's nodes."""

    mean: Array
    """Shape (n,)."""
    sd: Array
    """Shape (n,)."""
    jacobian: Array
    """df/dz at the mode, shape (m, n)."""
    residual: Array
    """Linearised data minus the prior's mean, y - f(z) + J (z - m), shape (m,)."""
    weights: Array
    """(J K J' + R)^-1 residual, shape (m,): a component's own posterior mean is its covariance times J' weights."""


def reference_force(samples: Sequence[Sample], contact: ReferenceContact, curvature: Array) -> Array:
    """Force over k_w [m^3] that a homogeneous wall would show at each sample, shape (m,).

    Depth is led by the dashpot (u + tau du/dt); the path's memory is taken off.
    """
    depth = np.array([s.depth for s in samples])
    rate = np.array([s.depth_rate for s in samples])
    lost = np.array([s.lost for s in samples])
    instantaneous = contact.force(depth + contact.material.dashpot_s * rate, curvature)
    return np.asarray(np.maximum(instantaneous * (1.0 - lost / contact.force(depth)), 1e-12))


def observe(samples: Sequence[Sample], grid: MapGrid, contact: ReferenceContact, noise: Noise) -> Observations:
    """The samples as observations on a grid. Samples need positive depth and force."""
    position = np.array([s.position for s in samples])
    depth = np.array([s.depth for s in samples])
    force = np.array([s.force for s in samples])
    value = np.log(force / reference_force(samples, contact, grid.curvature(position)))
    steep = contact.exponent(depth) / depth
    apart = cdist(position, position, "sqeuclidean")
    smooth = noise.depth_smooth**2 * np.exp(-0.5 * apart / noise.depth_length**2) + noise.depth_common**2
    covariance = np.outer(steep, steep) * smooth
    relative = np.array([s.force_noise for s in samples]) / force
    covariance[np.diag_indices(len(samples))] += (steep * noise.depth_white) ** 2 + relative**2 + noise.model**2
    return Observations(value, covariance, footprints(samples, grid, contact))


def footprints(samples: Sequence[Sample], grid: MapGrid, contact: ReferenceContact) -> Array:
    """Weight of each node in each sample, shape (m, n), rows sum to 1: distances along the surface are taken in space."""
    centre = np.array([s.position + contact.advance(s.velocity) for s in samples])
    depth = np.array([s.depth for s in samples])
    distance = cdist(centre, grid.nodes)
    rows = np.zeros_like(distance)
    levels = np.round(np.clip(depth, 0.002, 0.02) * 1000)
    for level in np.unique(levels):
        mine = levels == level
        r, weight = contact.footprint(float(level) / 1000, grid.pitch)
        rows[mine] = np.interp(distance[mine], r, weight)
    rows[distance > REACH] = 0.0
    rows *= grid.area
    return np.asarray(rows / rows.sum(axis=1, keepdims=True))


def invert(observations: Observations, prior: Field, mean: float, start: Array | None = None, iterations: int = 6) -> Posterior:
    """The posterior of log k_w under a prior field about `mean` (log of N/m^3), by Gauss-Newton from `start`."""
    y, H = observations.value, observations.footprint
    z = np.full(H.shape[1], float(np.median(y))) if start is None else start
    for last in range(iterations):
        power = H * np.exp(POWER * (z - z.max()))
        total = power.sum(axis=1)
        predicted = np.log(total) / POWER + z.max()
        jacobian = power / total[:, None]
        residual = y - predicted + jacobian @ (z - mean)
        spread = prior.times(jacobian)
        factor = cho_factor(spread @ jacobian.T + observations.covariance, lower=True)
        weights = cho_solve(factor, residual)
        step = mean + weights @ spread - z
        size = float(np.abs(step).max())
        z = z + step * min(1.0, 1.5 / max(size, 1e-9))
        if size < 0.01 and last:
            break
    half = solve_triangular(factor[0], spread, lower=True)
    variance = np.maximum(prior.variance - np.einsum("ij,ij->j", half, half), 1e-8)
    return Posterior(z, np.sqrt(variance), jacobian, residual, weights)
