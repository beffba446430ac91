"""docs/reference/commands.md, from the commands."""

import re
from collections.abc import Iterator
from inspect import cleandoc
from typing import Any

import typer

from palpate.commands import GROUPS, app_for

_COMMANDS = """# Commands

Generated from the commands by `make docs`. `palpate COMMAND -h` prints the same in the terminal.
"""

PAGE_COLUMNS = 200
"""Width of an example with its explanation."""


def page() -> str:
    """Return the page: every command with its arguments and options."""
    parts = [_COMMANDS]
    for group, words in GROUPS.items():
        parts.append(f"## {group}\n")
        for word in words:
            for path, command in walk(typer.main.get_command(app_for(word, PAGE_COLUMNS))):
                parts += _command(path, command)
    return "\n".join(parts).rstrip() + "\n"


def walk(command: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield a Typer command, or its subcommands, each with its path."""
    if getattr(command, "commands", None):
        for name, inner in command.commands.items():
            yield from walk(inner, f"{path} {name}".strip())
    else:
        yield path, command


def _command(path: str, command: Any) -> Iterator[str]:
    text = re.sub(r"\[/?(?:bold|dim)?\]", "", cleandoc(command.help or ""))
    words, *examples = re.split(r"^Examples?\n", text, maxsplit=1, flags=re.MULTILINE)
    yield f"### palpate {path}\n"
    yield words.strip() + "\n"
    if examples:
        yield "\n".join(f"    {line.strip()}" for line in examples[0].splitlines() if line.strip()) + "\n"
    rows = [row for parameter in command.params if (row := _parameter(parameter))]
    if rows:
        yield "| argument or option | default | meaning |\n|---|---|---|"
        yield "\n".join(rows) + "\n"


def _parameter(parameter: Any) -> str:
    """Return the table row of an argument or option."""
    if "--help" in parameter.opts or "--install-completion" in parameter.opts or "--show-completion" in parameter.opts:
        return ""
    names = parameter.opts + parameter.secondary_opts
    name = f"`{parameter.name.upper()}`" if parameter.param_type_name == "argument" else ", ".join(f"`{word}`" for word in names)
    default = parameter.default
    shown = "" if default in (None, False) or callable(default) else f"`{default}`"
    text = " ".join(str(getattr(parameter, "help", "") or "").split()).replace("|", "\\|").replace("<", "&lt;")
    return f"| {name} | {shown} | {text} |"
