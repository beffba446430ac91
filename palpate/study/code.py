"""Which code makes a result: cases of different code are not to stand in one table unseen."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from palpate.run.roles import WORKERS

PACKAGES: Final = (
    "palpate.quick",
    "palpate.run",
    "palpate.truth",
    "palpate.report",
    "palpate_bus",
    "palpate_models",
    "palpate_conductor",
    "palpate_fmu",
    *(f"palpate_{role}" for role in WORKERS),
)
"""Packages whose code decides results."""
SUFFIXES: Final = (".py", ".yaml", ".csv", ".npz", ".c", ".h")


@cache
def code_digest() -> str:
    """SHA-256 over the files that decide results, by their place in the package: the same for every way to install them."""
    digest = hashlib.sha256()
    for name, path in sorted(_files()):
        digest.update(f"{name}\0{hashlib.sha256(path.read_bytes()).hexdigest()}\0".encode())
    return digest.hexdigest()


def _files() -> Iterator[tuple[str, Path]]:
    for package in PACKAGES:
        spec = find_spec(package)
        for root in map(Path, (spec.submodule_search_locations if spec else None) or ()):
            for path in root.rglob("*"):
                if path.suffix in SUFFIXES:
                    yield f"{package}/{path.relative_to(root).as_posix()}", path
            if package == "palpate_fmu":  # in a checkout its sources lie beside it
                for path in (root.parent / "src").glob("*.[ch]"):
                    yield f"{package}/src/{path.name}", path
