"""`palpate dashboard`: a run in the browser or in the native viewer, live or from its recording."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from palpate.command_line import refuse
from palpate.live.options import ChosenRun

DEFAULT_PORT = 9876
PICTURE_PX = (1500, 940)


def dashboard(  # noqa: PLR0913 - the options of a command
    source: Annotated[
        str | None, typer.Argument(metavar="[DIR|FILE]", help="Results folder, .rrd or .mcap; by default the current run.")
    ] = None,
    port: Annotated[
        int, typer.Option(min=1024, max=65534, help="Port for viewers; the browser's page is at the next port.")
    ] = DEFAULT_PORT,
    native: Annotated[bool, typer.Option("--native", help="Use rerun's own window, not the browser.")] = False,
    show: Annotated[bool, typer.Option("--open/--no-open", help="Open the browser.")] = False,
    chosen: ChosenRun = None,
    leave: Annotated[bool, typer.Option("--leave", help="End with the run; by default the picture stays until Ctrl+C.")] = False,
    picture: Annotated[
        Path | None, typer.Option(metavar="PNG", help="Write a picture of a recorded run at the time --at; needs Chromium.")
    ] = None,
    at: Annotated[float, typer.Option(min=0, metavar="SECONDS", help="With --picture: the simulated time.")] = 60.0,
    film_file: Annotated[
        Path | None, typer.Option("--film", metavar="GIF", help="Write a film of a recorded run; needs Chromium.")
    ] = None,
) -> None:
    """Watch a run live in the browser, from its start or later, or from its recording. This does not slow the run down.

    While it shows a live run, keys in its terminal are an operator's controls: s soft stop (the arm retreats and waits),
    e emergency stop (the driver holds), r release.
    """
    from palpate.live.viewing import NothingToShow, recording, view, watch
    from palpate_bus.runs.joining import NoBus, named_runs
    from palpate_bus.settings import BusConfigError
    from palpate_dashboard.picture import NoPicture, film, take
    from palpate_models.scenario.load import ScenarioError

    console = Console(stderr=True)

    def tell(words: str) -> None:
        console.print(words, highlight=False, soft_wrap=True)

    try:
        if picture or film_file:
            if source is None:
                raise NothingToShow("--picture and --film need the folder of a run that was recorded")
            if picture:
                take(Path(source), picture, at, port, PICTURE_PX, tell)
            if film_file:
                film(Path(source), film_file, port, PICTURE_PX, tell)
        elif source is None:
            run = named_runs(chosen, "or give a results folder, a .rrd or a .mcap file")[-1]
            watch(run, port, native, show, leave, console)
        else:
            with tempfile.TemporaryDirectory(prefix="palpate-dashboard-") as place:
                view(recording(Path(source), Path(place), console), port, native, show, console)
    except (NoBus, NothingToShow, NoPicture, BusConfigError, ScenarioError, OSError, ValueError) as error:
        refuse(error)
    except KeyboardInterrupt:
        raise typer.Exit from None
