"""Functions of numbers and arrays, compiled by numba: for loops that numpy cannot express without making arrays.

Compiled code is kept beside its source, or in NUMBA_CACHE_DIR, or in the user's cache; where none can be written to it is made
anew by every process. A function compiles at its first call, so whoever has a deadline calls it once before.

numba compiles a function anew when its own file has changed. What it calls is compiled into it, and may stand in another file of
the package; so here it is compiled anew when any file beside its own is newer than what is kept.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

_F = TypeVar("_F", bound=Callable[..., Any])


def compiled(function: _F) -> _F:
    """Decorator. No fast math: the same inputs give the same bits. Division by zero gives infinity, as numpy does."""
    try:
        dispatcher = numba.njit(cache=True, error_model="numpy")(function)
    except RuntimeError:  # numba found no folder to keep the code in
        return cast("_F", numba.njit(error_model="numpy")(function))
    with suppress(OSError):
        _forget_stale(Path(function.__code__.co_filename), function.__qualname__, Path(str(dispatcher.stats.cache_path)))
    return cast("_F", dispatcher)


def _forget_stale(source: Path, name: str, kept: Path) -> None:
    newest = max(path.stat().st_mtime_ns for path in source.parent.glob("*.py"))
    for index in kept.glob(f"{source.stem}.{name}-*.nbi"):
        if index.stat().st_mtime_ns < newest:
            index.unlink(missing_ok=True)
