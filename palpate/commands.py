"""The table of commands.

Only the module of the requested command is imported: `palpate stop` does not wait for a plotting library. `palpate --help`
imports none of them: it reads their docstrings from the source.
"""

import ast
import shutil
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from inspect import getdoc
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from palpate.console import CommandGroup, lost_output, output, reserve_output, say
from palpate_errors import ExitStatus, UserError
from palpate_plugins import missing_libraries, needs

HELP = "A robot arm feels for lumps in a simulated abdomen. You can replace each part of it with a program of your own."
GROUPS = {
    "Examine": {
        "run": "palpate.run.command:run",
        "plan": "palpate.plan:plan",
        "scenarios": "palpate.listings:scenarios",
        "stop": "palpate.live.operator:stop",
        "release": "palpate.live.operator:release",
        "pause": "palpate.live.operator:pause",
        "resume": "palpate.live.operator:resume",
        "step": "palpate.live.operator:step",
    },
    "Assess recordings of other robots": {"assess": "palpate.recording.command:assess"},
    "Look": {
        "dashboard": "palpate.live.dashboard:dashboard",
        "report": "palpate.report.command:report",
        "replay": "palpate.replay.command:replay",
        "compare": "palpate.comparison.command:compare",
        "fit": "palpate.twin.command:fit",
        "perceive": "palpate.perceive:perceive",
        "doctor": "palpate.live.doctor:doctor",
        "topics": "palpate.listings:topics",
        "topic": "palpate.live.topic:app",
        "node": "palpate.live.bus:app",
    },
    "Replace a part, or run in several places": {
        "arm": "palpate.arm.command:app",
        "check": "palpate.check.command:check_command",
        "join": "palpate.run.places:join",
        "takeover": "palpate.run.places:takeover",
        "fmu": "palpate.fmu:app",
        "keys": "palpate.security:app",
        "router": "palpate.security:router",
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
        "faults": "palpate_benchmarks.faults:faults",
        "fuzz": "palpate.fuzz.fuzz:fuzz",
    },
}
"""Module and attribute of each command, by group: a function, or a Typer app of several commands."""
EXTRAS = {
    **{"dashboard": "dashboard", "fmu": "fmu", "study": "study"},
    **dict.fromkeys(("assess", "compare", "fit"), "library"),
    **dict.fromkeys(("validate", "reproduce", "bench", "faults", "fuzz"), "bench"),
}
"""Extra with the libraries of a command that the extra `run` does not install."""
HELP_OPTIONS = ["-h", "--help"]
MARGIN = 1
"""Columns that Typer leaves free on each side of the help."""
INDENT = "  "
COMMANDS = {name: where for group in GROUPS.values() for name, where in group.items()}


def main() -> None:
    """Run the command of `sys.argv`."""
    sys.stdout, sys.stderr = output(sys.stdout), output(sys.stderr)
    try:
        _run()
        sys.exit()
    except SystemExit as left:
        if (reason := lost_output()) and not left.code:
            say(f"the output could not be written: {reason}; all else was done")
            sys.exit(ExitStatus.TROUBLE)
        raise


def _run() -> None:
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if "--json" in sys.argv:
        reserve_output()
    try:
        _check_libraries(name)
        app_for(name)(prog_name="palpate")
    except BrokenPipeError:
        sys.exit(ExitStatus.TROUBLE)
    except ModuleNotFoundError as error:  # of a library that the command imports late
        _exit_for_missing(name, error)
    except UserError as error:  # a setting or contract that cannot be used, found when the command is imported
        say(error)
        sys.exit(ExitStatus.BAD_INPUT)


def app_for(name: str, columns: int | None = None) -> typer.Typer:
    """Return a Typer app with only the command `name`; an unknown name gives an app that lists all commands.

    `columns`: width of the help, by default that of the terminal.
    """
    app = typer.Typer(
        name="palpate", cls=CommandGroup, help=HELP, callback=_options, no_args_is_help=True, rich_markup_mode="rich",
        pretty_exceptions_show_locals=False, context_settings={"help_option_names": HELP_OPTIONS},
    )  # fmt: skip
    if name in COMMANDS:
        _add(app, name, columns or shutil.get_terminal_size().columns)
        return app
    for group, commands in GROUPS.items():
        for listed, where in commands.items():
            app.command(listed, help=_summary(where), rich_help_panel=group)(_placeholder)
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
    """Callback of the app: with it, an app of one command still requires that command's name."""


def _placeholder() -> None:
    """Placeholder for a command in the list of commands."""


def _add(app: typer.Typer, name: str, columns: int) -> None:
    module, _, attribute = COMMANDS[name].partition(":")
    try:
        command = getattr(import_module(module), attribute)
    except ModuleNotFoundError as error:
        _exit_for_missing(name, error)
    if isinstance(command, typer.Typer):
        for own in command.registered_commands:
            own.help = _flowing(own.callback, columns) or own.help
        app.add_typer(command, name=name)
    else:
        app.command(name, help=_flowing(command, columns))(command)


def _flowing(command: object, columns: int) -> str:
    """Return a command's docstring with one line per paragraph, which the terminal breaks, and its examples."""
    paragraphs = (getdoc(command) or "").split("\n\n")
    words = [part.replace("\n", " ") for part in paragraphs if not part.startswith(" ")]
    examples = [part.strip() for part in paragraphs if part.startswith(" ")]
    return "\n\n".join([*words, _examples(examples, columns)] if examples else words)


def _examples(examples: list[str], columns: int) -> str:
    """Return example commands with their explanations next to them, or below them if `columns` are too few."""
    pairs = [(line, text.strip()) for line, _, text in (example.partition("  ") for example in examples)]
    widest = max(len(line) for line, _ in pairs)
    rows = [f"{INDENT}{line:<{widest}}  {text}".rstrip() for line, text in pairs]
    if max(map(len, rows)) > columns - 2 * MARGIN:
        rows = [part for line, text in pairs for part in (INDENT + line, *([3 * INDENT + text] if text else []))]
    return "\n".join(f"[dim][/]{row}" for row in rows)  # an empty style, since Typer strips the indentation of a paragraph


def _exit_for_missing(name: str, error: ModuleNotFoundError) -> NoReturn:
    """Exit if a library is not installed. Raises the error again for a missing module of Palpate."""
    if (error.name or "palpate").startswith("palpate"):
        raise error
    _refuse_without((str(error.name),), name)


def _check_libraries(name: str) -> None:
    """Exit if a library of the command's extra is not installed, before anything is measured. Its help needs none."""
    helps = not {*HELP_OPTIONS}.isdisjoint(sys.argv)
    if name in EXTRAS and not helps and (missing := missing_libraries(EXTRAS[name])):
        _refuse_without(missing, name)


def _refuse_without(missing: Sequence[str], name: str) -> NoReturn:
    print(f"palpate: the command {name} {needs(missing, EXTRAS.get(name, 'run'))}", file=sys.stderr)
    sys.exit(ExitStatus.BAD_INPUT)


def _summary(where: str) -> str:
    """Return the first paragraph of a command's docstring, or the `help` of an app, from the source of its module."""
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
