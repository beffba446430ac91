"""`palpate run`, and the two halves of a run in containers: `palpate prepare` and `palpate conduct`.

What they do is imported when they are called, since that takes seconds.
"""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from palpate.run.options import DEFAULT_SCENARIO, Quiet, Realtime, RunOptions, ScenarioName, Seed, Settings, takes


@takes(RunOptions)
def run(options: RunOptions) -> None:
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

      palpate run --resume out/lump-20260101-120000  continues a run that was killed or stopped

      palpate run --group robot,tissue,control      the 1 kHz loop in one process, all others in one each; the same run hash

    The exit status is 0 when the examination was completed, 2 when it was not started, 3 when it failed or was interrupted,
    130 when it was interrupted before it began.
    """
    from palpate.run.inputs import check_usable
    from palpate_errors import UserError

    if options.resume is not None:
        given = replace(options, scenario=DEFAULT_SCENARIO, out=None, seed=None, settings=None, services=None, overwrite=False)
        if given != options:
            raise UserError("--resume cannot be combined with a scenario, --seed, --set, --service, --out or --overwrite")
        from palpate.run.examine import resume

        resume(options)
    else:
        chosen = check_usable(options.scenario, options.settings, options.seed, options.services)
        from palpate.run.examine import examine  # only now, so that bad input is reported a second sooner

        examine(chosen, options)


def prepare(
    scenario: ScenarioName = DEFAULT_SCENARIO,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the scenario files.")] = Path("out"),
    seed: Seed = None,
    settings: Settings = None,
) -> None:
    """Write the scenario files of a run in containers, its first step.

    scenario.yaml is for tissue, observers and scoring, plant.yaml for robot and camera, exam.yaml for all others. Results of an
    earlier run are kept, in a folder within this one.
    """
    from palpate.console import say
    from palpate.run.folder import set_aside
    from palpate.run.inputs import check_usable
    from palpate.run.roles import write_scenario_files
    from palpate_errors import UserError, restate

    chosen = check_usable(scenario, settings, seed, elsewhere=True)
    with restate(OSError, UserError, f"--out {out}: cannot be written into"):
        if (earlier := set_aside(out)) is not None:
            say(f"the results of the earlier run were moved to {earlier}")
        write_scenario_files(chosen, out)


def conduct(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder with scenario.yaml, for the results.")] = Path("out"),
    observers: Annotated[str, typer.Option(help="Observers of this run, comma-separated.")] = "dashboard,recorder",
    realtime: Realtime = False,
    wallclock: Annotated[bool, typer.Option("--wallclock", help="Every service on its own timer.")] = False,
    quiet: Quiet = False,
) -> None:
    """Conduct services that are started by others (containers, other machines) and write the report."""
    from palpate.run.conducting import conduct_others

    conduct_others(out, tuple(name for name in observers.split(",") if name), realtime, wallclock, quiet)
