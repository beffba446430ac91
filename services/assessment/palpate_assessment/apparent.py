"""Apparent stiffness from the posterior: what the standard press would feel at each node, and how sure that is.

The press feels the modulus averaged over its footprint, felt(z) = (H exp(p z))^(1/p), as a sample does (inversion.py). Its force
is that times the force over k_w of the nominal wall. What the samples leave open about single nodes mostly cancels in the average,
so the variance is the posterior's of that average and not of the nodes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate_assessment.contact import REACH, ReferenceContact
from palpate_assessment.grid import MapGrid
from palpate_assessment.inversion import POWER, Posterior
from palpate_assessment.prior import Field
from palpate_models import press
from palpate_models.frames import Array

Mask = NDArray[np.bool_]
_BLOCK = 256
"""Nodes whose variance is computed at a time."""


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


def apparent_stiffness(posterior: Posterior, grid: MapGrid, contact: ReferenceContact) -> ApparentStiffness:
    """What the standard press would feel at the grid's nodes."""
    footprints = Footprints(grid, contact, press.DEPTH_M)
    n = grid.z.size
    blocks = [slice(first, min(first + _BLOCK, n)) for first in range(0, n, _BLOCK)]
    sd = [posterior.sd_of(footprints.jacobian(posterior.mean, nodes)) for nodes in blocks]
    unit = contact.press_force(grid.curvature(grid.nodes))
    return ApparentStiffness(footprints.felt(posterior.mean) * unit, np.concatenate(sd))


def felt_ratio(
    area: Mask, posterior: Posterior, surroundings: Array, lesion: Field, grid: MapGrid, contact: ReferenceContact
) -> tuple[float, float]:
    """Log of an area's apparent stiffness over that of its surroundings, mean over the area, and its standard deviation.

    `surroundings`: log-moduli of the wall as it would be without stiff areas, shape (n,); `lesion`: the prior of what comes on
    top of the healthy wall, whose posterior variance is the ratio's.
    """
    footprints = Footprints(grid, contact, press.DEPTH_M)
    weight = grid.area * area / float(grid.area[area].sum())
    ratio = np.log(footprints.felt(posterior.mean) / footprints.felt(surroundings))
    rows = weight[area] @ footprints.jacobian(posterior.mean, area)
    return float(weight @ ratio), float(posterior.sd_of(rows[None], lesion)[0])
