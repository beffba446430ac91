"""`palpate join` and `palpate takeover`: their options. What they do is imported when it is done."""

from __future__ import annotations

from typing import Annotated, NoReturn

import typer

from palpate_conductor.handover import ROLES

NameOrFile = Annotated[
    str | None,
    typer.Option("--service", metavar="NAME_OR_FILE", help="An installed implementation or a Python file; else the run's own."),
]
RunName = Annotated[str | None, typer.Option(help="The run: its process id, or part of its name; by default the newest.")]


def join(
    role: Annotated[str, typer.Argument(help="The role that the run was started without.")],
    service: NameOrFile = None,
    run: RunName = None,
) -> NoReturn:
    """Join a run that was started with --without ROLE; becomes that service."""
    from palpate.run.places import enter, place_to_join

    enter(place_to_join, role, service, run)


def takeover(
    role: Annotated[str, typer.Argument(help=f"One of {', '.join(sorted(ROLES))}.")],
    service: NameOrFile = None,
    run: RunName = None,
) -> NoReturn:
    """Take the place of a service that was stopped, in a run with --wallclock --handover SECONDS; becomes that service."""
    from palpate.run.places import enter, place_to_take

    enter(place_to_take, role, service, run)
