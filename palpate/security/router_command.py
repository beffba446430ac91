"""`palpate router`: the meeting point of a bus that spans containers or machines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

SECURE_ENDPOINT = "tls/[::]:7447"


def router(
    listen: Annotated[list[str] | None, typer.Argument(help="Endpoints to listen on, e.g. tcp/0.0.0.0:7447.")] = None,
    keys: Annotated[
        Path | None, typer.Option(help="The router's folder of certificates: a secure router, at tls/ endpoints.")
    ] = None,
) -> None:
    """Run a zenoh router for services in containers or on several machines, until it is stopped."""
    from rich.console import Console

    from palpate.command_line import refuse
    from palpate_bus.contract import contract
    from palpate_bus.security.access import access_control
    from palpate_bus.wire.router import DEFAULT_ENDPOINT, serve
    from palpate_bus.wire.zenoh_config import BusConfigError

    console = Console(stderr=True)
    try:
        if keys is not None:
            serve(listen or (SECURE_ENDPOINT,), console.print, keys, access_control(contract()))
            return
        serve(listen or (DEFAULT_ENDPOINT,), console.print)
    except BusConfigError as error:
        refuse(error)
