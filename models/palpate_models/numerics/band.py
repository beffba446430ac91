"""Bands of a stiffness: a factor up and down, since stiffness is estimated by its logarithm."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def half_width(lower: ArrayLike, upper: ArrayLike) -> NDArray[np.float64]:
    """Half width of bands [1], shape (n,): the factor from the middle to either end, less one."""
    return np.asarray(np.sqrt(np.asarray(upper, dtype=float) / np.maximum(np.asarray(lower, dtype=float), 1e-9)) - 1)
