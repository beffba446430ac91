"""`palpate takeover`: takes the place of a service that was stopped, in a wall-clock run that keeps it (`--handover`)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, NoReturn

import typer
from palpate_bus import runs
from palpate_bus.zenoh_config import BusOptions

from palpate_conductor.handover import ROLES
from palpate_conductor.implementations import DEFAULT, ImplementationError, installed_command
from palpate_conductor.place import Implementation, OwnService, PlaceError, RunName, become, live_run, refuse
from palpate_conductor.processes import compose_file, read_processes
from palpate_conductor.run import KNOWS_PHANTOM


class TakeoverError(PlaceError):
    """A place that cannot be taken. Says why, and what can be done."""


def command_of(role: str, implementation: str, service: Path | None) -> tuple[str, ...]:
    """The words that start the process. Raises TakeoverError or ImplementationError: option, value and what is allowed."""
    if role not in ROLES:
        raise TakeoverError(f"{role}: only {', '.join(sorted(ROLES))} can change hands in a run; without the others it ends")
    return installed_command(role, implementation, service) or read_processes(compose_file(), (role,))[role].command


def environment_of(role: str, run: runs.Run) -> dict[str, str]:
    """What the process needs to join `run` as `role`. Raises TakeoverError when the run is in lockstep."""
    if run.runtime != "wallclock":
        raise TakeoverError(f"run {run.name} is in {run.runtime}: services change hands in wall-clock runs only")
    others = tuple(endpoint for name, endpoint in run.endpoints.items() if name != role)
    scenario = "scenario.yaml" if role in KNOWS_PHANTOM else "exam.yaml"
    return {
        **BusOptions(connect=others, router=run.router).to_env(),
        "PALPATE_RUNTIME": run.runtime,
        "PALPATE_SCENARIO": str(Path(run.out) / scenario),
        "PALPATE_OUT": run.out,
        "PALPATE_RECORD": str(int("recorder" in run.endpoints)),
        "ROS_DOMAIN_ID": str(run.domain),
    }


def takeover(
    role: Annotated[str, typer.Argument(help=f"One of {', '.join(sorted(ROLES))}.")],
    implementation: Implementation = DEFAULT,
    service: OwnService = None,
    run: RunName = None,
) -> NoReturn:
    """Take the place of a service that was stopped, in a run with --wallclock --handover SECONDS; becomes that service."""
    try:
        words = command_of(role, implementation, service)
        environment = environment_of(role, live_run(run))
    except (PlaceError, ImplementationError) as error:
        refuse(error)
    become(words, environment)
