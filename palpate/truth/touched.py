"""Maps places as estimated by the examination to the places on the true skin that the tool touched.

Kinematics and registration have lateral errors. So an estimate at a place is compared with the truth at the place that the tool
actually touched.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from palpate_models.numerics.frames import Array

_NEAREST: Final = 4
"""Number of nearest contacts whose errors are averaged, weighted by inverse distance."""


class Touched:
    """Contacts of a run: k estimated and true places on the skin."""

    def __init__(self, believed: Array, true: Array) -> None:
        """Both [m], shape (k, 3), in the registered and in the true A. Without contacts places are unchanged."""
        self.believed, self.true = believed, true
        self._tree = cKDTree(believed[:, :2]) if len(believed) else None

    def places(self, xy: Array) -> Array:
        """Return true places of the tool for estimated ones xy [m], both of shape (p, 2)."""
        if self._tree is None:
            return xy
        count = min(_NEAREST, len(self.believed))
        distance, index = (np.asarray(a).reshape(len(xy), count) for a in self._tree.query(xy, k=count))
        weight = 1.0 / (distance + 1e-4)
        weight /= weight.sum(axis=1, keepdims=True)
        shift = (self.true - self.believed)[index, :2]
        return np.asarray(xy + (weight[..., None] * shift).sum(axis=1))
