"""Where the bones under the skin are, seen from in front: costal arch and iliac crests."""

from __future__ import annotations

import numpy as np

from palpate_models.anatomy import Skeleton
from palpate_models.frames import Array
from palpate_models.phantom.field import smoothstep

COSTAL_EDGE_M = 0.04
"""Distance over which the skin rises to the rib cage, and the wall comes to lie on it."""


def above_costal_arch(x: Array, y: Array, skeleton: Skeleton) -> Array:
    """Height [m] of points over the costal arch, negative on the belly, shape as theirs."""
    return np.asarray(y - skeleton.costal_arch_m + skeleton.costal_slope * np.abs(x))


def iliac_bump(x: Array, y: Array, skeleton: Skeleton) -> Array:
    """The rise over the iliac spines, 1 on each, shape as the points'."""
    across, along = skeleton.iliac_crest_m
    square = (np.abs(x) - across) ** 2 + (y - along) ** 2
    return np.asarray(np.exp(-square / (2 * skeleton.iliac_radius_m**2)))


def bone_share(x: Array, y: Array, skeleton: Skeleton) -> Array:
    """How far the wall lies on bone, from 0 on the belly to 1, shape as the points'."""
    ribs = smoothstep(above_costal_arch(x, y, skeleton) / COSTAL_EDGE_M)
    return np.maximum(ribs, smoothstep(2 * iliac_bump(x, y, skeleton) - 0.5))
