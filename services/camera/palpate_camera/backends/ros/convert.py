"""ROS transform trees as poses. Arrays in, arrays out."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from palpate_models.numerics.frames import Array


class CameraError(ValueError):
    """A ROS camera that cannot be used. Names what is wrong and what is wanted."""


def chain(transforms: Mapping[str, tuple[str, Array]], root: str, leaf: str) -> Array | None:
    """X_RL, shape (4, 4), from the parent and pose of each frame; None while a link of the chain is missing."""
    X = np.eye(4)
    frame, seen = leaf, set[str]()
    while frame != root:
        if frame not in transforms or frame in seen:
            return None
        seen.add(frame)
        parent, X_PF = transforms[frame]
        X = X_PF @ X
        frame = parent
    return X
