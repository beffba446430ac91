"""Checkpoint of an interrupted examination: its measurements, for the run that resumes it."""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from palpate_errors import UserError, restate
from palpate_inputs import read_arrays
from palpate_models.numerics.frames import Array


class CheckpointError(UserError):
    """A checkpoint that cannot be used. Names the file and what is wrong."""


FELT = (
    *("time", "position", "normal", "velocity", "depth", "force", "force_noise", "time_in_contact", "force_limited", "stroke"),
    *("depth_uncertainty", "exponent"),
)
"""Columns of the samples: the fields of `ForceSample` of the assessment."""


@dataclass(frozen=True)
class Checkpoint:
    """State of an examination at its interruption."""

    felt: Mapping[str, Any]
    """Columns `FELT` of m samples, in A, shape (m,) or (m, 3). Their times [s] are negative: before the resumed run."""
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
        np.savez_compressed(file, left=self.left, surface=self.surface, strokes=np.array(self.strokes), **self.felt)
        return file.getvalue()


def read_checkpoint(path: Path | None) -> Checkpoint | None:
    """Return the checkpoint in a file; None without a path. Raises CheckpointError."""
    if path is None:
        return None
    held = dict(read_arrays(path, path, CheckpointError))
    with restate((ValueError, KeyError, TypeError), CheckpointError, f"{path}: not a checkpoint of this version"):
        left, surface, strokes = (held.pop(name) for name in ("left", "surface", "strokes"))
        if held.keys() != set(FELT):
            raise ValueError(f"samples of {', '.join(held)}; expected {', '.join(FELT)}")
        rows = len(held["time"])
        wanted: dict[str, tuple[int, ...]] = {
            name: (rows, 3) if name in ("position", "normal", "velocity") else (rows,) for name in held
        }
        wanted |= {"left": (len(left), 2), "surface": (len(surface), 3), "strokes": ()}
        for name, array in {**held, "left": left, "surface": surface, "strokes": strokes}.items():
            if array.shape != wanted[name] or array.dtype.kind not in "bif" or not np.isfinite(array).all():
                raise ValueError(f"{name}: expected finite numbers of shape {wanted[name]}, got {array.dtype} {array.shape}")
        return Checkpoint(held, left, surface, int(strokes))
