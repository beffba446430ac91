"""What an examination will be: how long it takes, how often it touches the skin before, what it presses."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_models.scenario.patterns import Scan, scan_of, touch_centres
from palpate_models.scenario.schema import Exam, Mode

_BEFORE_AND_AFTER_S = 12.0
"""What an examination takes before its first descent and after its last."""
_TOUCH_S = 2.7
"""A touch before the scan."""
_DESCENT_S = 3.0
"""From one line to the next: lifting, going there, touching the skin and pressing."""
_POINT_S = 2.8
"""A point that is pressed by itself."""
_SEARCHED_S = 4.0
"""A press of a search, which goes further for it."""
_WAY_MPS = 0.17
"""Above the skin, from the end of a line to the beginning of the next."""
_MINUTE_S = 60.0


@dataclass(frozen=True)
class Outlook:
    """What is expected of an examination before it starts."""

    duration_s: float
    """About how long it takes, in simulated time [s]; of a search, which ends when it is sure, the longest."""
    touches: int
    """How often the skin is touched before the scan."""
    lines: int
    """Scan lines."""
    presses: int
    """Targets that are pressed; of a search, the most presses that it may make."""

    @staticmethod
    def of(exam: Exam) -> Outlook:
        """That of an examination: the duration is a fit to examinations of several sizes."""
        scan = scan_of(exam, _flat)
        touches = len(touch_centres(scan.targets))
        presses = exam.budget.presses if exam.searched else len(scan.targets)
        duration = _BEFORE_AND_AFTER_S + _TOUCH_S * touches + _pressing_s(exam, scan)
        return Outlook(duration, touches, len(scan.lines), presses)


def _pressing_s(exam: Exam, scan: Scan) -> float:
    if exam.searched:
        return min(_SEARCHED_S * exam.budget.presses, exam.budget.seconds)
    if exam.mode is Mode.POINT:
        return _POINT_S * len(scan.targets)
    slide = sum(_length(line) for line in scan.lines)
    between = sum(_length(np.vstack((a[-1], b[0]))) for a, b in pairwise(scan.lines))
    if scan.joined:
        return (slide + between) / exam.speed_mps + _DESCENT_S
    return slide / exam.speed_mps + between / _WAY_MPS + _DESCENT_S * len(scan.lines)


def _length(points: Array) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def _flat(xy: Array) -> tuple[Array, Array]:
    """A surface without heights: a scan's length hardly depends on them."""
    return np.column_stack((xy, np.zeros(len(xy)))), np.tile((0.0, 0.0, 1.0), (len(xy), 1))


def in_words(seconds: float) -> str:
    """A duration as one says it: `40 s`, `3 min`."""
    return f"{seconds / _MINUTE_S:.0f} min" if seconds > 2 * _MINUTE_S else f"{seconds:.0f} s"
