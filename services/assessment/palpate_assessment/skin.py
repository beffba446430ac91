"""Depth by the skin as the whole examination shows it.

Planning counts depth from the skin as it knows it then. When the strokes are over it knows better: by all touches, and by all
images of the wall. With z(x) the height of that skin, and z' the height from which depth d' was counted at a place of normal n,

    d = d' + n_z (z(x) - z').
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.interpolate import LinearNDInterpolator

from palpate_assessment.sampling import ForceSample
from palpate_models.numerics.frames import Array

DEEPER_MAX_M: Final = 0.01
"""Maximum median change of depth: planning follows the skin to millimetres once it has touched it."""


class KnownSkin:
    """The skin at the end of expiration, in A."""

    def __init__(self, p_A: Array, sigma: Array, since: float) -> None:
        """Points [m], shape (n, 3), with the standard deviation of their height [m], (n,), for what is felt after `since` [s]."""
        self._known = LinearNDInterpolator(p_A[:, :2], np.column_stack((p_A[:, 2], sigma)))
        self._since = since

    def deeper(self, time: Array, position: Array, normal: Array) -> tuple[Array, Array]:
        """Return the correction of the reported depth [m] and its standard deviation [m]; shape (k,) each, NaN where unknown.

        For times [s], points of the skin from which depth is counted [m] and outward normals, shapes (k,), (k, 3), (k, 3).
        """
        height, sigma = self._known(position[:, :2]).T
        there = time >= self._since
        deeper = normal[:, 2] * (height - position[:, 2])
        return np.where(there, deeper, np.nan), np.where(there, sigma, np.nan)

    def middle_change(self, samples: Sequence[ForceSample]) -> float:
        """Return the median change of depth [m], 0 where the skin is known at no sample."""
        deeper = self._deeper(samples)[0] if samples else np.zeros(1)
        known = deeper[np.isfinite(deeper)]
        return float(np.median(known)) if len(known) else 0.0

    def again(self, samples: Sequence[ForceSample]) -> list[ForceSample]:
        """Return the samples with their depths from this skin, where it is known."""
        if not samples:
            return []
        deeper, sigma = self._deeper(samples)
        return [
            sample if np.isnan(by) else sample._replace(depth=sample.depth + float(by), depth_uncertainty=float(s))
            for sample, by, s in zip(samples, deeper, sigma, strict=True)
        ]

    def _deeper(self, samples: Sequence[ForceSample]) -> tuple[Array, Array]:
        columns = ([sample.time for sample in samples], [s.position for s in samples], [s.normal for s in samples])
        return self.deeper(*map(np.array, columns))
