"""The table of commands. Only the module of the command that was asked for is imported: `palpate stop` must not wait for a
plotting library.
"""

from __future__ import annotations

import sys
from importlib import import_module

import typer

from palpate.command_line import EXIT_BAD_INPUT
from palpate_bus.contract import contract

HELP = "Autonomous robotic palpation as a co-simulation of independent processes on an Eclipse zenoh bus."
COMMANDS = {
    "run": "palpate.run.command:run",
    "prepare": "palpate.run.command:prepare",
    "conduct": "palpate.run.command:conduct",
    "join": "palpate.run.places:join",
    "takeover": "palpate.run.places:takeover",
    "scenarios": "palpate.listings:scenarios",
    "topics": "palpate.listings:topics",
    "stop": "palpate.live.operator:stop",
    "release": "palpate.live.operator:release",
    "pause": "palpate.live.operator:pause",
    "resume": "palpate.live.operator:resume",
    "step": "palpate.live.operator:step",
    "dashboard": "palpate.live.dashboard:dashboard",
    "topic": "palpate.live.topic:app",
    "node": "palpate.live.node:app",
    "doctor": "palpate.live.doctor_command:doctor",
    "report": "palpate.report.command:report",
    "replay": "palpate.replay.command:replay",
    "check": "palpate.check.command:check_command",
    "keys": "palpate.security.keys:app",
    "router": "palpate.security.router:router",
    "fmu": "palpate.fmu:app",
    "bench": "palpate_benchmarks.bench_command:bench",
    "study": "palpate.study.command:app",
    "faults": "palpate_benchmarks.campaign_command:faults",
    "fuzz": "palpate.fuzz.command:fuzz",
    "validate": "palpate_validation.cli:app",
    "reproduce": "palpate_reproduction.command:reproduce",
}
"""The word of each command, and where it is: a function, or a Typer app of several commands."""


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
    """The app that has the command `word` alone, or all commands for a word that is not in the table."""
    app = typer.Typer(
        name="palpate",
        help=HELP,
        callback=_nothing,
        no_args_is_help=True,
        rich_markup_mode="rich",
        pretty_exceptions_show_locals=False,
    )
    for name in [word] if word in COMMANDS else COMMANDS:
        _add(app, name)
    return app


def _nothing() -> None:
    """With a callback, an app of one command still wants that command's name."""


def _add(app: typer.Typer, word: str) -> None:
    module, _, attribute = COMMANDS[word].partition(":")
    try:
        command = getattr(import_module(module), attribute)
    except ModuleNotFoundError as error:
        print(f"palpate: the command {word} needs the module {error.name}; pip install 'palpate[all]'", file=sys.stderr)
        return
    if isinstance(command, typer.Typer):
        app.add_typer(command, name=word)
    else:
        app.command(word)(command)
