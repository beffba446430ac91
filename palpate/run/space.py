"""Disk space: checked before a run and watched during it."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Final

from palpate.run.folder import FolderError
from palpate.run.options import Record
from palpate.run.outlook import Outlook, in_words
from palpate_conductor.result import RunProgress, Tell
from palpate_models.scenario.schema import Exam

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
