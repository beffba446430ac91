"""Apparent stiffness from the posterior: what the standard press would feel at each node, and how sure that is.

The press feels the modulus averaged over its footprint, felt(z) = (H exp(p z))^(1/p), as a sample does (inversion.py). Its force
is that times the force over k_w of the nominal wall. What the samples leave open about single nodes mostly cancels in the
average, so the variance is the posterior's of that average and not of the nodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.ndimage import binary_dilation

from palpate_assessment.contact import REACH, ReferenceContact
from palpate_assessment.grid import MapGrid
from palpate_assessment.inversion import POWER, Observations, Posterior
from palpate_assessment.prior import Field
from palpate_models.frames import Array

Mask = NDArray[np.bool_]
_BLOCK = 256
"""Nodes whose variance is computed at a time."""
_EDGE_M = 0.010
"""So far beyond its outline an area may still be stiffer than its surroundings."""
_CLEAR = 0.005
"""A sample is clear of an area when no more than this part of its footprint lies in it and its edge; but _FEWEST always are."""
_FEWEST = 10


class Footprints:
    """The indenter's footprint about each node at one depth. Beyond the grid's border its nodes at the border go on."""

    def __init__(self, grid: MapGrid, contact: ReferenceContact, depth: float) -> None:
        """At a depth [m]."""
        ny, nx = grid.z.shape
        n = int(np.ceil(REACH / grid.pitch))
        r, weight = contact.footprint(depth, grid.pitch)
        j, i = np.mgrid[-n : n + 1, -n : n + 1].reshape(2, -1)
        kernel = np.interp(np.hypot(i, j) * grid.pitch, r, weight, right=0.0)
        i, j, kernel = i[kernel > 0], j[kernel > 0], kernel[kernel > 0] / kernel.sum()
        row, column = np.divmod(np.arange(ny * nx), nx)
        to = np.clip(row[:, None] + j, 0, ny - 1) * nx + np.clip(column[:, None] + i, 0, nx - 1)
        of = np.repeat(np.arange(ny * nx), len(kernel))
        self.weights = sparse.csr_array((np.tile(kernel, ny * nx), (of, to.ravel())), shape=(ny * nx, ny * nx))
        """H, rows sum to 1, shape (n, n)."""

    def felt(self, z: Array) -> Array:
        """The modulus that is felt at each node of a wall of log-moduli z, both of shape (n,) [N/m^3]."""
        top = float(z.max())
        return np.asarray(np.exp(top) * (self.weights @ np.exp(POWER * (z - top))) ** (1.0 / POWER))

    def jacobian(self, z: Array, nodes: slice | Mask) -> Array:
        """D log felt / dz at some of the nodes, shape (k, n); rows sum to 1."""
        rows = self.weights[nodes].toarray() * np.exp(POWER * (z - z.max()))
        return np.asarray(rows / rows.sum(axis=1, keepdims=True))


@dataclass(frozen=True)
class ApparentStiffness:
    """The posterior of the force of the standard press at each node."""

    force: Array
    """Median [N], shape (n,)."""
    sd: Array
    """Standard deviation of its logarithm [1], shape (n,)."""


def apparent_stiffness(
    posterior: Posterior, grid: MapGrid, contact: ReferenceContact, footprints: Footprints
) -> ApparentStiffness:
    """What the standard press would feel at the grid's nodes, with the footprints of its depth."""
    n = grid.z.size
    blocks = [slice(first, min(first + _BLOCK, n)) for first in range(0, n, _BLOCK)]
    sd = [posterior.sd_of(footprints.jacobian(posterior.mean, nodes)) for nodes in blocks]
    unit = contact.press_force(grid.curvature(grid.nodes))
    return ApparentStiffness(footprints.felt(posterior.mean) * unit, np.concatenate(sd))


class Surroundings:
    """The wall as it would be without stiff areas: the healthy field's posterior from some of the samples alone."""

    def __init__(self, clear: Mask, observations: Observations, healthy: Field, mean: float) -> None:
        """From the samples that are `clear` of stiff areas, shape (m,); `mean` is the prior's, log of N/m^3."""
        self._healthy = healthy
        self._seen = healthy.factor(observations.footprint[clear])
        covariance = self._seen @ self._seen.T + observations.covariance[np.ix_(clear, clear)]
        self._triangle = cholesky(covariance, lower=True)
        weights = cho_solve((self._triangle, True), observations.value[clear] - mean)
        self.mean: Array = mean + healthy.unfold((weights @ self._seen)[None])[0]
        """Log-modulus at each node, shape (n,)."""

    def sd_of(self, rows: Array) -> Array:
        """Standard deviation of rows [k, n] times the log-modulus, shape (k,)."""
        own = self._healthy.factor(rows)
        half = solve_triangular(self._triangle, self._seen @ own.T, lower=True)
        variance = np.einsum("ij,ij->i", own, own) - np.einsum("ij,ij->j", half, half)
        return np.asarray(np.sqrt(np.maximum(variance, 1e-8)))


class FeltRatios:
    """How much stiffer areas feel than their surroundings would without them."""

    def __init__(self, posterior: Posterior, observations: Observations, healthy: Field, grid: MapGrid, mean: float) -> None:
        """`mean` is the prior's, log of N/m^3."""
        self._posterior, self._observations, self._healthy, self._grid, self._mean = posterior, observations, healthy, grid, mean

    def __call__(self, areas: Sequence[Mask], footprints: Footprints) -> list[tuple[float, float]]:
        """For each area the log of its ratio of apparent stiffness, mean over the area, and its standard deviation.

        The surroundings are continued into the areas from the samples whose footprint is clear of all of them. Both sides'
        variances add.
        """
        if not areas:
            return []
        grid, z = self._grid, self._posterior.mean
        about = binary_dilation(np.any(areas, axis=0).reshape(grid.z.shape), iterations=max(1, round(_EDGE_M / grid.pitch)))
        touched = self._observations.footprint @ about.ravel().astype(float)
        fewest = np.partition(touched, min(_FEWEST, len(touched)) - 1)[min(_FEWEST, len(touched)) - 1]
        around = Surroundings(touched <= max(_CLEAR, float(fewest)), self._observations, self._healthy, self._mean)
        excess = np.log(footprints.felt(z) / footprints.felt(around.mean))
        ratios = []
        for area in areas:
            weight = grid.area[area] / float(grid.area[area].sum())
            rows = (weight @ footprints.jacobian(z, area))[None]
            sd = np.hypot(self._posterior.sd_of(rows)[0], around.sd_of(rows)[0])
            ratios.append((float(weight @ excess[area]), float(sd)))
        return ratios
