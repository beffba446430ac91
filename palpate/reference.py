"""Pages of reference that are made from the code: `python -m palpate.reference` writes commands.md and messages.md."""

from __future__ import annotations

import re
from collections.abc import Iterator
from inspect import cleandoc
from pathlib import Path
from typing import Any

import typer

from palpate.commands import GROUPS, app_for
from palpate_bus.messages.typestore import palpation_definitions

FOLDER = Path("docs/reference")
_COMMANDS = """# Commands

Made from the commands themselves by `make docs`. `palpate COMMAND -h` says the same in the terminal.
"""
_MESSAGES = """# Messages

Made by `make docs` from the definitions in [`bus/palpation_msgs/msg`](../../bus/palpation_msgs/msg). Messages of other packages
(`std_msgs`, `geometry_msgs`, `sensor_msgs`, `nav_msgs`, `tf2_msgs`, `diagnostic_msgs`) are those of ROS 2 Jazzy. Which topic
carries which message, how often and in which frame: [topics](../topics.md).
"""

PAGE_COLUMNS = 200
"""Of an example on the page, with what it does beside it."""


def commands_page() -> str:
    """Every command with its arguments and options."""
    parts = [_COMMANDS]
    for group, words in GROUPS.items():
        parts.append(f"## {group}\n")
        for word in words:
            for path, command in walked(typer.main.get_command(app_for(word, PAGE_COLUMNS))):
                parts += _command(path, command)
    return "\n".join(parts).rstrip() + "\n"


def walked(command: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """A command of Typer, or those within it, each with its words."""
    if getattr(command, "commands", None):
        for name, inner in command.commands.items():
            yield from walked(inner, f"{path} {name}".strip())
    else:
        yield path, command


def _command(path: str, command: Any) -> Iterator[str]:
    told = re.sub(r"\[/?(?:bold|dim)?\]", "", cleandoc(command.help or ""))
    words, *examples = re.split(r"^Examples?\n", told, maxsplit=1, flags=re.MULTILINE)
    yield f"### palpate {path}\n"
    yield words.strip() + "\n"
    if examples:
        yield "\n".join(f"    {line.strip()}" for line in examples[0].splitlines() if line.strip()) + "\n"
    rows = [row for parameter in command.params if (row := _parameter(parameter))]
    if rows:
        yield "| argument or option | default | meaning |\n|---|---|---|"
        yield "\n".join(rows) + "\n"


def _parameter(parameter: Any) -> str:
    """A row of the table, for an argument or an option."""
    if "--help" in parameter.opts or "--install-completion" in parameter.opts or "--show-completion" in parameter.opts:
        return ""
    names = parameter.opts + parameter.secondary_opts
    name = f"`{parameter.name.upper()}`" if parameter.param_type_name == "argument" else ", ".join(f"`{word}`" for word in names)
    default = parameter.default
    shown = "" if default in (None, False) or callable(default) else f"`{default}`"
    text = " ".join(str(getattr(parameter, "help", "") or "").split()).replace("|", "\\|").replace("<", "&lt;")
    return f"| {name} | {shown} | {text} |"


def messages_page() -> str:
    """Every message of ours with its fields."""
    parts = [_MESSAGES]
    for name, text in palpation_definitions().items():
        parts += _message(name.rpartition("/")[2], text)
    return "\n".join(parts).rstrip() + "\n"


def _message(name: str, text: str) -> Iterator[str]:
    about: list[str] = []
    rows: list[list[str]] = []
    for line in text.splitlines():
        field, _, comment = (part.strip() for part in line.partition("#"))
        if not field and comment and not rows:
            about.append(comment)
        elif not field and comment:
            rows[-1][2] = f"{rows[-1][2]} {comment}".strip()
        elif field:
            kind, _, rest = field.partition(" ")
            rows.append([rest.strip(), kind, comment])
    yield f"## {name}\n"
    yield " ".join(about) + "\n"
    yield "| field | type | meaning, [unit] |\n|---|---|---|"
    yield "\n".join(f"| `{name}` | `{kind}` | {meaning.replace('|', chr(92) + '|')} |" for name, kind, meaning in rows) + "\n"


def main() -> None:
    """Writes the pages into the working folder's docs/reference."""
    (FOLDER / "commands.md").write_text(commands_page(), encoding="utf-8")
    (FOLDER / "messages.md").write_text(messages_page(), encoding="utf-8")


if __name__ == "__main__":
    main()
