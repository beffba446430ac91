"""`palpate run`, and the two halves of a run in containers: `palpate prepare` and `palpate conduct`."""

from __future__ import annotations

import json
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from palpate.command_line import fail, refuse, say
from palpate.report.page import write_page
from palpate.report.results import print_findings, write_results
from palpate.run.composed import run_composed
from palpate.run.distributed import run_distributed
from palpate.run.folder import FolderError, results_folder, usual_folder
from palpate.run.inputs import Settings, usable
from palpate.run.placement import PlacementError, placement
from palpate.run.places import Absent, PlaceError
from palpate.run.processes import ProcessListError
from palpate.run.progress import RunDisplay
from palpate.run.roles import NONE, OBSERVERS, ServiceChoices, workers, write_scenario_files
from palpate.run.secure import SecureBus
from palpate.run.space import WatchedRoom, another_folder, check_room
from palpate_bus.implementations import ChoiceError
from palpate_bus.security.keys import KeysError
from palpate_bus.settings import BusConfigError
from palpate_bus.wire.zenoh_config import close_session, open_session
from palpate_conductor.conduct import conduct as conduct_run
from palpate_conductor.outcome import RunFailed
from palpate_conductor.result import RunResult
from palpate_conductor.timing import Timing
from palpate_conductor.tree import FrameTree
from palpate_models.load import ScenarioError, exam_input, load_scenario
from palpate_models.scenario import Scenario

NEEDS_WALLCLOCK = "services.tissue = 'none' is for hardware, which does not wait: run with --wallclock"


def run(  # noqa: PLR0913 - the options of a command
    scenario: Annotated[str, typer.Argument(help="Name of a scenario (see `palpate scenarios`) or a YAML file.")] = "clean",
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for the results; by default out/<scenario>-<time>.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Remove the results of an earlier run from the folder.")] = False,
    seed: Annotated[int | None, typer.Option(min=0, help="Overrides the scenario's seed.")] = None,
    composed: Annotated[bool, typer.Option("--composed", help="All services in this process.")] = False,
    group: Annotated[
        list[str] | None,
        typer.Option(metavar="ROLE,ROLE", help="These services in one process, all others in one each; may be repeated."),
    ] = None,
    processes: Annotated[
        int | None, typer.Option(metavar="N", help="The services in N processes, the 1 kHz loop together.")
    ] = None,
    realtime: Annotated[bool, typer.Option("--realtime", help="Pace simulated time by the wall clock.")] = False,
    wallclock: Annotated[bool, typer.Option("--wallclock", help="Every service on its own timer, as with hardware.")] = False,
    handover: Annotated[
        float, typer.Option(min=0, help="With --wallclock: seconds for which a stopped service's place is kept; see takeover.")
    ] = 0.0,
    without: Annotated[
        list[str] | None, typer.Option(metavar="ROLE", help="Leave a role to be started by you (palpate join); may be repeated.")
    ] = None,
    wait: Annotated[float, typer.Option(min=1, help="With --without: seconds to wait for it.")] = 300.0,
    record: Annotated[bool, typer.Option(help="Write recording.rrd and the MCAP recording.")] = True,
    secure: Annotated[bool, typer.Option("--secure", help="Mutual TLS, and each role may do what its row allows.")] = False,
    keys: Annotated[
        Path | None, typer.Option(help="With --secure: folder of `palpate keys init`; else keys of this run.")
    ] = None,
    settings: Settings = None,
    services: ServiceChoices = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print the findings only.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as JSON, and nothing else.")] = False,
) -> None:
    """Run an examination and write report, map and recordings.

    In a terminal, keys are an operator's hand on it: s soft stop (the arm retreats and waits), e emergency stop (the driver
    holds), r release.

    [bold]Examples[/]

      palpate run                                   the paper's case: guarding in the right lower quadrant

      palpate run healthy --seed 3 --out results    another scenario, seed and folder

      palpate run --set exam.pattern=raster --set exam.mode=point

      palpate run --service tissue=fmu              another implementation of a role

      palpate run --service assessment=mine.py      a service of your own

      palpate run --without control                 waits until you start it: palpate join control

      palpate run --secure                          encrypted, and each role may do only what it has to

      palpate run my.yaml --composed                all services in one process, for sweeps and debugging

      palpate run --group robot,tissue,control      the 1 kHz loop in one process, all others in one each; the same run hash
    """
    console = Console(stderr=True)
    quiet = quiet or as_json
    chosen = usable(scenario, settings, seed, services)
    observers = OBSERVERS if record else ()
    shared = bool(group) or processes is not None
    for contradiction, why in (
        (composed and (realtime or wallclock), "--composed runs as fast as it can: it takes neither --realtime nor --wallclock"),
        (chosen.services.tissue == NONE and not wallclock, NEEDS_WALLCLOCK),
        (without and composed, "--without ROLE leaves out a process: it goes without --composed"),
        (shared and composed, "--composed is one process for all: it takes neither --group nor --processes"),
        (shared and wallclock, "--wallclock needs a process for each service: it takes neither --group nor --processes"),
        (handover and not wallclock, "--handover is for --wallclock: in lockstep every message of a service is awaited"),
        (composed and secure, "--secure is for processes, so it goes without --composed"),
        (keys and not secure, "--keys goes with --secure"),
    ):
        if contradiction:
            refuse(why)
    try:
        absent = Absent(tuple(without or ()), wait, partial(console.print, highlight=False, soft_wrap=True))
        groups = placement((*workers(chosen), *observers), group or (), processes)
    except (PlaceError, PlacementError) as error:
        refuse(error)
    folder = out or usual_folder(chosen.name)
    if not quiet:
        console.print(f"[bold]{chosen.name}[/] seed {chosen.seed}, results in {folder}", highlight=False)
        if not composed:
            console.print("[dim]look at it from another terminal: palpate doctor, palpate topic list[/]", highlight=False)
    try:
        with results_folder(folder, overwrite=overwrite):
            check_room(folder, chosen.exam, recorded=record)
            with RunDisplay(console, quiet) as display:
                tell = WatchedRoom(folder, display.tell, say).tell
                if composed:
                    result = run_composed(chosen, folder.resolve(), tell, observers)
                else:
                    timing = Timing(wallclock, 1.0 if realtime else None, handover_s=handover)
                    with SecureBus(keys) if secure else nullcontext() as bus:
                        result = run_distributed(chosen, folder.resolve(), tell, observers, timing, bus, absent, groups)
            _conclude(console, folder, chosen, result, quiet, as_json)
    except (ProcessListError, ChoiceError, PlaceError, PlacementError, BusConfigError, KeysError, FolderError, OSError) as error:
        refuse(error)
    except RunFailed as error:
        fail(error)


