"""Options of the commands on a live bus."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, NamedTuple

import typer

Connect = Annotated[
    list[str] | None,
    typer.Option("--connect", "-c", metavar="ENDPOINT", help="Endpoint to join, e.g. tcp/10.0.0.5:7447; may be repeated."),
]
ChosenRun = Annotated[str | None, typer.Option("--run", metavar="NAME", help="The run: its process id, or part of its name.")]
Domain = Annotated[int | None, typer.Option(help="ROS domain; by default the run's, else ROS_DOMAIN_ID.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]


class ChosenBus(NamedTuple):
    """The bus that the user means: endpoints, or a run, or by default the only run on this machine."""

    connect: Sequence[str] | None = None
    run: str | None = None
    domain: int | None = None
