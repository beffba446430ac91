"""What the commands of `palpate` have in common: where they write, and how they end when they cannot go on."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import typer
from rich.console import Console
from rich.markup import escape


class SteadyConsole(Console):
    """A console whose reader may go away, as `head` does: then it shows no more, and nothing else ends for that."""

    def on_broken_pipe(self) -> None:
        """Says the rest to nobody."""
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), self.file.fileno())


EXIT_BAD_INPUT = 2
"""Nothing was started: what was asked for cannot be."""
EXIT_FAILED = 3
"""It was started, and did not come to a good end."""


def say(why: object) -> None:
    """Prints what is wrong, word for word."""
    SteadyConsole(stderr=True).print(f"[bold red]palpate:[/] {escape(str(why))}", highlight=False, soft_wrap=True)


def refuse(why: object) -> NoReturn:
    """Ends the command for bad input, before anything has started."""
    say(why)
    raise typer.Exit(EXIT_BAD_INPUT) from None


def fail(why: object) -> NoReturn:
    """Ends the command for what happened after its start."""
    say(why)
    raise typer.Exit(EXIT_FAILED) from None


def output_file(words: str, *names: str) -> typer.models.OptionInfo:
    """The option of a command for the file that it writes in the end; before it measures, the file's folder is made.

    `names` are the option's, where it has others than its parameter.
    """

    def check(path: Path | None) -> Path | None:
        if path is not None:
            _make(path.parent)
            if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
                raise typer.BadParameter(f"{path}: is no file that can be written")
        return path

    return _option(words, check, *names)


def output_folder(words: str, *names: str) -> typer.models.OptionInfo:
    """The option of a command for the folder that it writes into; it is made before anything is measured.

    `names` are the option's, where it has others than its parameter.
    """

    def check(path: Path | None) -> Path | None:
        if path is not None:
            _make(path)
            if not os.access(path, os.W_OK):
                raise typer.BadParameter(f"{path}: is no folder that can be written into")
        return path

    return _option(words, check, *names)


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise typer.BadParameter(f"{folder}: cannot be made a folder: {error.strerror}") from None


def _option(words: str, check: Callable[[Path | None], Path | None], *names: str) -> typer.models.OptionInfo:
    option: typer.models.OptionInfo = typer.Option(*names, help=words, callback=check)
    return option
