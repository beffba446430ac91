"""Generators of the reference pages: functions that return the Markdown of one page, named in docs/site.py."""

from collections.abc import Iterable, Sequence


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; `|` in cells is escaped."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(one_line(cell).replace("|", "\\|") for cell in row) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def one_line(text: str) -> str:
    """Return the text with line breaks and runs of spaces replaced by single spaces."""
    return " ".join(text.split())
