"""`palpate run`, and the two halves of a run in containers: `palpate prepare` and `palpate conduct`.

Here are their options alone. What they do is imported when it is done, since it takes seconds to import.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from palpate.run.options import DEFAULT_SCENARIO, Record, ServiceChoices, Settings


def run(  # noqa: PLR0913 - the options of a command
    scenario: Annotated[
        str, typer.Argument(help="Name of a scenario (see `palpate scenarios`) or a YAML file.")
    ] = DEFAULT_SCENARIO,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for the results; by default out/<scenario>-<time>.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Remove the results of an earlier run from the folder.")] = False,
    seed: Annotated[int | None, typer.Option(min=0, help="Overrides the scenario's seed.")] = None,
    composed: Annotated[bool, typer.Option("--composed", help="Run all services in this process.")] = False,
    group: Annotated[
        list[str] | None,
        typer.Option(metavar="ROLE,ROLE", help="Put these services in one process, each other one in its own; may be repeated."),
    ] = None,
    processes: Annotated[
        int | None, typer.Option(metavar="N", help="Put the services in N processes, the 1 kHz loop together.")
    ] = None,
    realtime: Annotated[bool, typer.Option("--realtime", help="Run lockstep no faster than real time.")] = False,
    wallclock: Annotated[
        bool,
        typer.Option(
            "--wallclock",
            help="Run every service in real time, on its own timer, as with hardware; slower where the machine cannot keep it "
            "(or by PALPATE_RATE).",
        ),
    ] = False,
    handover: Annotated[
        float, typer.Option(min=0, help="With --wallclock: seconds that a stopped service may take to be replaced; see takeover.")
    ] = 0.0,
    without: Annotated[
        list[str] | None,
        typer.Option(metavar="ROLE", help="Do not start this role: you start it with palpate join; may be repeated."),
    ] = None,
    wait: Annotated[float, typer.Option(min=1, help="With --without: seconds to wait for it.")] = 300.0,
    record: Annotated[
        Record,
        typer.Option(help="full: every message, for replay --service; normal: a fifth of that; none: no recording at all."),
    ] = "normal",
    secure: Annotated[
        bool, typer.Option("--secure", help="Use mutual TLS; each role may do only what its contract allows.")
    ] = False,
    keys: Annotated[
        Path | None, typer.Option(help="With --secure: folder of `palpate keys init`; else keys of this run.")
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option("--resume", metavar="DIR", help="Go on with the run in DIR that broke off; the results go to DIR/resumed."),
    ] = None,
    repeat: Annotated[
        int,
        typer.Option(metavar="N", min=1, help="Run N examinations, each with its own folder and seed; see soak.json."),
    ] = 1,
    settings: Settings = None,
    services: ServiceChoices = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print the findings only.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print only the report, as JSON.")] = False,
) -> None:
    """Run an examination and write report, map and recordings.

    In a terminal, keys are an operator's controls: s soft stop (the arm retreats and waits), e emergency stop (the driver
    holds), r release.

    [bold]Examples[/]

      palpate run                                   a patient who breathes, with one lump

      palpate run healthy --seed 3 --out results    another scenario, seed and folder

      palpate run --set exam.pattern=raster --set exam.mode=point

      palpate run --service tissue=fmu              another implementation of a role

      palpate run --service assessment=mine.py      a service of your own

      palpate run --without control                 waits until you start it: palpate join control

      palpate run --secure                          encrypted; each role may do only what its contract allows

      palpate run my.yaml --composed                all services in one process, for sweeps and debugging

      palpate run --resume out/lump-20260101-120000  goes on with a run that was killed or stopped

      palpate run --group robot,tissue,control      the 1 kHz loop in one process, all others in one each; the same run hash

    The exit status is 0 when the examination came to its end, 2 when it was not begun, 3 when it was broken off, by Ctrl-C, too.
    """
    from palpate.console import refuse
    from palpate.run.inputs import usable

    unchanged = (scenario, out, seed, settings, services, repeat, overwrite) == (
        DEFAULT_SCENARIO,
        None,
        None,
        None,
        None,
        1,
        False,
    )
    if resume is not None and not unchanged:
        refuse("--resume DIR goes on with the examination of DIR: it takes neither a scenario nor what changes or places one")
    chosen = None if resume is not None else usable(scenario, settings, seed, services)

    # Only now, so that a mistake in the input is told a second sooner.
    from palpate.run.examine import How, examine, examine_again
    from palpate.run.examine import resume as go_on

    how = How(
        out=out,
        overwrite=overwrite,
        composed=composed,
        group=tuple(group or ()),
        processes=processes,
        realtime=realtime,
        wallclock=wallclock,
        handover_s=handover,
        without=tuple(without or ()),
        wait_s=wait,
        record=record,
        secure=secure,
        keys=keys,
        quiet=quiet,
        as_json=as_json,
        resume=resume,
    )
    if chosen is None:
        go_on(how)
    elif repeat > 1:
        examine_again(chosen, out, repeat)
    else:
        examine(chosen, how)


def prepare(
    scenario: Annotated[str, typer.Argument(help="Name of a scenario or a YAML file.")] = DEFAULT_SCENARIO,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the scenario files.")] = Path("out"),
    seed: Annotated[int | None, typer.Option(min=0, help="Overrides the scenario's seed.")] = None,
    settings: Settings = None,
) -> None:
    """Write the scenario files of a run in containers, its first step.

    scenario.yaml is for tissue, observers and scoring, plant.yaml for robot and camera, exam.yaml for all others. Results of an
    earlier run are kept, in a folder within this one.
    """
    from palpate.console import refuse, say
    from palpate.run.folder import FolderError, apart
    from palpate.run.inputs import usable
    from palpate.run.roles import write_scenario_files

    chosen = usable(scenario, settings, seed, elsewhere=True)
    try:
        if (earlier := apart(out)) is not None:
            say(f"the results of the run before are in {earlier} now")
        write_scenario_files(chosen, out)
    except FolderError as error:
        refuse(error)
    except OSError as error:
        refuse(f"--out {out}: cannot be written into: {error.strerror}")


def conduct(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder with scenario.yaml, for the results.")] = Path("out"),
    observers: Annotated[str, typer.Option(help="Observers of this run, comma-separated.")] = "dashboard,recorder",
    realtime: Annotated[bool, typer.Option("--realtime", help="Run lockstep no faster than real time.")] = False,
    wallclock: Annotated[bool, typer.Option("--wallclock", help="Every service on its own timer.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print the findings only.")] = False,
) -> None:
    """Conduct services that are started by others (containers, other machines) and write the report."""
    from palpate.run.conducting import conduct_others

    conduct_others(out, tuple(name for name in observers.split(",") if name), realtime, wallclock, quiet)
