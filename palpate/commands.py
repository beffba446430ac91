"""The table of commands. Only the module of the command that was asked for is imported: `palpate stop` must not wait for a
plotting library, and `palpate --help` imports none of them: it reads what each says of itself in its source.
"""

from __future__ import annotations

import ast
import shutil
import sys
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from inspect import getdoc
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from palpate.command_line import EXIT_BAD_INPUT, say

HELP = "A robot arm feels for lumps in a simulated abdomen. You can replace each part of it with a program of your own."
GROUPS = {
    "Examine": {
        "run": "palpate.run.command:run",
        "plan": "palpate.plan.command:plan",
        "scenarios": "palpate.listings:scenarios",
        "stop": "palpate.live.operator_command:stop",
        "release": "palpate.live.operator_command:release",
        "pause": "palpate.live.operator_command:pause",
        "resume": "palpate.live.operator_command:resume",
        "step": "palpate.live.operator_command:step",
    },
    "Look": {
        "dashboard": "palpate.live.dashboard:dashboard",
        "report": "palpate.report.command:report",
        "replay": "palpate.replay.command:replay",
        "doctor": "palpate.live.doctor_command:doctor",
        "topics": "palpate.listings:topics",
        "topic": "palpate.live.topic_command:app",
        "node": "palpate.live.node_command:app",
    },
    "Replace a part, or run in several places": {
        "check": "palpate.check.command:check_command",
        "join": "palpate.run.places:join",
        "takeover": "palpate.run.places:takeover",
        "fmu": "palpate.fmu:app",
        "keys": "palpate.security.keys_command:app",
        "router": "palpate.security.router_command:router",
        "prepare": "palpate.run.command:prepare",
        "conduct": "palpate.run.command:conduct",
    },
    "Measure": {
        "study": "palpate.study.command:app",
        "validate": "palpate_validation.cli:app",
        "reproduce": "palpate_reproduction.command:reproduce",
    },
    "Maintain": {
        "bench": "palpate_benchmarks.bench:bench",
        "faults": "palpate_benchmarks.campaign_command:faults",
        "fuzz": "palpate.fuzz.command:fuzz",
    },
}
"""The words of the commands by what they are for, and where each is: a function, or a Typer app of several commands."""
EXTRAS = {
    "dashboard": "dashboard",
    "fmu": "fmu",
    "study": "study",
    "validate": "bench",
    "reproduce": "bench",
    "bench": "bench",
    "faults": "bench",
    "fuzz": "bench",
}
"""Extras of the commands that need more than `run`."""
MARGIN = 1
"""Columns that Typer leaves free on each side of a command's help."""
INDENT = "  "
"""Of an example."""
COMMANDS = {word: where for group in GROUPS.values() for word, where in group.items()}


def main() -> None:
    """Runs the command of `sys.argv`."""
    word = sys.argv[1] if len(sys.argv) > 1 else ""
    try:
        app_for(word)(prog_name="palpate")
    except BrokenPipeError:
        sys.exit(1)
    except ModuleNotFoundError as error:  # of a library that the command imports late
        _lacking(word, error)
    except ValueError as error:
        from palpate_bus.settings import BusConfigError  # noqa: PLC0415 - it takes two seconds to import

        if not isinstance(error, BusConfigError):
            raise
        say(error)
        sys.exit(EXIT_BAD_INPUT)


def app_for(word: str, columns: int | None = None) -> typer.Typer:
    """The app that has the command `word` alone; for a word that is not in the table, one that can only list them all.

    Its help is laid out for so many columns, by default those of the terminal.
    """
    app = typer.Typer(
        name="palpate",
        help=HELP,
        callback=_options,
        no_args_is_help=True,
        rich_markup_mode="rich",
        pretty_exceptions_show_locals=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    if word in COMMANDS:
        _add(app, word, columns or shutil.get_terminal_size().columns)
        return app
    for group, commands in GROUPS.items():
        for name, where in commands.items():
            app.command(name, help=_summary(where), rich_help_panel=group)(_listed)
    return app


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"palpate {version('palpate')}")
        raise typer.Exit


def _options(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """With a callback, an app of one command still wants that command's name."""


def _listed() -> None:
    """Stands for a command in the list of commands."""


def _add(app: typer.Typer, word: str, columns: int) -> None:
    module, _, attribute = COMMANDS[word].partition(":")
    try:
        command = getattr(import_module(module), attribute)
    except ModuleNotFoundError as error:
        _lacking(word, error)
    except ValueError as error:  # a contract of your own that cannot be used
        print(f"palpate: {error}", file=sys.stderr)
        sys.exit(EXIT_BAD_INPUT)
    if isinstance(command, typer.Typer):
        for own in command.registered_commands:
            own.help = _flowing(own.callback, columns) or own.help
        app.add_typer(command, name=word)
    else:
        app.command(word, help=_flowing(command, columns))(command)


def _flowing(command: object, columns: int) -> str:
    """A command's docstring with each paragraph on a line of its own, for a terminal of any width to break, and its examples."""
    paragraphs = (getdoc(command) or "").split("\n\n")
    words = [part.replace("\n", " ") for part in paragraphs if not part.startswith(" ")]
    examples = [part.strip() for part in paragraphs if part.startswith(" ")]
    return "\n\n".join([*words, _examples(examples, columns)] if examples else words)


def _examples(examples: list[str], columns: int) -> str:
    """Commands with what each does beside it, or below it where so many columns are too few for that."""
    lines = [example.partition("  ")[::2] for example in examples]
    widest = max(len(line) for line, _ in lines)
    told = [(line, words.strip()) for line, words in lines]
    beside = [f"{INDENT}{line:<{widest}}  {words}".rstrip() for line, words in told]
    if max(map(len, beside)) <= columns - 2 * MARGIN:
        laid = beside
    else:
        laid = [part for line, words in told for part in (INDENT + line, *([3 * INDENT + words] if words else []))]
    return "\n".join(f"[dim][/]{line}" for line in laid)  # an empty style, since Typer takes the indentation of a paragraph away


def _lacking(word: str, error: ModuleNotFoundError) -> NoReturn:
    """Ends for a library that is not installed; raises the error again where it is one of our own modules that is not there."""
    if (error.name or "palpate").startswith("palpate"):
        raise error
    extra = EXTRAS.get(word, "run")
    print(f"palpate: the command {word} needs the module {error.name}; pip install 'palpate[{extra}]'", file=sys.stderr)
    sys.exit(EXIT_BAD_INPUT)


def _summary(where: str) -> str:
    """The first paragraph of a command's docstring, or the `help` of an app, read in the source of its module."""
    name, _, attribute = where.partition(":")
    package, _, rest = name.partition(".")
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        return "Not installed."
    source = Path(spec.origin).parent.joinpath(*rest.split(".")).with_suffix(".py")
    for node in ast.parse(source.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef) and node.name == attribute:
            return (ast.get_docstring(node) or "").partition("\n\n")[0]
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == attribute and isinstance(node.value, ast.Call):
            return next(str(ast.literal_eval(word.value)) for word in node.value.keywords if word.arg == "help")
    raise LookupError(f"{source}: no {attribute}")
