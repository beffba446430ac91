"""A place in a live run that a process of its user takes: what `palpate join` and `palpate takeover` have in common."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from palpate_bus.runs import announcement as runs

Implementation = Annotated[str, typer.Option(help="An installed implementation, as in `--set <role>.implementation`.")]
OwnService = Annotated[Path | None, typer.Option(metavar="FILE.py", help="A service of one's own instead.")]
RunName = Annotated[str | None, typer.Option(help="Which run: its process id, or part of its name; by default the newest.")]


class PlaceError(ValueError):
    """A place that cannot be taken. Says why, and what can be done."""


def live_run(name: str | None) -> runs.Run:
    """The newest live run, or the newest that `name` means. Raises PlaceError that names those there are."""
    found = runs.matching(name)
    if not found:
        there = ", ".join(run.name for run in runs.live()) or "none"
        raise PlaceError(f"no run{f' {name}' if name else ''} is on; on this machine: {there}")
    return found[-1]


def become(words: Sequence[str], environment: Mapping[str, str]) -> NoReturn:
    """Replaces this process by that of a service: `words` start it, `environment` is added to this process's own."""
    program = sys.executable if words[0] == "python" else words[0]
    os.execvpe(program, [program, *words[1:]], {**os.environ, **environment})
