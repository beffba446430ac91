"""Steps 4 and 5 of the paper's point-cloud processing: down-sampling to palpation points, and their order.

Which points, and in which order, is the scan pattern's to say (`palpate_models.scenario.patterns`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate_models.numerics.frames import Array

Index = NDArray[np.intp]


def downsample(p: Array, x: Array, y: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Step 4: one point for each node of the lattice, as a voxel grid of the lattice's spacing does.

    Returns the nodes' xy [m], shape (len(x) * len(y), 2), lines first, and whether a point of the cloud `p` (in A,
    shape (n, 3)) lies in a node's cell. The nodes themselves, not the cells' centroids, keep spacing and ends exact.
    """
    i, j = (_nearest(s, coordinate) for s, coordinate in ((x, p[:, 0]), (y, p[:, 1])))
    inside = (i >= 0) & (j >= 0)
    seen = np.zeros((len(x), len(y)), np.bool_)
    seen[i[inside], j[inside]] = True
    nodes = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    return nodes, seen.ravel()


def supported(p: Array, xy: Array, spacing: float) -> NDArray[np.bool_]:
    """Return the mask of targets, shape (m,), whose cell contains a point of the cloud `p` (in A, shape (n, 3)).

    `xy`: targets in A [m], shape (m, 2); their cells are squares of the side `spacing` [m].
    """
    distance, _ = cKDTree(p[:, :2]).query(xy, p=np.inf, distance_upper_bound=spacing / 2)
    return np.isfinite(distance)


def _nearest(station: Array, coordinate: Array) -> Index:
    """Index of the nearest station, -1 for what is further than half a step."""
    step = station[1] - station[0] if len(station) > 1 else np.inf
    i = np.clip(np.rint((coordinate - station[0]) / step), 0, len(station) - 1).astype(np.intp)
    return np.where(np.abs(coordinate - station[i]) <= step / 2, i, -1)
