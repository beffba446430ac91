"""What an examination that ended early hands on to the one that goes on with it: nothing but what was measured."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from palpate_errors import UserError
from palpate_models.numerics.frames import Array


class CheckpointError(UserError):
    """A checkpoint that cannot be used. Names the file and what is wrong."""


@dataclass(frozen=True)
class FeltSoFar:
    """Samples of the assessment, m of them, in the abdomen frame A."""

    time: Array
    """[s], shape (m,); below zero: before the examination that goes on."""
    position: Array
    """[m], shape (m, 3)."""
    normal: Array
    """Outward, shape (m, 3)."""
    velocity: Array
    """Tangential [m/s], shape (m, 3)."""
    depth: Array
    """[m]"""
    force: Array
    """[N]"""
    force_noise: Array
    """Standard error of the force [N]."""
    time_in_contact: Array
    """[s]"""
    force_limited: NDArray[np.bool_]
    """Whether depth yielded to the force limit."""
    stroke: NDArray[np.int64]
    """Number of the descent."""
    depth_uncertainty: Array
    """One sigma of the depth [m]."""


@dataclass(frozen=True)
class Checkpoint:
    """Where an examination stood when it ended."""

    felt: FeltSoFar
    left: Array
    """Places of the targets that it had not reached, in A [m], shape (k, 2)."""
    surface: Array
    """Vertices of the wall that it had perceived, in A [m], shape (n, 3)."""
    strokes: int
    """Descents that it had made."""

    def wanted(self, targets: Array, spacing: float) -> frozenset[int]:
        """Which targets of a new look, in A [m], shape (j, 2), are those that were left: nearer than half a `spacing` [m]."""
        away = np.linalg.norm(targets[:, None] - self.left, axis=-1)
        return frozenset(np.flatnonzero((away < spacing / 2).any(axis=1)).tolist())

    def bytes(self) -> bytes:
        """As a file."""
        file = io.BytesIO()
        np.savez_compressed(file, left=self.left, surface=self.surface, strokes=np.array(self.strokes), **vars(self.felt))
        return file.getvalue()


def read_checkpoint(path: Path | None) -> Checkpoint | None:
    """The checkpoint in a file; None where there is no file to be read. Raises CheckpointError."""
    if path is None:
        return None
    try:
        with np.load(path, allow_pickle=False) as stored:
            held = {name: stored[name] for name in stored.files}
        left, surface, strokes = (held.pop(name) for name in ("left", "surface", "strokes"))
        return Checkpoint(FeltSoFar(**held), left, surface, int(strokes))
    except (OSError, ValueError, KeyError, TypeError, BadZipFile) as error:
        raise CheckpointError(f"{path}: is no checkpoint of this version: {error}") from error
