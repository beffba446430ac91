"""`palpate dashboard`: a run in the browser or in the native viewer, live or from its recording."""

from __future__ import annotations

import os
import subprocess
import tempfile
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from time import sleep
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from palpate.console import SteadyConsole, TimeLeft
from palpate.live.bus import ChosenRun
from palpate_errors import UserError
from palpate_plugins import needs

if TYPE_CHECKING:
    from palpate_bus.runs.announcement import Run

PICTURE_PX = (1500, 940)


def dashboard(
    source: Annotated[
        str | None, typer.Argument(metavar="[DIR|FILE]", help="Results folder, .rrd or .mcap; by default the current run.")
    ] = None,
    port: Annotated[int, typer.Option(min=1024, max=65534, help="Port for viewers; the browser's page is at the next.")] = 9876,
    native: Annotated[bool, typer.Option("--native", help="Use rerun's own window, not the browser.")] = False,
    chosen: ChosenRun = None,
    picture: Annotated[Path | None, typer.Option(metavar="PNG", help="Draw a recorded run at --at; needs Chromium.")] = None,
    at: Annotated[float, typer.Option(min=0, metavar="SECONDS", help="With --picture: the simulated time.")] = 60.0,
    film_file: Annotated[Path | None, typer.Option("--film", metavar="GIF", help="Film a recorded run; needs Chromium.")] = None,
) -> None:
    """Watch a run live in the browser, from its start or later, or from its recording. This does not slow the run down.

    While it shows a live run, keys in its terminal are an operator's controls: s soft stop (the arm retreats and waits),
    e emergency stop (the driver holds), r release.
    """
    from palpate_bus.runs.announcement import named_runs
    from palpate_dashboard.picture import film, take

    console = SteadyConsole(stderr=True, soft_wrap=True)
    try:
        if picture or film_file:
            if source is None:
                raise UserError("--picture and --film need the folder of a run that was recorded")
            if picture:
                take(Path(source), picture, at, port, PICTURE_PX, console.print)
            if film_file:
                film(Path(source), film_file, port, PICTURE_PX, console.print)
        elif source is None:
            run = named_runs(chosen, "or give a results folder, a .rrd or a .mcap file")[-1]
            _follow(run, port, native, console)
        else:
            with tempfile.TemporaryDirectory(prefix="palpate-dashboard-") as place:
                _view(_draw_recording(Path(source), Path(place)), port, native, console)
    except KeyboardInterrupt:
        raise typer.Exit from None


def _follow(run: Run, port: int, native: bool, console: Console) -> None:
    """Follow a run to its end and keep showing it afterwards."""
    from palpate_bus.runs.operator import HINT, OperatorKeys
    from palpate_dashboard.replay import follow
    from palpate_dashboard.service import DashboardService
    from palpate_dashboard.sinks import Live, address
    from palpate_models.scenario.load import load_scenario

    scenario = Path(run.out) / "scenario.yaml"
    if not scenario.is_file():
        raise UserError(f"{scenario} is not there: the folder of the run {run.name} is not on this machine")
    service = DashboardService(load_scenario(str(scenario)), None, Live(serve_port=port))
    viewer = subprocess.Popen(_rerun(f"rerun+http://127.0.0.1:{port}/proxy")) if native else None
    console.print(f"{run.name} (process {run.pid}): {address(port)}")
    try:
        with OperatorKeys() as keys:
            if keys.attached:
                console.print(HINT, style="dim")
            console.print(follow(run, service, console.print, keys))
        console.print("its picture stays until Ctrl+C")
        while viewer is None or viewer.poll() is None:
            sleep(0.5)
    finally:
        service.finish()
        if viewer is not None:
            viewer.terminate()


def _draw_recording(source: Path, place: Path) -> Path:
    """Return the .rrd of a source, drawn from the MCAP recording if there is none (into `place` for a single file)."""
    from palpate_dashboard import replay
    from palpate_dashboard.service import FILE

    for made in (source, source / FILE):
        if made.suffix == ".rrd" and made.is_file():
            return made
    alone = source.suffix == ".mcap" and source.is_file()
    files = (source,) if alone else replay.recording_of(source)
    if not files:
        raise UserError(f"{source}: neither a .rrd nor a .mcap file, nor the folder of a run that was recorded")
    scenario = (source.parent.parent if alone else source) / "scenario.yaml"
    if not scenario.is_file():
        where = ", two folders up" if alone else ""
        raise UserError(f"{scenario} is not there: a recording is drawn with its run's scenario.yaml{where}")
    reached = [0]
    with TimeLeft(lambda: "drawing", lambda: reached[0], 0, replay.end_of(files) or 0):
        return replay.replay(files, scenario, (place if alone else source) / FILE, partial(reached.__setitem__, 0))


def _view(recording: Path, port: int, native: bool, console: Console) -> None:
    """Show a .rrd file until Ctrl+C, or until the native viewer is closed."""
    from palpate_dashboard.sinks import MEMORY_LIMIT, address

    if native:
        subprocess.run(_rerun(str(recording)), check=False)
        return
    console.print(f"{recording}: {address(port)}  (Ctrl+C ends it)")
    ports = ("--bind", "127.0.0.1", "--port", str(port), "--web-viewer-port", str(port + 1))
    words = [*_rerun(str(recording)), "--serve-web", *ports, "--server-memory-limit", MEMORY_LIMIT]
    server = subprocess.Popen(words, env={"RUST_LOG": "warn", **os.environ})  # its notices would bury the address
    try:
        status = server.wait()
    finally:
        if server.poll() is None:
            server.terminate()
            server.wait()
    if status:
        raise UserError(f"rerun left with status {status}: are ports {port} and {port + 1} free? (--port)")


def _rerun(*words: str) -> list[str]:
    """Return the command line of rerun's own viewer."""
    found = find_spec("rerun_cli")
    if found is None or found.origin is None:
        raise UserError(f"rerun's own command {needs(('rerun-sdk',), 'dashboard')}")
    return [str(Path(found.origin).with_name("rerun.exe" if os.name == "nt" else "rerun")), *words]
