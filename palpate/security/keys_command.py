"""`palpate keys`: certificates for the secure mode."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from palpate.command_line import refuse

app = typer.Typer(help="Certificates for the secure mode (`palpate run --secure`).", no_args_is_help=True)

Folder = Annotated[Path, typer.Argument(help="Folder of the keys.")]
DEFAULT = Path("keys")


@app.command("init")
def make(
    folder: Folder = DEFAULT,
    host: Annotated[list[str] | None, typer.Option(help="Name or address of the router; may be repeated.")] = None,
    name: Annotated[list[str] | None, typer.Option(help="Members; by default all roles, router, viewer and operator.")] = None,
    days: Annotated[
        int | None, typer.Option(min=1, help="Validity of the certificates in days; by default two years and three months.")
    ] = None,
) -> None:
    """Make a certificate authority and a certificate for each role; valid ones are kept."""
    from palpate_bus.security.keys import CA, CA_KEY, CERTIFICATE, DAYS, KEY, KeysError, init, members

    console = Console(stderr=True)
    for known in name or ():
        if known not in members():
            refuse(f"--name {known}: members are {', '.join(members())}")
    try:
        made = init(folder, name or (), host or (), days or DAYS)
    except (KeysError, OSError, ValueError) as error:
        refuse(error)
    for certificate in made:
        console.print(
            f"wrote {certificate.path.parent}: {CERTIFICATE}, {KEY}, {CA}, until {certificate.until:%Y-%m-%d}",
            highlight=False,
            soft_wrap=True,
        )
    console.print(f"{len(made)} new in {folder}" if made else f"{folder}: all hold", highlight=False, soft_wrap=True)
    console.print(
        f"give each member its own folder only; keep {folder / CA_KEY} away from the machines of a run",
        highlight=False,
        soft_wrap=True,
    )


@app.command()
def show(folder: Folder = DEFAULT) -> None:
    """List the certificates of a folder, their expiry and fingerprints."""
    from palpate_bus.security.keys import KeysError, certificates

    try:
        found = certificates(folder)
    except KeysError as error:
        refuse(error)
    table = Table("name", "holds until", "SHA-256", box=None)
    for certificate in found:
        until = f"{certificate.until:%Y-%m-%d}" + (" [red]expired[/]" if certificate.expired else "")
        table.add_row(certificate.name, until, certificate.fingerprint[:32])
    Console().print(table)
