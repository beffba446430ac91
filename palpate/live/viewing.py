"""A run in the browser or in the native viewer, live or from its recording: what `palpate dashboard` does."""

from __future__ import annotations

import os
import subprocess
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from time import sleep

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from palpate_bus.runs.announcement import Run
from palpate_bus.runs.operator_keys import HINT, OperatorKeys
from palpate_dashboard import replay
from palpate_dashboard.follow import follow
from palpate_dashboard.service import FILE, DashboardService
from palpate_dashboard.sinks import MEMORY_LIMIT, Live, address
from palpate_errors import UserError
from palpate_models.scenario.load import load_scenario


class NothingToShow(UserError):
    """Nothing that can be shown. Says what to do."""


def watch(run: Run, port: int, native: bool, show: bool, leave: bool, console: Console) -> None:
    """Follows a run to its end and, unless told to leave, keeps its picture afterwards."""
    scenario = Path(run.out) / "scenario.yaml"
    if not scenario.is_file():
        raise NothingToShow(f"{scenario} is not there: the folder of the run {run.name} is not on this machine")
    service = DashboardService(load_scenario(str(scenario)), None, Live(serve_port=port))
    viewer = subprocess.Popen(_rerun(f"rerun+http://127.0.0.1:{port}/proxy")) if native else None
    console.print(f"{run.name} (process {run.pid}): {address(port)}", highlight=False, soft_wrap=True)
    if show:
        webbrowser.open(address(port))
    try:
        with OperatorKeys() as keys:
            if keys.attached:
                console.print(f"[dim]{HINT}[/]", highlight=False)
            console.print(follow(run, service, lambda words: console.print(words, highlight=False, soft_wrap=True), keys))
        if not leave:
            console.print("its picture stays until Ctrl+C", highlight=False)
            while viewer is None or viewer.poll() is None:
                sleep(0.5)
    finally:
        service.finish()
        if viewer is not None:
            viewer.terminate()


def recording(source: Path, place: Path, console: Console) -> Path:
    """The .rrd of a source; drawn from the MCAP recording when there is none, a lone file's in `place`. Raises NothingToShow."""
    if source.suffix == ".rrd" and source.is_file():
        return source
    if (source / FILE).is_file():
        return source / FILE
    if source.suffix == ".mcap" and source.is_file():
        scenario = source.parent.parent / "scenario.yaml"
        if not scenario.is_file():
            raise NothingToShow(f"{scenario} is not there: a recording is drawn with its run's scenario.yaml, two folders up")
        target = place / FILE
        drawn = DashboardService(load_scenario(str(scenario)), target, Live(), paced=False)
        with _drawing(console, (source,)) as tell:
            replay.replay((source,), drawn, tell)
        return target
    if files := replay.recording_of(source):
        with _drawing(console, files) as tell:
            return replay.main(source, tell)
    raise NothingToShow(f"{source}: neither a .rrd nor a .mcap file, nor the folder of a run that was recorded")


@contextmanager
def _drawing(console: Console, files: Sequence[Path]) -> Iterator[Callable[[int], None] | None]:
    """A bar with the time that the drawing still takes, where there is a terminal; gives what hears how far it is [ns]."""
    if not console.is_terminal:
        yield None
        return
    columns = (TextColumn("drawing"), BarColumn(bar_width=30), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("drawing", total=replay.end_of(files))
        yield lambda t: bar.update(task, completed=t)


def view(recording: Path, port: int, native: bool, show: bool, console: Console) -> None:
    """Shows a .rrd file until Ctrl+C, or until the native viewer is closed."""
    if native:
        subprocess.run(_rerun(str(recording)), check=False)
        return
    console.print(f"{recording}: {address(port)}  (Ctrl+C ends it)", highlight=False, soft_wrap=True)
    if show:
        webbrowser.open(address(port))
    ports = [
        "--bind",
        "127.0.0.1",
        "--port",
        str(port),
        "--web-viewer-port",
        str(port + 1),
        "--server-memory-limit",
        MEMORY_LIMIT,
    ]
    server = subprocess.Popen([*_rerun(str(recording)), "--serve-web", *ports])
    try:
        status = server.wait()
    finally:
        if server.poll() is None:
            server.terminate()
            server.wait()
    if status:
        raise OSError(f"rerun left with status {status}: are ports {port} and {port + 1} free? (--port)")


def _rerun(*words: str) -> list[str]:
    """The words that start rerun's own command."""
    found = find_spec("rerun_cli")
    if found is None or found.origin is None:
        raise NothingToShow("rerun's own command is not installed: pip install rerun-sdk")
    return [str(Path(found.origin).with_name("rerun.exe" if os.name == "nt" else "rerun")), *words]
