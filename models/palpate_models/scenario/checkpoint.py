"""Checkpoint of an interrupted examination: its measurements, for the run that resumes it."""

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from palpate_errors import UserError, restate
from palpate_inputs import read_arrays
from palpate_models.numerics.frames import Array, Ints, Mask


class CheckpointError(UserError):
    """A checkpoint that cannot be used. Names the file and what is wrong."""


@dataclass(frozen=True)
class FeltSoFar:
    """Samples of the assessment, m of them, in the abdomen frame A."""

    time: Array
    """[s], shape (m,); negative: before the resumed run."""
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
    force_limited: Mask
    """Depth was reduced by the force limit."""
    stroke: Ints
    """Number of the descent."""
    depth_uncertainty: Array
    """One sigma of the depth [m]."""
    exponent: Array
    """Force exponent of the descent to a held press [1]; 0 for other samples."""


@dataclass(frozen=True)
class Checkpoint:
    """State of an examination at its interruption."""

    felt: FeltSoFar
    left: Array
    """Targets that were not reached, in A [m], shape (k, 2)."""
    surface: Array
    """Vertices of the perceived surface, in A [m], shape (n, 3)."""
    strokes: int
    """Number of descents."""

    def remaining_targets(self, targets: Array, spacing: float) -> frozenset[int]:
        """Return the indices of new targets, in A [m], shape (j, 2), within half a `spacing` [m] of a remaining one."""
        away = np.linalg.norm(targets[:, None] - self.left, axis=-1)
        return frozenset(np.flatnonzero((away < spacing / 2).any(axis=1)).tolist())

    def bytes(self) -> bytes:
        """Return the content of the file."""
        file = io.BytesIO()
        np.savez_compressed(file, left=self.left, surface=self.surface, strokes=np.array(self.strokes), **vars(self.felt))
        return file.getvalue()


def read_checkpoint(path: Path | None) -> Checkpoint | None:
    """Return the checkpoint in a file; None without a path. Raises CheckpointError."""
    if path is None:
        return None
    held = dict(read_arrays(path, path, CheckpointError))
    with restate((ValueError, KeyError, TypeError), CheckpointError, f"{path}: not a checkpoint of this version"):
        left, surface, strokes = (held.pop(name) for name in ("left", "surface", "strokes"))
        rows = len(held["time"])
        wanted: dict[str, tuple[int, ...]] = {
            name: (rows, 3) if name in ("position", "normal", "velocity") else (rows,) for name in held
        }
        wanted |= {"left": (len(left), 2), "surface": (len(surface), 3), "strokes": ()}
        for name, array in {**held, "left": left, "surface": surface, "strokes": strokes}.items():
            if array.shape != wanted[name] or array.dtype.kind not in "bif" or not np.isfinite(array).all():
                raise ValueError(f"{name}: expected finite numbers of shape {wanted[name]}, got {array.dtype} {array.shape}")
        return Checkpoint(FeltSoFar(**held), left, surface, int(strokes))
