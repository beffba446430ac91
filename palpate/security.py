"""`palpate keys`: certificates of the secure mode. `palpate router`: the router of a bus that spans containers or machines."""

from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from palpate.console import SteadyConsole, table
from palpate_errors import UserError

app = typer.Typer(help="Certificates for the secure mode (`palpate run --secure`).", no_args_is_help=True)

Folder = Annotated[Path, typer.Argument(help="Folder of the keys.")]
DEFAULT = Path("keys")


@app.command("init")
def make(
    folder: Folder = DEFAULT,
    host: Annotated[list[str] | None, typer.Option(help="Name or address of the router; may be repeated.")] = None,
    name: Annotated[list[str] | None, typer.Option(help="Members; by default all roles, router, viewer and operator.")] = None,
    days: Annotated[int | None, typer.Option(min=1, help="Validity in days; by default two years and three months.")] = None,
) -> None:
    """Make a certificate authority and a certificate for each role; valid ones are kept."""
    from palpate_bus.security.keys import CA, CA_KEY, CERTIFICATE, DAYS, KEY, init, members

    console = SteadyConsole(stderr=True, soft_wrap=True)
    for known in name or ():
        if known not in members():
            raise UserError(f"--name {known}: members are {', '.join(members())}")
    made = init(folder, name or (), host or (), days or DAYS)
    for certificate in made:
        console.print(f"wrote {certificate.path.parent}: {CERTIFICATE}, {KEY}, {CA}, until {certificate.until:%Y-%m-%d}")
    console.print(f"{len(made)} new in {folder}" if made else f"{folder}: all certificates are valid")
    console.print(f"give each member its own folder only; keep {folder / CA_KEY} away from the machines of a run")


@app.command()
def show(folder: Folder = DEFAULT) -> None:
    """List the certificates of a folder, their expiry and fingerprints."""
    from palpate_bus.security.keys import certificates

    rows = table("name", "valid until", "SHA-256")
    for certificate in certificates(folder):
        until = Text.assemble(f"{certificate.until:%Y-%m-%d}", (" expired" if certificate.expired else "", "red"))
        rows.add_row(certificate.name, until, certificate.fingerprint[:32])
    SteadyConsole().print(rows)


SECURE_ENDPOINT = "tls/[::]:7447"


def router(
    listen: Annotated[list[str] | None, typer.Argument(help="Endpoints to listen on, e.g. tcp/0.0.0.0:7447.")] = None,
    keys: Annotated[Path | None, typer.Option(help="The router's certificates: a secure router, at tls/ endpoints.")] = None,
) -> None:
    """Run a zenoh router for services in containers or on several machines, until it is stopped."""
    from palpate_bus.contract import contract
    from palpate_bus.security.access import access_control
    from palpate_bus.wire.zenoh_config import DEFAULT_ENDPOINT, serve

    console = SteadyConsole(stderr=True)
    if keys is not None:
        serve(listen or (SECURE_ENDPOINT,), console.print, keys, access_control(contract()))
    else:
        serve(listen or (DEFAULT_ENDPOINT,), console.print)
