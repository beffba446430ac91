"""A results folder belongs to one run: it is refused when it holds anything, and locked while the run goes on."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from palpate_bus.implementations import ChoiceError
from palpate_bus.runs.run_name import FILE as RUN

LOCK = "run.lock"
"""The file whose lock the run holds; it names the process. The kernel drops the lock when the process ends, however it ends."""
OURS = frozenset({LOCK, RUN, "scenario.yaml"})
"""A folder that has none of these is no results folder, and is not removed."""


class FolderError(ValueError):
    """The folder cannot take the results of this run. Says why and what to do."""


def usual_folder(scenario: str) -> Path:
    """Where the results of a scenario of this name go unless it is said where."""
    return Path("out") / f"{scenario}-{datetime.now():%Y%m%d-%H%M%S}"


@contextmanager
def unless_begun(path: Path, begun: Callable[[], bool]) -> Iterator[None]:
    """Removes the folder again when Ctrl-C or a mistake ends what is within before it has `begun`: it holds no result then."""
    try:
        yield
    except BaseException:
        if not begun():
            shutil.rmtree(path, ignore_errors=True)
        raise


@contextmanager
def results_folder(path: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """Makes the folder, and holds its lock until the run is over. `overwrite` removes the results of an earlier run whole.

    It is removed when a service cannot be made, so that the same command works once the cause is mended. Raises ChoiceError then,
    and FolderError for a folder that another run is writing into, that is not empty, or that cannot be made.
    """
    if overwrite and path.is_dir() and any(path.iterdir()):
        if not any((path / name).exists() for name in OURS):
            raise FolderError(f"--out {path} --overwrite: it does not hold the results of a run, so it is not removed")
        with _locked(path):
            shutil.rmtree(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FolderError(f"--out {path}: cannot be made a folder: {error.strerror}") from None
    with _locked(path):
        if left := sorted(entry.name for entry in path.iterdir() if entry.name != LOCK):
            what = ", ".join(left[:3]) + (" and more" if len(left) > 3 else "")
            raise FolderError(f"--out {path}: there is {what} in it; name another folder, or --overwrite to remove it first")
        try:
            yield path
        except ChoiceError:
            shutil.rmtree(path, ignore_errors=True)
            raise


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    try:
        file = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise FolderError(f"--out {folder}: cannot be written into: {error.strerror}") from None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.read(file, 32).decode(errors="replace").strip() or "unknown"
        os.close(file)
        raise FolderError(f"--out {folder}: a run is writing into it (process {holder}); name another folder") from None
    try:
        os.ftruncate(file, 0)
        os.write(file, f"{os.getpid()}\n".encode())
        yield
    finally:
        with suppress(OSError):  # the folder may be gone, or read-only by now
            (folder / LOCK).unlink()
        os.close(file)
