"""Disk space: checked before a run and watched during it."""

from __future__ import annotations

import math
import shutil
import tempfile
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from palpate.run.folder import FolderError
from palpate.run.options import Record
from palpate_conductor.result import RunProgress, Tell
from palpate_models.frames import Array
from palpate_models.patterns.scan import scan_of
from palpate_models.scenario import Exam, Mode

MB = 1_000_000
REPORT_MB = 10
"""Report, page, map and evidence of a run, and its logs."""
RECORDED_MB_PER_S: Final[dict[Record, float]] = {"none": 0.0, "normal": 0.26, "full": 1.63}
"""Both recordings, a simulated second: of 79 s at full 129 MB, at normal 21 MB."""
LOW_MB = 20
"""With less than this left the recordings are about to stop."""
_BEFORE_AND_AFTER_S = 12.0
"""What an examination takes before its first descent and after its last."""
_TOUCH_S = 2.7
"""A touch before the scan, of which there is one in a square of `_TOUCH_EVERY_M`."""
_TOUCH_EVERY_M = 0.07
_DESCENT_S = 3.0
"""From one line to the next: lifting, going there, touching the skin and pressing."""
_POINT_S = 2.8
"""A point that is pressed by itself."""
_WAY_MPS = 0.17
"""Above the skin, from the end of a line to the beginning of the next."""
_MINUTE_S = 60.0


def expected_duration(exam: Exam) -> float:
    """About how long an examination takes, in simulated time [s]: a fit to examinations of several sizes."""
    scan = scan_of(exam, _flat)
    width, height = exam.region_m
    begin = _BEFORE_AND_AFTER_S + _TOUCH_S * math.ceil(width / _TOUCH_EVERY_M) * math.ceil(height / _TOUCH_EVERY_M)
    if exam.mode is Mode.POINT:
        return begin + _POINT_S * len(scan.targets)
    slide = sum(_length(line) for line in scan.lines)
    between = sum(_length(np.vstack((a[-1], b[0]))) for a, b in pairwise(scan.lines))
    if scan.joined:
        return begin + (slide + between) / exam.speed_mps + _DESCENT_S
    return begin + slide / exam.speed_mps + between / _WAY_MPS + _DESCENT_S * len(scan.lines)


def _length(points: Array) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def _flat(xy: Array) -> tuple[Array, Array]:
    """A surface without heights: a scan's length hardly depends on them."""
    return np.column_stack((xy, np.zeros(len(xy)))), np.tile((0.0, 0.0, 1.0), (len(xy), 1))


def expected_mb(exam: Exam, record: Record) -> float:
    """About what the results of an examination take on the disk [MB]."""
    return REPORT_MB + RECORDED_MB_PER_S[record] * expected_duration(exam)


def what_it_takes(exam: Exam, record: Record) -> str:
    """How long an examination takes and how much it writes, in words for its user."""
    seconds = expected_duration(exam)
    time = f"{seconds / _MINUTE_S:.0f} min" if seconds > 2 * _MINUTE_S else f"{seconds:.0f} s"
    return f"about {time} of simulated time, and up to {expected_mb(exam, record):.0f} MB of results (--record {record})"


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
