"""Examinations for the figures: several ways to cover the region, and a run on the bus for its graph."""

import json
import signal
import subprocess
import sys
from pathlib import Path
from time import sleep
from typing import Final, NamedTuple

from palpate.live.bus import join_bus, present
from palpate.live.topic import topic_rows
from palpate.report.evidence import read_completed
from palpate_bus.runs.announcement import Run, live_runs

GRAPH: Final = "graph.json"
SCENARIO: Final = "clean"
STOP_S: Final = 30.0
"""Time for a run to end after SIGINT."""


class ReproductionCase(NamedTuple):
    """One way to cover the region."""

    pattern: str
    mode: str

    @property
    def name(self) -> str:
        """Name of the folder."""
        return f"{self.pattern}_{self.mode}"


SNAKE = ReproductionCase("snake", "continuous")
"""The paper's method, and our default."""
POINTS: Final = ReproductionCase("raster", "point")
"""The method that the paper compares with."""
CASES: Final = (SNAKE, ReproductionCase("raster", "continuous"), ReproductionCase("snake", "point"), POINTS)


class ReproductionError(RuntimeError):
    """An examination did not complete. Names its folder and its last output."""


def perform(case: ReproductionCase, folder: Path, settings: tuple[str, ...]) -> None:
    """Run an examination in one process into `folder`; the paper's case is recorded. Raises ReproductionError."""
    arguments = ["--composed", "--quiet", "--record", "full" if case == SNAKE else "none"]
    for setting in (f"exam.pattern={case.pattern}", f"exam.mode={case.mode}", *settings):
        arguments += ["--set", setting]
    process = _start(folder, arguments)
    try:
        process.wait()
    finally:
        _stop(process)
    if process.returncode or read_completed(folder) is None:
        raise ReproductionError(f"{case.name} ended with status {process.returncode}: {_last_line(folder)} ({folder})")


def record_graph(folder: Path) -> None:
    """Start an examination as processes on a bus, write its graph, and end it. Raises ReproductionError."""
    process = _start(folder, ["--quiet", "--json"])
    try:
        while process.poll() is None:
            run = _await_run(folder, process.pid)
            if run is not None:
                with join_bus(None, run.name, None) as bus:
                    rows = topic_rows(present(bus))
                nodes = {node for row in rows for node in (*row["publishers"], *row["subscribers"])}
                if nodes >= set(run.endpoints) and _has_started(folder):
                    (folder / GRAPH).write_text(json.dumps(rows, indent=1), encoding="utf-8")
                    return
            sleep(0.5)
        raise ReproductionError(f"the run on the bus ended with status {process.returncode}: {_last_line(folder)} ({folder})")
    finally:
        _stop(process)


def _has_started(folder: Path) -> bool:
    """Return True once the recorder has written something."""
    path = folder / "recording_mcap" / "recording_mcap_0.mcap"
    return path.is_file() and path.stat().st_size > 0


def _log(folder: Path) -> Path:
    """Return the log file, next to the folder, which must be empty when the run starts."""
    return folder.with_name(f"{folder.name}.log")


def _start(folder: Path, arguments: list[str]) -> subprocess.Popen[bytes]:
    folder.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "palpate", "run", SCENARIO, "--out", str(folder), *arguments]
    with _log(folder).open("wb") as log:
        return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)


def _stop(process: subprocess.Popen[bytes]) -> None:
    """End a run as Ctrl+C does, so that it stops its processes."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _last_line(folder: Path) -> str:
    """Return the last line of a run's output."""
    lines = _log(folder).read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else "no output"


def _await_run(folder: Path, pid: int) -> Run | None:
    """Return the run of a process once it is announced."""
    return next((run for run in live_runs() if run.pid == pid or Path(run.out) == folder.resolve()), None)
