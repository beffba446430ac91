"""Batches rows of a recording and sends them as columns: one call for many rows keeps drawing cheap."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from palpate_models.numerics.frames import Array

TIMELINE = "sim_time"
"""The recording's only timeline: simulated time."""

Row = Any
Kind = Callable[[Sequence[Row]], Any]
"""Builds the columns of an entity from its rows."""


def scalars(rows: Sequence[Array]) -> Any:
    """Plots: a row holds the values of an entity's series, shape (k,)."""
    return rr.Scalars.columns(scalars=np.concatenate(rows)).partition([len(row) for row in rows])


def transforms(rows: Sequence[Array]) -> Any:
    """Poses: a row is x y z qx qy qz qw, shape (7,)."""
    table = np.stack(rows)
    return rr.Transform3D.columns(translation=table[:, :3], quaternion=table[:, 3:])


def deformations(rows: Sequence[tuple[NDArray[np.float32], NDArray[np.float32]]]) -> Any:
    """Moving meshes: a row is positions [m] and normals, shapes (n, 3)."""
    columns = rr.Mesh3D.columns(
        vertex_positions=np.concatenate([positions for positions, _ in rows]),
        vertex_normals=np.concatenate([normals for _, normals in rows]),
    )
    return columns.partition([len(positions) for positions, _ in rows])


def arrows(rows: Sequence[tuple[Array, Array]]) -> Any:
    """Arrows: a row is origin and vector, shapes (3,)."""
    origins, vectors = zip(*rows, strict=True)
    return rr.Arrows3D.columns(origins=np.stack(origins), vectors=np.stack(vectors))


class Columns:
    """Collects rows by entity; `send` writes them to the recording."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._recording = recording
        self._rows: dict[str, tuple[Kind, list[int], list[Row]]] = {}

    def add(self, entity: str, kind: Kind, t: int, row: Row) -> None:
        """Add a row of `entity` at simulated time `t` [ns]. An entity has one kind."""
        try:
            _, times, rows = self._rows[entity]
        except KeyError:
            _, times, rows = self._rows.setdefault(entity, (kind, [], []))
        times.append(t)
        rows.append(row)

    def send(self) -> None:
        """Send the collected rows, one chunk per entity."""
        for entity, (kind, times, rows) in self._rows.items():
            if times:
                index = rr.TimeColumn(TIMELINE, duration=np.array(times, dtype="timedelta64[ns]"))
                self._recording.send_columns(entity, [index], kind(rows))
                times.clear()
                rows.clear()
