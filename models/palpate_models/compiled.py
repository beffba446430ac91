"""Functions of numbers and arrays, compiled by numba: for loops that numpy cannot express without making arrays.

Compiled code is kept beside its source, or in NUMBA_CACHE_DIR, or in the user's cache; where none can be written to it is made
anew by every process. A function compiles at its first call, so whoever has a deadline calls it once before.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

_F = TypeVar("_F", bound=Callable[..., Any])


def compiled(function: _F) -> _F:
    """Decorator. No fast math: the same inputs give the same bits. Division by zero gives infinity, as numpy does."""
    try:
        return cast("_F", numba.njit(cache=True, error_model="numpy")(function))
    except RuntimeError:  # numba found no folder to keep the code in
        return cast("_F", numba.njit(error_model="numpy")(function))
