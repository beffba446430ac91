"""The examinations behind the figures: ways to cover the region, the paper's one recorded; and one on the bus for its graph."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from time import sleep
from typing import Final

from palpate.report.archive import completed
from palpate_bus.runs.announcement import Run, live
from palpate_bus.wire.liveliness import EntityKind, GraphWatch
from palpate_bus.wire.zenoh_config import session

GRAPH: Final = "graph.json"
LISTEN_S: Final = 3.0
"""How long the graph of a run that has begun is listened to."""
SCENARIO: Final = "clean"
POLL_S: Final = 0.5
STOP_S: Final = 30.0


@dataclass(frozen=True)
class ReproductionCase:
    """One way to cover the region."""

    pattern: str
    mode: str

    @property
    def name(self) -> str:
        """Name of its folder."""
        return f"{self.pattern}_{self.mode}"


SNAKE = ReproductionCase("snake", "continuous")
"""What the paper does, and our default."""
POINTS: Final = ReproductionCase("raster", "point")
"""What the paper compares it with."""
CASES: Final = (SNAKE, ReproductionCase("raster", "continuous"), ReproductionCase("snake", "point"), POINTS)


class ReproductionError(RuntimeError):
    """An examination that did not complete. Names its folder and what it said."""


def perform(case: ReproductionCase, folder: Path, settings: tuple[str, ...]) -> None:
    """Examines in one process into `folder`; the paper's case is recorded. Raises ReproductionError."""
    words = ["--composed", "--quiet", "--record", "full" if case == SNAKE else "none"]
    for setting in (f"exam.pattern={case.pattern}", f"exam.mode={case.mode}", *settings):
        words += ["--set", setting]
    process = _start(folder, words)
    try:
        process.wait()
    finally:
        _stop(process)
    if process.returncode or completed(folder) is None:
        raise ReproductionError(f"{case.name} left with status {process.returncode}: {_said(folder)} ({folder})")


def record_graph(folder: Path) -> None:
    """Starts an examination as processes on a bus, writes the graph of what is there, and ends it. Raises ReproductionError."""
    process = _start(folder, ["--quiet", "--json"])
    try:
        while process.poll() is None:
            run = _announced(folder, process.pid)
            if run is not None:
                rows = listen(run)
                if {row["node"] for row in rows} >= set(run.endpoints) and _ticks(folder):
                    (folder / GRAPH).write_text(json.dumps(rows, indent=1), encoding="utf-8")
                    return
            sleep(POLL_S)
        raise ReproductionError(f"the run on the bus left with status {process.returncode}: {_said(folder)} ({folder})")
    finally:
        _stop(process)


def _ticks(folder: Path) -> bool:
    """Whether the run has begun: its recorder has written something."""
    path = folder / "recording_mcap" / "recording_mcap_0.mcap"
    return path.is_file() and path.stat().st_size > 0


def _log(folder: Path) -> Path:
    """What a run says, beside its folder, which has to be empty when it begins."""
    return folder.with_name(f"{folder.name}.log")


def _start(folder: Path, words: list[str]) -> subprocess.Popen[bytes]:
    folder.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "palpate", "run", SCENARIO, "--out", str(folder), *words]
    with _log(folder).open("wb") as log:
        return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)


def _stop(process: subprocess.Popen[bytes]) -> None:
    """Ends it as Ctrl+C would, so that it stops its own processes."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _said(folder: Path) -> str:
    """The last line of a run's output."""
    lines = _log(folder).read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else "it said nothing"


def _announced(folder: Path, pid: int) -> Run | None:
    """The run of that process, when it is on the bus."""
    return next((run for run in live() if run.pid == pid or Path(run.out) == folder.resolve()), None)


def listen(run: Run) -> list[dict[str, str]]:
    """The graph of a run as its liveliness tokens say: one row a publisher or subscription, with node, topic, type."""
    with session(run.options()) as bus:
        watch = GraphWatch(bus, run.domain)
        for _ in range(round(LISTEN_S / 0.1)):
            watch.changes()
            sleep(0.1)
        rows = [
            {"node": entity.node, "kind": entity.kind.value, "topic": entity.endpoint.topic, "type": entity.endpoint.type}
            for entity in watch.alive.values()
            if entity.endpoint is not None and entity.kind in (EntityKind.PUBLISHER, EntityKind.SUBSCRIPTION)
        ]
        watch.close()
    return sorted(rows, key=lambda row: tuple(row.values()))
