"""Functions compiled by numba, for loops that numpy cannot express without temporary arrays.

Compiled code is cached next to its source, in NUMBA_CACHE_DIR, or in the user's cache; without a writable folder every process
compiles again. A function compiles at its first call, so callers with a deadline call it once in advance.

numba recompiles a function if its own file has changed, but not if a function that it calls has. Therefore the cache of a package
is cleared if any of its files has changed. A compiled function must not call one of another package, except `vectors.py`, which
counts as a source of every package.
"""

import pickle
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core.caching import IndexDataCacheFile

_F = TypeVar("_F", bound=Callable[..., Any])
STAMP = "palpate.stamp"
"""File next to the compiled code with the digest of its sources."""
DIGEST_BYTES = 32
_SHARED = Path(__file__).with_name("vectors.py")


def compiled(function: _F) -> _F:
    """Compile a function. No fast math: equal inputs give equal bits. Division by zero gives infinity, as in numpy."""
    try:
        dispatcher = numba.njit(cache=True, error_model="numpy")(function)
    except RuntimeError:  # numba found no writable cache folder
        return cast("_F", numba.njit(error_model="numpy")(function))
    if dispatcher is not function:  # the same object if NUMBA_DISABLE_JIT is set
        cast("Any", dispatcher)._cache._cache_file.__class__ = _CheckedFile
        with suppress(OSError):
            _renew(_package(Path(function.__code__.co_filename)), Path(str(dispatcher.stats.cache_path)))
    return cast("_F", dispatcher)


class _CheckedFile(IndexDataCacheFile):
    """Index and code of a function on the disk, each with its SHA-256. A damaged file is compiled again."""

    def _dump(self, obj: object) -> bytes:
        content: bytes = super()._dump(obj)  # type: ignore[no-untyped-call]
        return sha256(content).digest() + content

    def _load_index(self) -> dict[Any, str]:
        with suppress(Exception), Path(self._index_path).open("rb") as file:  # what a damaged pickle raises cannot be listed
            if pickle.load(file) == self._version:
                stamp, overloads = _load(file.read())
                return dict(overloads) if stamp == self._source_stamp else {}
        return {}

    def _load_data(self, name: str) -> Any:
        return _load(Path(self._data_path(name)).read_bytes())  # type: ignore[no-untyped-call]


def _load(stored: bytes) -> Any:
    """Return the content of a file. Raises OSError, which numba takes for a missing file, if it is damaged."""
    digest, content = stored[:DIGEST_BYTES], stored[DIGEST_BYTES:]
    if sha256(content).digest() != digest:
        raise OSError("damaged")
    return pickle.loads(content)


def _package(file: Path) -> Path:
    """Return the folder of a file's top-level package, or the file's folder if it is in none."""
    folder = file.parent
    while (folder.parent / "__init__.py").is_file():
        folder = folder.parent
    return folder


@cache
def _renew(package: Path, kept: Path) -> None:
    """Clear the cache of a package if its sources have changed."""
    digest = sha256()
    for path in (*sorted(package.rglob("*.py")), _SHARED):
        digest.update(path.name.encode() + path.read_bytes())
    stamp = kept / STAMP
    if stamp.is_file() and stamp.read_bytes() == digest.hexdigest().encode():
        return
    for index in kept.glob("*.nbi"):
        index.unlink(missing_ok=True)
    kept.mkdir(parents=True, exist_ok=True)
    stamp.write_text(digest.hexdigest())
