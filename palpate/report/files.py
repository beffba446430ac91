"""Files that others read: written whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer


@contextmanager
def drafted(path: Path) -> Iterator[Path]:
    """Where to write what takes the place of `path` in the end: readers have the old file or the new one, also after a kill."""
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield draft
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Writes a text file whole. Raises OSError."""
    with drafted(path) as draft:
        draft.write_text(text, encoding="utf-8")


def docs_option(name: str) -> Any:
    """The option `--docs` of a command; its file is looked at before anything is measured."""

    def check(path: Path | None) -> Path | None:
        if path is not None:
            _around(path, name)
        return path

    return typer.Option(help="Page in which the marked part is replaced; all rows go to a CSV file beside it.", callback=check)


def write_part(path: Path, name: str, text: str) -> None:
    """Replaces the part `name` of a document. Raises typer.BadParameter where it has none or cannot be written."""
    before, after = _around(path, name)
    try:
        write_text(path, f"{before}{text}{after}")
    except OSError as error:
        raise typer.BadParameter(str(error)) from None


def _around(path: Path, name: str) -> tuple[str, str]:
    begin, end = (f"<!-- palpate {name}: {word} -->\n" for word in ("begin", "end"))
    try:
        before, first, rest = path.read_text(encoding="utf-8").partition(begin)
    except (OSError, UnicodeDecodeError) as error:
        raise typer.BadParameter(f"{path}: {error}") from None
    _, last, after = rest.partition(end)
    if not (first and last):
        raise typer.BadParameter(f"{path} has no part to replace: it wants the lines {begin.strip()} and {end.strip()}")
    return before + begin, end + after
