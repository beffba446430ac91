"""Output of the tools: tables for people, JSON for programs."""

from __future__ import annotations

import json
from typing import Any

from rich.console import Console
from rich.table import Table

EXIT_TROUBLE = 1
WIDE = 140


def console() -> Console:
    """Standard output, wide where there is no terminal, so that tables stay whole in a pipe."""
    plain = Console(highlight=False)
    return plain if plain.is_terminal else Console(highlight=False, width=max(WIDE, plain.width))


def print_json(value: Any) -> None:
    """One JSON document on standard output."""
    print(json.dumps(value, indent=2), flush=True)


def print_line(value: Any) -> None:
    """One line of JSON, for streams."""
    print(json.dumps(value), flush=True)


def table(*columns: str) -> Table:
    """An empty table; a column that starts with `>` is for numbers."""
    made = Table(box=None, pad_edge=False, header_style="bold")
    for name in columns:
        made.add_column(name.lstrip(">"), justify="right" if name.startswith(">") else "left", overflow="fold")
    return made


def number(value: float | None, unit: str = "", digits: int = 4) -> str:
    """A figure with its unit; a dash for None."""
    return "-" if value is None else f"{value:.{digits}g}{' ' if unit else ''}{unit}"


def bandwidth(bytes_per_s: float) -> str:
    """Bytes a second in a unit that reads well."""
    for factor, unit in ((1e6, "MB/s"), (1e3, "kB/s")):
        if bytes_per_s >= factor:
            return f"{bytes_per_s / factor:.4g} {unit}"
    return f"{bytes_per_s:.0f} B/s"
