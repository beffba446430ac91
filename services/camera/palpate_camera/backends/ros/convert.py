"""ROS depth images and transform trees as ours. Arrays in, arrays out."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from palpate_models.frames import Array

Depth = NDArray[np.float32]

ENCODINGS = {"16UC1": 2, "mono16": 2, "32FC1": 4}
"""Bytes a pixel of the depth encodings of REP 118: millimetres with 0 for invalid, or metres with NaN."""


class CameraError(ValueError):
    """A ROS camera that cannot be used. Names what is wrong and what is wanted."""


def depth_metres(encoding: str, height: int, width: int, row_bytes: int, big_endian: bool, data: NDArray[np.uint8]) -> Depth:
    """Depth [m], shape (height, width), NaN where invalid. Raises CameraError for what is no depth image."""
    if encoding not in ENCODINGS:
        raise CameraError(f"depth image: encoding = {encoding!r}: want one of {', '.join(ENCODINGS)}")
    size = ENCODINGS[encoding]
    if row_bytes < width * size or len(data) < row_bytes * height:
        raise CameraError(f"depth image: {len(data)} bytes, {row_bytes} a row, are too few for {width} x {height} {encoding}")
    rows = np.frombuffer(data, np.uint8, row_bytes * height).reshape(height, row_bytes)[:, : width * size]
    order = ">" if big_endian else "<"
    if size == 4:
        metres = np.ascontiguousarray(rows).view(f"{order}f4").astype(np.float32)
        return np.where(np.isfinite(metres) & (metres > 0), metres, np.float32(np.nan))
    millimetres = np.ascontiguousarray(rows).view(f"{order}u2")
    return np.where(millimetres > 0, millimetres.astype(np.float32) * np.float32(1e-3), np.float32(np.nan))


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
