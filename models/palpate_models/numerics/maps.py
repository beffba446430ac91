"""Lines of equal value on a mesh."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Values = NDArray[np.floating[Any]]


def level_lines(vertices: Values, triangles: NDArray[np.integer[Any]], values: Values, level: float) -> NDArray[np.float64]:
    """Segments along which `values`, linear on each triangle, equal `level`; shape (k, 2, 3), in the vertices' frame [m]."""
    above = values > level
    count = above[triangles].sum(axis=1)
    crossed = triangles[(count == 1) | (count == 2)]
    if not len(crossed):
        return np.empty((0, 2, 3))
    alone = np.where(above[crossed].sum(axis=1) == 1, above[crossed].argmax(axis=1), (~above[crossed]).argmax(axis=1))
    row = np.arange(len(crossed))
    tip = crossed[row, alone]
    ends = []
    for step in (1, 2):
        other = crossed[row, (alone + step) % 3]
        share = (level - values[tip]) / (values[other] - values[tip])
        ends.append(vertices[tip] + share[:, None] * (vertices[other] - vertices[tip]))
    return np.stack(ends, axis=1).astype(np.float64)


def half_width(lower: ArrayLike, upper: ArrayLike) -> NDArray[np.float64]:
    """Half width of bands [1], shape (n,): the factor from the middle to either end, less one."""
    return np.asarray(np.sqrt(np.asarray(upper, dtype=float) / np.maximum(np.asarray(lower, dtype=float), 1e-9)) - 1)