def _conclude(
    console: Console, folder: Path, scenario: Scenario, result: RunResult, quiet: bool = False, as_json: bool = False
) -> None:
    """Writes the results, prints the findings, and leaves with status 3 when the run failed or its folder took no results."""
    with nullcontext() if quiet else console.status("writing report and maps"):
        trouble = ""
        try:
            report = write_results(folder, scenario, result)
            page = write_page(folder)
        except OSError as error:
            trouble = f"{folder}: the results cannot be written there ({error.strerror})"
            folder = another_folder()
            write_scenario_files(scenario, folder)
            report = write_results(folder, scenario, result)
            page = write_page(folder)
    if as_json:
        print(json.dumps({"folder": str(folder), **report.model_dump(mode="json")}))
    else:
        print_findings(Console(), report)
    if not quiet or trouble:
        console.print(f"to read: {page}", highlight=False, soft_wrap=True)
    if result.failure:
        fail(f"the run failed: {result.failure} (logs in {folder / 'logs'})")
    if trouble:
        fail(f"{trouble}; they are in {folder}")


def prepare(
    scenario: Annotated[str, typer.Argument(help="Name of a scenario or a YAML file.")] = "clean",
    out: Annotated[Path, typer.Option(help="Folder for the scenario files.")] = Path("out"),
    seed: Annotated[int | None, typer.Option(min=0, help="Overrides the scenario's seed.")] = None,
    settings: Settings = None,
) -> None:
    """Write the scenario files of a run in containers, its first step.

    scenario.yaml is for tissue, observers and scoring, plant.yaml for robot and camera, exam.yaml for everybody else.
    """
    write_scenario_files(usable(scenario, settings, seed, elsewhere=True), out)


def conduct(
    out: Annotated[Path, typer.Option(help="Folder with scenario.yaml, for the results.")] = Path("out"),
    observers: Annotated[str, typer.Option(help="Observers of this run, comma-separated.")] = ",".join(OBSERVERS),
    realtime: Annotated[bool, typer.Option("--realtime", help="Pace simulated time by the wall clock.")] = False,
    wallclock: Annotated[bool, typer.Option("--wallclock", help="Every service on its own timer.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print the findings only.")] = False,
) -> None:
    """Conduct services that are started by others (containers, other machines) and write the report."""
    console = Console(stderr=True)
    watching = tuple(name for name in observers.split(",") if name)
    for name in watching:
        if name not in OBSERVERS:
            refuse(f"--observers {name}: allowed are {', '.join(OBSERVERS)}")
    try:
        chosen = load_scenario(str(out / "scenario.yaml"))
        if chosen.services.tissue == NONE and not wallclock:
            refuse(NEEDS_WALLCLOCK)
        session = open_session()
    except (ScenarioError, BusConfigError) as error:
        refuse(error)
    roles = (*workers(chosen), *watching)
    with RunDisplay(console, quiet) as display:
        timing = Timing(wallclock, 1.0 if realtime else None)
        result = conduct_run(session, roles, display.tell, timing=timing, tree=FrameTree(exam_input(chosen)))
    close_session(session)
    _conclude(console, out, chosen, result, quiet)
