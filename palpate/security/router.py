"""`palpate router`: the meeting point of a bus that spans containers or machines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from palpate.command_line import refuse
from palpate_bus.security.guard import serve as serve_secure
from palpate_bus.wire.router import DEFAULT_ENDPOINT, serve
from palpate_bus.wire.zenoh_config import BusConfigError

SECURE_ENDPOINT = "tls/[::]:7447"


def router(
    listen: Annotated[list[str] | None, typer.Argument(help="Endpoints to listen on, e.g. tcp/0.0.0.0:7447.")] = None,
    keys: Annotated[
        Path | None, typer.Option(help="The router's folder of certificates: a secure router, at one tls/ endpoint.")
    ] = None,
) -> None:
    """Run a zenoh router for services in containers or on several machines, until a signal."""
    console = Console(stderr=True)
    try:
        if keys is not None:
            serve_secure(keys, (listen or [SECURE_ENDPOINT])[0], ready=console.print)
            return
        serve(listen or (DEFAULT_ENDPOINT,), ready=console.print)
    except BusConfigError as error:
        refuse(error)
