"""`palpate takeover`: takes the place of a service that was stopped, in a wall-clock run that keeps it (`--handover`)."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from palpate_bus import runs
from palpate_bus.zenoh_config import BusOptions
from rich.console import Console
from rich.markup import escape

from palpate_conductor.handover import ROLES
from palpate_conductor.implementations import DEFAULT, ImplementationError, installed_command
from palpate_conductor.processes import compose_file, read_processes
from palpate_conductor.run import KNOWS_PHANTOM

EXIT_BAD_INPUT = 2


class TakeoverError(ValueError):
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
    implementation: Annotated[
        str, typer.Option(help="An installed implementation, as in `--set <role>.implementation`.")
    ] = DEFAULT,
    service: Annotated[Path | None, typer.Option(metavar="FILE.py", help="A service of one's own instead.")] = None,
    run: Annotated[str | None, typer.Option(help="Which run, by its results folder's name; by default the newest.")] = None,
) -> NoReturn:
    """Take the place of a service that was stopped, in a run with --wallclock --handover SECONDS; becomes that service."""
    try:
        words = command_of(role, implementation, service)
        live = [each for each in runs.live() if run is None or each.name == run]
        if not live:
            raise TakeoverError(f"no run {run or ''} is on; on this machine: {', '.join(r.name for r in runs.live()) or 'none'}")
        environment = {**os.environ, **environment_of(role, live[-1])}
    except (TakeoverError, ImplementationError) as error:
        Console(stderr=True).print(f"[bold red]palpate:[/] {escape(str(error))}", highlight=False, soft_wrap=True)
        raise typer.Exit(EXIT_BAD_INPUT) from error
    program = sys.executable if words[0] == "python" else words[0]
    os.execvpe(program, [program, *words[1:]], environment)
