"""`palpate takeover`: takes the place of a service that was stopped, in a wall-clock run that keeps it (`--handover`)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from palpate.command_line import refuse
from palpate.run.implementations import DEFAULT, ImplementationError, installed_command
from palpate.run.place import OwnService, PlaceError, RunName, become, live_run
from palpate.run.processes import ProcessListError, ServiceProcess, compose_file, read_processes
from palpate_bus.runs import announcement as runs
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_conductor.handover import ROLES

FILE = "places.json"
"""In the results folder of a run that keeps places: the command of each role that may change hands."""


class TakeoverError(PlaceError):
    """A place that cannot be taken. Says why, and what can be done."""


def keep_places(out: Path, processes: Mapping[str, ServiceProcess]) -> None:
    """Writes what plays the roles that may change hands, for who takes one over."""
    rows = {role: list(process.command) for role, process in processes.items() if role in ROLES}
    (out / FILE).write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


def command_of(role: str, implementation: str | None, service: Path | None, run: runs.Run) -> tuple[str, ...]:
    """The words that start the process: those of the run, unless another implementation is asked for.

    Raises TakeoverError or ImplementationError: option, value and what is allowed.
    """
    if role not in ROLES:
        raise TakeoverError(f"{role}: only {', '.join(sorted(ROLES))} can change hands in a run; without the others it ends")
    try:
        rows = json.loads((Path(run.out) / FILE).read_text(encoding="utf-8"))
    except OSError as error:
        raise TakeoverError(f"run {run.name} keeps no places: start it with `palpate run --wallclock --handover 60`") from error
    if implementation is None and service is None:
        return tuple(rows[role])
    return installed_command(role, implementation or DEFAULT, service) or read_processes(compose_file(), (role,))[role].command


def environment_of(role: str, run: runs.Run) -> dict[str, str]:
    """What the process needs to join `run` as `role`. Raises TakeoverError when the run is in lockstep."""
    if run.runtime != "wallclock":
        raise TakeoverError(f"run {run.name} is in {run.runtime}: services change hands in wall-clock runs only")
    others = tuple(endpoint for name, endpoint in run.endpoints.items() if name != role)
    bus = BusOptions(connect=others, router=run.router) if run.keys is None else run.options(role)
    return {
        **bus.to_env(),
        "PALPATE_RUNTIME": run.runtime,
        "PALPATE_SCENARIO": str(Path(run.out) / "exam.yaml"),
        "PALPATE_OUT": run.out,
        "PALPATE_RECORD": str(int("recorder" in run.endpoints)),
        "ROS_DOMAIN_ID": str(run.domain),
    }


def takeover(
    role: Annotated[str, typer.Argument(help=f"One of {', '.join(sorted(ROLES))}.")],
    implementation: Annotated[
        str | None, typer.Option(help="An installed implementation, or `default`; without it the same again.")
    ] = None,
    service: OwnService = None,
    run: RunName = None,
) -> NoReturn:
    """Take the place of a service that was stopped, in a run with --wallclock --handover SECONDS; becomes that service."""
    try:
        joined = live_run(run)
        environment = environment_of(role, joined)
        words = command_of(role, implementation, service, joined)
    except (PlaceError, ImplementationError, ProcessListError) as error:
        refuse(error)
    become(words, environment)
