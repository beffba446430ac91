"""Which command was asked for. Only what it needs is imported: `palpate stop` must not wait for a plotting library.

Packages register commands as entry points in the group `palpate.commands`: a function or a Typer app.
"""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoint, entry_points

import typer

from palpate_bus.contract import contract

EXIT_BAD_INPUT = 2
HELP = "Autonomous robotic palpation as a co-simulation of independent processes on an Eclipse zenoh bus."


def main() -> None:
    """Runs the command of `sys.argv`."""
    try:
        contract()
    except ValueError as error:
        print(f"palpate: {error}", file=sys.stderr)
        sys.exit(EXIT_BAD_INPUT)
    try:
        app_for(sys.argv[1] if len(sys.argv) > 1 else "")(prog_name="palpate")
    except BrokenPipeError:
        sys.exit(1)


def app_for(word: str) -> typer.Typer:
    """The app that has the command `word`: of that package alone where it is another's, all of them for an unknown word."""
    points = {point.name: point for point in entry_points(group="palpate.commands")}
    if word in points:
        app = typer.Typer(name="palpate", help=HELP, callback=_none, pretty_exceptions_show_locals=False)
        _add(app, points[word])
        return app
    from palpate.run.command import app  # noqa: PLC0415

    if word not in {command.name or getattr(command.callback, "__name__", "") for command in app.registered_commands}:
        for _, point in sorted(points.items()):
            _add(app, point)
    return app


def _none() -> None:
    """With a callback an app of one command still wants that command's name."""


def _add(app: typer.Typer, point: EntryPoint) -> None:
    try:
        command = point.load()
    except ImportError as error:
        print(f"palpate: the command {point.name} of {point.value} cannot be loaded: {error}", file=sys.stderr)
        return
    if isinstance(command, typer.Typer):
        app.add_typer(command, name=point.name)
    else:
        app.command(point.name)(command)
