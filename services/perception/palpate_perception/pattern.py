"""Steps 4 and 5 of the paper's point-cloud processing: down-sampling to palpation points, and their order.

The points lie on scan lines along y_A (foot to head), which follow each other in x_A from the patient's right to the
left: along a line the wall curves least, so the tool turns least while it is in contact.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate_models.frames import Array
from palpate_models.scenario import Exam, Pattern

Index = NDArray[np.intp]


def stations(centre: float, length: float, spacing: float) -> Array:
    """Evenly spread coordinates [m] over `length` about `centre`, both ends included, at most `spacing` apart."""
    count = int(np.ceil(length / spacing - 1e-9)) + 1
    return np.linspace(centre - length / 2, centre + length / 2, count)


def lattice(exam: Exam) -> tuple[Array, Array]:
    """Stations of the palpation points in A: x of the lines, y on a line [m]."""
    (cx, cy), (width, height) = exam.centre_m, exam.region_m
    return stations(cx, width, exam.spacing_m), stations(cy, height, exam.spacing_m)


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


def order(lines: int, points: int, pattern: Pattern) -> Index:
    """Step 5: the order in which nodes (line * points + point) are visited, shape (lines * points,).

    Raster: every line foot to head. Else every other line back.
    """
    index = np.arange(lines * points).reshape(lines, points)
    if pattern is not Pattern.RASTER:
        index[1::2] = index[1::2, ::-1].copy()
    return index.ravel()


def _nearest(station: Array, coordinate: Array) -> Index:
    """Index of the nearest station, -1 for what is further than half a step."""
    step = station[1] - station[0] if len(station) > 1 else np.inf
    i = np.clip(np.rint((coordinate - station[0]) / step), 0, len(station) - 1).astype(np.intp)
    return np.where(np.abs(coordinate - station[i]) <= step / 2, i, -1)
