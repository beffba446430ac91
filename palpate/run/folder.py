"""A results folder belongs to one run: it is refused when it holds anything, and locked while the run goes on."""

from __future__ import annotations

import fcntl
import json
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Final

from palpate.run.options import Record
from palpate.run.outlook import Outlook, in_words
from palpate_bus.runs.run_name import FILE, LOCK, in_use, run_of
from palpate_bus.settings import RECORDING
from palpate_conductor.outcome import RunProgress, Tell
from palpate_errors import UserError
from palpate_models.scenario.schema import Exam

OF_A_RUN: Final = (
    *("run.json", "scenario.yaml", "plant.yaml", "exam.yaml", "bus.json", "logs", RECORDING, "recording.rrd"),
    *("evidence.npz", "samples.csv", "report.json", "report.html", "map.png"),
)
"""What a run leaves in its folder."""


class FolderError(UserError):
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


def apart(path: Path) -> Path | None:
    """Moves the results of an earlier run, if the folder holds any, into a folder within it, and returns that.

    It is named by when that run began, and by its name. Raises FolderError for a folder that a run is writing into.
    """
    if in_use(path):
        raise FolderError(f"--out {path}: a run is writing into it; name another folder")
    if not (run := run_of(path)):
        return None
    began = str(json.loads((path / FILE).read_text(encoding="utf-8")).get("began", ""))
    earlier = path / "-".join((re.sub(r"\D", "", began.partition("+")[0]), run))
    earlier.mkdir()
    for name in OF_A_RUN:
        with suppress(FileNotFoundError):
            (path / name).rename(earlier / name)
    return earlier


@contextmanager
def results_folder(path: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """Makes the folder, and holds its lock until the run is over.

    `overwrite` lays the results of an earlier run aside. They are removed once this run is over, and come back when it leaves no
    folder, as one does that could not begin. Raises FolderError for a folder that another run is writing into, that is not empty,
    or that cannot be made.
    """
    earlier = _laid_aside(path) if overwrite and path.is_dir() and any(path.iterdir()) else None
    try:
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FolderError(f"--out {path}: cannot be made a folder: {error.strerror}") from None
        with _locked(path):
            if left := sorted(entry.name for entry in path.iterdir() if entry.name != LOCK):
                what = ", ".join(left[:3]) + (" and more" if len(left) > 3 else "")
                raise FolderError(f"--out {path}: there is {what} in it; name another folder, or --overwrite to remove it first")
            yield path
    finally:
        if earlier is not None and path.exists():
            shutil.rmtree(earlier, ignore_errors=True)
        elif earlier is not None:
            earlier.rename(path)
            (path / LOCK).unlink(missing_ok=True)


def _laid_aside(path: Path) -> Path:
    """Where the results of an earlier run are now. Raises FolderError for a folder that holds none, or that cannot be moved."""
    if path.is_symlink() or not (run_of(path) or (path / LOCK).exists()):
        raise FolderError(f"--out {path} --overwrite: it does not hold the results of a run, so it is not removed")
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    with _locked(path):
        try:
            return path.rename(aside)
        except OSError as error:
            raise FolderError(f"--out {path} --overwrite: cannot be moved: {error.strerror}") from None


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


MB = 1_000_000
REPORT_MB = 10
"""Report, page, map and evidence of a run, and its logs."""
RECORDED_MB_PER_S: Final[dict[Record, float]] = {"none": 0.0, "normal": 0.3, "full": 2.5}
"""Both recordings, a simulated second: of 51 s at full 126 MB, at normal 15 MB."""
LOW_MB = 20
"""With less than this left the recordings are about to stop."""


def expected_mb(exam: Exam, record: Record) -> float:
    """About what the results of an examination take on the disk [MB]."""
    return REPORT_MB + RECORDED_MB_PER_S[record] * Outlook.of(exam).duration_s


def what_it_takes(exam: Exam, record: Record) -> str:
    """How long an examination takes and how much it writes, in words for its user."""
    about = "at most" if exam.searched else "about"
    time = in_words(Outlook.of(exam).duration_s)
    return f"{about} {time} of simulated time, and up to {expected_mb(exam, record):.0f} MB of results (--record {record})"


def megabytes_of(folder: Path) -> float:
    """What a folder holds [MB]."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / MB


def check_room(folder: Path, exam: Exam, record: Record) -> None:
    """Raises FolderError when the disk of a folder has no room for the results of an examination."""
    needed, free = expected_mb(exam, record), free_mb(folder)
    if free < needed:
        shorter = (
            f"; without recordings (--record none) {REPORT_MB} MB are enough" if record != "none" and free > REPORT_MB else ""
        )
        raise FolderError(f"--out {folder}: {free:.0f} MB are free there, and this run needs about {needed:.0f} MB{shorter}")


def free_mb(folder: Path) -> float:
    """Megabytes that can be written into a folder; 0 when it is gone."""
    try:
        return shutil.disk_usage(folder).free / MB
    except OSError:
        return 0.0


class WatchedRoom:
    """Passes on what a run tells, and says once when the disk of its results is nearly full."""

    def __init__(self, folder: Path, tell: Tell, warn: Callable[[str], None]) -> None:
        self._folder, self._tell, self._warn = folder, tell, warn
        self._told = False

    def tell(self, progress: RunProgress) -> None:
        """Passes it on."""
        if not self._told and (left := free_mb(self._folder)) < LOW_MB:
            self._told = True
            self._warn(f"{self._folder}: {left:.0f} MB are left there: recordings will stop, the examination goes on")
        self._tell(progress)


def another_folder() -> Path:
    """A new folder for the results that their own folder does not take."""
    return Path(tempfile.mkdtemp(prefix="palpate-results-"))
