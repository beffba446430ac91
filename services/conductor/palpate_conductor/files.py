"""Files that others read: written whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path


def write_text(path: Path, text: str) -> None:
    """Writes a text file; who reads it meanwhile, or after a power cut, has the old one or the new one. Raises OSError."""
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        draft.write_text(text, encoding="utf-8")
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def replace_part(path: Path, begin: str, end: str, text: str) -> None:
    """Puts `text` between the marks `begin` and `end` of a document. Raises ValueError where it has not both, and OSError."""
    before, first, rest = path.read_text(encoding="utf-8").partition(begin)
    _, last, after = rest.partition(end)
    if not (first and last):
        raise ValueError(f"{path} has no part to replace: it wants the lines {begin.strip()} and {end.strip()}")
    write_text(path, f"{before}{begin}{text}{end}{after}")
