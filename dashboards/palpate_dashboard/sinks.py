"""A recording: its sinks (a file, a running viewer, or a server for viewers and browsers), and rows that are sent as columns.

One call for many rows keeps drawing cheap.
"""

import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote
from uuid import uuid4

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from palpate_models.numerics.frames import Array

log = logging.getLogger(__name__)

APPLICATION = "palpate"
MEMORY_LIMIT = "512MiB"
"""Buffer for viewers that join late; the oldest data is dropped first, static data never."""


class Live(NamedTuple):
    """Live view of a run.

    `serve:PORT` hosts the recording for viewers of this machine, in the browser at PORT + 1; with `serve:0.0.0.0:PORT` every
    machine that reaches the port sees the run. `connect:URL` sends it to a viewer that listens, by default one on this machine.
    """

    serve_port: int | None = None
    serve_at: str = "127.0.0.1"
    """Address of the serving interface."""
    connect_url: str | None = None

    @staticmethod
    def parse(text: str) -> "Live":
        """Parse PALPATE_VIEWER; an empty value means no live view. Raises ValueError naming the allowed forms."""
        kind, _, rest = text.partition(":")
        if not text:
            return Live()
        if kind == "serve":
            at, _, port = rest.rpartition(":")
            if port and not (port.isdigit() and 1024 <= int(port) <= 65534):
                raise ValueError(f"PALPATE_VIEWER={text}: expected serve:PORT or serve:ADDRESS:PORT with PORT in 1024..65534")
            return Live(serve_port=int(port or 9876), serve_at=at or Live().serve_at)
        if kind == "connect":
            return Live(connect_url=rest or "rerun+http://127.0.0.1:9876/proxy")
        raise ValueError(f"PALPATE_VIEWER={text}: expected serve, serve:PORT, connect or connect:URL")


def address(port: int) -> str:
    """Return the browser address of the recording served at `port` on this machine.

    The theme is always dark: the colours are chosen for it.
    """
    return f"http://localhost:{port + 1}/?url={quote(f'rerun+http://localhost:{port}/proxy', safe='')}&theme=dark"


def _serve(at: str, port: int) -> Any:
    """Return a sink that serves the recording at `port` of the interface `at`, and the web viewer at `port` + 1.

    The web viewer itself holds no data. Raises OSError if a port is in use.
    """
    try:
        server = rr.GrpcServerSink(bind_ip=at, port=port, server_memory_limit=MEMORY_LIMIT)
        rr.serve_web_viewer(web_port=port + 1, open_browser=False)
    except RuntimeError as error:
        raise OSError(f"PALPATE_VIEWER=serve:{port}: ports {port} and {port + 1} must be free: {error}") from error
    log.info("watch the run at %s", address(port))
    return server


def open_recording(path: Path | None, live: Live, blueprint: Any, name: str, run: str = "") -> rr.RecordingStream:
    """Return a recording named `name` of the run `run`, written to the file `path` if given, and to viewers as given by `live`.

    Its only timeline is simulated time. Raises OSError if the file cannot be written.
    """
    recording = rr.RecordingStream(APPLICATION, recording_id=uuid4())
    recording.set_log_tick_enabled(False)
    recording.set_log_time_enabled(False)
    sinks: list[Any] = []
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        sinks.append(rr.FileSink(path))
    if live.serve_port is not None:
        sinks.append(_serve(live.serve_at, live.serve_port))
    if live.connect_url is not None:
        sinks.append(rr.GrpcSink(live.connect_url))
    recording.set_sinks(*sinks, default_blueprint=blueprint)
    recording.send_recording_name(f"{name}, run {run}" if run else name)
    return recording


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


class Canvas:
    """Draws into a recording, at once or in columns: rows are collected by entity until `send`."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self.recording = recording
        self._rows: dict[str, tuple[Kind, list[int], list[Row]]] = {}

    def log(self, path: str, shape: Any, t: int | None = None) -> None:
        """Draw an entity at simulated time `t` [ns]; without it, for all time."""
        if t is not None:
            self.recording.set_time(TIMELINE, duration=np.timedelta64(t, "ns"))
        self.recording.log(path, shape, static=t is None)

    def add(self, entity: str, kind: Kind, t: int, row: Row) -> None:
        """Add a row of `entity` at simulated time `t` [ns]. An entity has one kind."""
        _, times, rows = self._rows.setdefault(entity, (kind, [], []))
        times.append(t)
        rows.append(row)

    def send(self) -> None:
        """Send the collected rows, one chunk per entity."""
        for entity, (kind, times, rows) in self._rows.items():
            if times:
                index = rr.TimeColumn(TIMELINE, duration=np.array(times, dtype="timedelta64[ns]"))
                self.recording.send_columns(entity, [index], kind(rows))
                times.clear()
                rows.clear()
