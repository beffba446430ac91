"""Where the skin is touched before a scan, to learn where it lies: at the centres of equal cells over the targets."""

from __future__ import annotations

from typing import Final

import numpy as np

from palpate_models.frames import Array

TOUCHES_M: Final = 0.07
"""Largest distance of these touches: they fix offset, tilt and field of the perceived surface."""


def touch_centres(targets: Array) -> Array:
    """The centres of the cells for targets in frame A [m], shape (n, 2): shape (k, 2), in the order in which they are touched.

    They go to and fro, and end near the first target.
    """
    low, high = targets.min(axis=0), targets.max(axis=0)
    counts = np.maximum(1, np.ceil((high - low) / TOUCHES_M - 1e-9)).astype(int)
    columns, rows = (low[k] + (high[k] - low[k]) * (np.arange(counts[k]) + 0.5) / counts[k] for k in (0, 1))
    centres = np.array([(x, y) for j, y in enumerate(rows) for x in columns[:: -1 if j % 2 else 1]])
    if np.linalg.norm(centres[-1] - targets[0]) > np.linalg.norm(centres[0] - targets[0]):
        centres = centres[::-1]
    return centres
