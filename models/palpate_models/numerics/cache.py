"""Cache of slow computations in the user's cache folder, keyed by a hash of their inputs.

A file has the array in numpy's format, followed by the SHA-256 of it.
"""

import contextlib
import hashlib
import mmap
import os
import tempfile
from collections.abc import Callable, Iterable
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

MOST_BYTES = 2_000_000_000
"""Size limit; the least recently used results are removed."""

_PARTIAL = ".part"
_STALE_S = 3600.0
"""Partial files older than the newest result by this time [s] were left by killed processes."""


def folder() -> Path:
    """Return the cache folder: `palpate/computed` in XDG_CACHE_HOME or ~/.cache."""
    root = os.environ.get("XDG_CACHE_HOME") or (Path.home() / ".cache")
    return Path(root) / "palpate" / "computed"


def content_key(kind: str, code: Iterable[Path], *parts: object) -> str:
    """Return a key for a result: a hash of its kind, the source files `code`, and its inputs `parts` (arrays by bytes)."""
    key = hashlib.sha256(f"{kind} numpy {metadata.version('numpy')} scipy {metadata.version('scipy')}".encode())
    for path in code:
        key.update(path.read_bytes())
    for part in parts:
        if isinstance(part, np.ndarray):
            key.update(f"{part.dtype}{part.shape}".encode() + np.ascontiguousarray(part).tobytes())
        else:
            key.update(repr(part).encode() + b"\0")
    return f"{kind}-{key.hexdigest()[:32]}"


def remember(key: str, compute: Callable[[], NDArray[Any]]) -> NDArray[Any]:
    """Return the array under `key`, memory-mapped and read-only; compute it if it is missing or damaged.

    If the cache folder cannot be written, the array is computed each time.
    """
    path = folder() / f"{key}.npy"
    with contextlib.suppress(OSError, ValueError, EOFError):
        if _intact(path):
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
                file.flush()
                with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
                    digest = hashlib.sha256(content).digest()
                file.write(digest)
                file.close()
                partial.replace(path)
            finally:
                partial.unlink(missing_ok=True)
        _forget_oldest(path.parent)
    return value


def _intact(path: Path) -> bool:
    """Return True if a file ends with the SHA-256 of what precedes it. Raises OSError, ValueError."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content, memoryview(content) as view:
        end = len(view) - hashlib.sha256().digest_size
        with view[: max(end, 0)] as array, view[max(end, 0) :] as stored:
            return hashlib.sha256(array).digest() == stored


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
