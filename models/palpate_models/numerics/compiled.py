"""Functions of numbers and arrays, compiled by numba: for loops that numpy cannot express without making arrays.

Compiled code is kept beside its source, or in NUMBA_CACHE_DIR, or in the user's cache; where none can be written to it is made
anew by every process. A function compiles at its first call, so a caller with a deadline calls it once beforehand.

numba compiles a function anew when its own file has changed. What it calls is compiled into it, and may stand in another file of
the package; so here all that is kept for a folder goes when any file of its package, sub-packages included, has changed. A
compiled function must not call one of another package, save those of `vectors.py`, which count as sources of every package.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

_F = TypeVar("_F", bound=Callable[..., Any])
STAMP = "palpate.stamp"
"""Beside the compiled code: which sources it was made of."""
_SHARED = Path(__file__).with_name("vectors.py")


def compiled(function: _F) -> _F:
    """Decorator. No fast math: the same inputs give the same bits. Division by zero gives infinity, as numpy does."""
    try:
        dispatcher = numba.njit(cache=True, error_model="numpy")(function)
    except RuntimeError:  # numba found no folder to keep the code in
        return cast("_F", numba.njit(error_model="numpy")(function))
    if dispatcher is not function:  # which it is where NUMBA_DISABLE_JIT is set
        with suppress(OSError):
            _renew(_package(Path(function.__code__.co_filename)), Path(str(dispatcher.stats.cache_path)))
    return cast("_F", dispatcher)


def _package(file: Path) -> Path:
    """The folder of the top package that a file belongs to; the file's own where it belongs to none."""
    folder = file.parent
    while (folder.parent / "__init__.py").is_file():
        folder = folder.parent
    return folder


@cache
def _renew(package: Path, kept: Path) -> None:
    """Removes what is kept of a package unless it was made of its sources as they are."""
    digest = sha256()
    for path in (*sorted(package.rglob("*.py")), _SHARED):
        digest.update(path.name.encode() + path.read_bytes())
    stamp = kept / STAMP
    if stamp.is_file() and stamp.read_text() == digest.hexdigest():
        return
    for index in kept.glob("*.nbi"):
        index.unlink(missing_ok=True)
    kept.mkdir(parents=True, exist_ok=True)
    stamp.write_text(digest.hexdigest())
