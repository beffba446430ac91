"""Where the tool truly touched: from places as the examination believes them to places on the true skin.

Errors of kinematics and registration are lateral too. So what the examination says of a place is compared with what the tool felt
there, which is the place that it truly touched.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from palpate_models.numerics.frames import Array

_NEAREST: Final = 4
"""Contacts whose errors are averaged, the nearer the more."""


class Touched:
    """Contacts of a run: k places on the skin, as believed and as they truly were."""

    def __init__(self, believed: Array, true: Array) -> None:
        """Both [m], shape (k, 3), in A: as registered, and the true one. Without a contact all places are taken as they are."""
        self.believed, self.true = believed, true
        self._tree = cKDTree(believed[:, :2]) if len(believed) else None

    def places(self, xy: Array) -> Array:
        """Where the tool truly was when it was believed at xy [m], both of shape (p, 2)."""
        if self._tree is None:
            return xy
        count = min(_NEAREST, len(self.believed))
        distance, index = (np.asarray(a).reshape(len(xy), count) for a in self._tree.query(xy, k=count))
        weight = 1.0 / (distance + 1e-4)
        weight /= weight.sum(axis=1, keepdims=True)
        shift = (self.true - self.believed)[index, :2]
        return np.asarray(xy + (weight[..., None] * shift).sum(axis=1))
