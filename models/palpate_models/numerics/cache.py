"""Results that take seconds to compute, kept in the user's cache folder under the hash of what they depend on."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Callable, Iterable
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

MOST_BYTES = 2_000_000_000
"""Beyond this, what was not used for longest is removed."""

_PARTIAL = ".part"
_STALE_S = 3600.0
"""A partial file that is so much older than the newest result was left by a process that was killed [s]."""


def folder() -> Path:
    """Where results are kept: `palpate/computed` in XDG_CACHE_HOME or ~/.cache."""
    root = os.environ.get("XDG_CACHE_HOME") or (Path.home() / ".cache")
    return Path(root) / "palpate" / "computed"


def content_key(kind: str, code: Iterable[Path], *parts: object) -> str:
    """A name for a result: a hash of its kind, of the source files that make it, and of what it depends on (arrays by bytes).

    A change of one of the files of `code` makes results anew.
    """
    key = hashlib.sha256(f"{kind} numpy {metadata.version('numpy')} scipy {metadata.version('scipy')}".encode())
    for path in code:
        key.update(path.read_bytes())
    for part in parts:
        if isinstance(part, np.ndarray):
            key.update(f"{part.dtype}{part.shape}".encode() + np.ascontiguousarray(part).tobytes())
        else:
            key.update(repr(part).encode() + b"\0")
    return f"{kind}-{key.hexdigest()[:32]}"


def remembered(key: str, compute: Callable[[], NDArray[Any]]) -> NDArray[Any]:
    """The array under `key`, computed when it is not there (or not readable); mapped into memory, read-only.

    A cache folder that cannot be written is no error: the array is then computed each time.
    """
    path = folder() / f"{key}.npy"
    with contextlib.suppress(OSError, ValueError, EOFError):
        found: NDArray[Any] = np.load(path, mmap_mode="r")
        with contextlib.suppress(OSError):
            os.utime(path)
        return found
    value = compute()
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=path.stem, suffix=_PARTIAL, delete=False) as file:
            partial = Path(file.name)
            try:
                np.save(file, value)
                file.close()
                partial.replace(path)
            finally:
                partial.unlink(missing_ok=True)
        _forget_oldest(path.parent)
    return value


def _forget_oldest(where: Path) -> None:
    kept = sorted(where.glob("*.npy"), key=lambda path: path.stat().st_mtime, reverse=True)
    for partial in where.glob(f"*{_PARTIAL}"):
        if kept and kept[0].stat().st_mtime - partial.stat().st_mtime > _STALE_S:
            partial.unlink(missing_ok=True)
    room = MOST_BYTES
    for path in kept:
        room -= path.stat().st_size
        if room < 0:
            path.unlink(missing_ok=True)
