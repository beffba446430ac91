"""Conversion of messages from other roles."""

from typing import Final

import numpy as np

from palpate_assessment.skin import KnownSkin
from palpate_bus.messages import SurfaceMotion
from palpate_bus.messages.codec import Message
from palpate_bus.messages.stamps import NS, nanoseconds
from palpate_models.numerics.frames import Array, apply

SEEN: Final = frozenset({SurfaceMotion.QUIET, SurfaceMotion.SPOILED})
"""States of `perception/motion` in which the wall was seen, and where it was expected."""


def skin_of(perceived: Message, correction: Message, X_AW: Array) -> KnownSkin | None:
    """Return the skin by `perception/surface` and `exam/correction`; None where one is not of the other. `X_AW`: shape (4, 4)."""
    p_W, n_W = (np.asarray(values, dtype=np.float64).reshape(-1, 3) for values in (perceived.vertices, perceived.normals))
    outward, sigma = (np.asarray(values, dtype=np.float64) for values in (correction.outward, correction.uncertainty))
    if not len(p_W) == len(n_W) == len(outward) == len(sigma):
        return None
    p_A = apply(X_AW, p_W + outward[:, np.newaxis] * n_W)
    return KnownSkin(p_A, sigma, nanoseconds(perceived.header.stamp) / NS)
