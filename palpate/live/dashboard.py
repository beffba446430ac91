"""`palpate dashboard`: a run in the browser or in the native viewer, live or from its recording."""

from __future__ import annotations

import os
import subprocess
import tempfile
import webbrowser
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from importlib.util import find_spec
from pathlib import Path
from time import sleep
from typing import Annotated

import typer
from rich.console import Console
from rich.status import Status

from palpate.command_line import refuse
from palpate_bus.runs.announcement import Run, live, matching
from palpate_bus.runs.operator_keys import HINT, OperatorKeys
from palpate_bus.settings import BusConfigError
from palpate_dashboard import replay
from palpate_dashboard.follow import follow
from palpate_dashboard.picture import NoPicture, take
from palpate_dashboard.service import FILE, DashboardService
from palpate_dashboard.sinks import MEMORY_LIMIT, Live, address
from palpate_models.load import ScenarioError, load_scenario

DEFAULT_PORT = 9876
PICTURE_PX = (1500, 940)


class NothingToShow(RuntimeError):
    """No run and no recording. Says what to do."""


def dashboard(
    source: Annotated[
        str | None, typer.Argument(metavar="[DIR|FILE]", help="Results folder, .rrd or .mcap; none: the run that is on.")
    ] = None,
    port: Annotated[
        int, typer.Option(min=1024, max=65534, help="For viewers; the browser's page is at the next.")
    ] = DEFAULT_PORT,
    native: Annotated[bool, typer.Option("--native", help="In rerun's own window, not in the browser.")] = False,
    show: Annotated[bool, typer.Option("--open/--no-open", help="Open the browser.")] = False,
    chosen: Annotated[
        str | None, typer.Option("--run", metavar="NAME", help="Which run: its process id, or part of its name.")
    ] = None,
    leave: Annotated[bool, typer.Option("--leave", help="End with the run; else its picture stays until Ctrl+C.")] = False,
    picture: Annotated[
        Path | None, typer.Option(metavar="PNG", help="Write how a recorded run looks at --at, by a headless browser, and end.")
    ] = None,
    at: Annotated[float, typer.Option(min=0, metavar="SECONDS", help="With --picture: the simulated time.")] = 60.0,
) -> None:
    """Watch a run: live in the browser, joined late or not, or from its recording. It slows no run down.

    While it shows a live run, keys in its terminal are an operator's hand on it: s soft stop (the arm retreats and waits),
    e emergency stop (the driver holds), r release.
    """
    console = Console(stderr=True)
    try:
        if picture is not None:
            if source is None:
                raise NothingToShow("--picture wants the folder of a run that was recorded")
            take(
                Path(source), picture, at, port, *PICTURE_PX, lambda words: console.print(words, highlight=False, soft_wrap=True)
            )
        elif source is None:
            _watch(_the_run(chosen), port, native, show, leave, console)
        else:
            _view(_recording(Path(source), console), port, native, show, console)
    except (NothingToShow, NoPicture, BusConfigError, ScenarioError, OSError, ValueError) as error:
        refuse(error)
    except KeyboardInterrupt:
        raise typer.Exit from None


def _the_run(chosen: str | None) -> Run:
    """The newest run that is on, or the newest that `chosen` names. Raises NothingToShow."""
    found = matching(chosen)
    if found:
        return found[-1]
    if runs := live():
        names = ", ".join(f"{run.name} ({run.pid})" for run in runs)
        raise NothingToShow(f"--run {chosen}: no run on this machine is called so; there are {names}")
    raise NothingToShow("no run is on: start one with `palpate run`, or give a results folder, a .rrd or a .mcap file")


def _watch(run: Run, port: int, native: bool, show: bool, leave: bool, console: Console) -> None:
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


def _recording(source: Path, console: Console) -> Path:
    """The .rrd of a source; drawn from the MCAP recording when there is none. Raises NothingToShow."""
    if source.suffix == ".rrd" and source.is_file():
        return source
    if (source / FILE).is_file():
        return source / FILE
    if source.suffix == ".mcap" and source.is_file():
        scenario = source.parent.parent / "scenario.yaml"
        if not scenario.is_file():
            raise NothingToShow(f"{scenario} is not there: a recording is drawn with its run's scenario.yaml, two folders up")
        target = Path(tempfile.mkdtemp(prefix="palpate-dashboard-")) / FILE
        drawn = DashboardService(load_scenario(str(scenario)), target, Live(), paced=False)
        with _drawing(console) as status:
            replay.replay((source,), drawn, _teller(status))
        return target
    if replay.recording_of(source):
        with _drawing(console) as status:
            return replay.main(source, _teller(status))
    raise NothingToShow(f"{source}: neither a .rrd nor a .mcap file, nor the folder of a run that was recorded")


def _drawing(console: Console) -> AbstractContextManager[Status | None]:
    """A line that shows how far the drawing is, where there is a terminal."""
    return console.status("drawing") if console.is_terminal else nullcontext()


def _teller(status: Status | None) -> Callable[[int], None] | None:
    return None if status is None else lambda t: status.update(f"drawing {t / 1e9:.0f} s")


def _view(recording: Path, port: int, native: bool, show: bool, console: Console) -> None:
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
    server = subprocess.Popen([*_rerun(str(recording)), "--serve-web", *ports, "--server-memory-limit", MEMORY_LIMIT])
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
