"""Room on the disk: asked for before a run, watched during it, and done without at its end."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from palpate.run.folder import FolderError
from palpate_conductor.result import RunProgress, Tell
from palpate_models.scenario import Exam, Mode

MB = 1_000_000
REPORT_MB = 10
"""Report, page, map and evidence of a run, and its logs."""
RECORDED_MB_PER_S = 2.0
"""Both recordings, a simulated second: 88 MB of 50 s."""
LOW_MB = 20
"""With less than this left the recordings are about to stop."""
_BEFORE_AND_AFTER_S = 30.0
"""What an examination takes before its first line and after its last."""
_TURN_S = 2.0
"""From one line to the next."""
_POINT_S = 2.0
"""A point that is pressed by itself."""


def expected_duration(exam: Exam) -> float:
    """About how long an examination takes, in simulated time [s]."""
    width, height = exam.region_m
    lines = width / exam.spacing_m + 1
    if exam.mode is Mode.POINT:
        return _BEFORE_AND_AFTER_S + lines * (height / exam.spacing_m + 1) * _POINT_S
    return _BEFORE_AND_AFTER_S + lines * (height / exam.speed_mps + _TURN_S)


def check_room(folder: Path, exam: Exam, *, recorded: bool) -> None:
    """Raises FolderError when the disk of a folder has no room for the results of an examination."""
    needed = REPORT_MB + (RECORDED_MB_PER_S * expected_duration(exam) if recorded else 0.0)
    free = free_mb(folder)
    if free < needed:
        shorter = f"; without recordings (--no-record) {REPORT_MB} MB are enough" if recorded and free > REPORT_MB else ""
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
