"""What a scan pattern is: a function from what is to be examined, and the surface as it is seen, to lines of points to feel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from palpate_models.frames import Array
from palpate_models.pattern_choice import PATTERN, PatternError
from palpate_models.scenario import Exam

Surface = Callable[[Array], tuple[Array, Array]]
"""The surface as it is seen: of xy in A [m], shape (n, 2), the points [m] and the outward unit normals, both (n, 3), in A."""
LARGEST: Final = 20_000
"""More targets than this take hours."""
OUTSIDE_M: Final = 0.001
"""Targets may lie so far outside of the region, which alone the camera is asked to see."""


@dataclass(frozen=True)
class Scan:
    """The lines of a scan, in their order."""

    lines: Sequence[Array]
    """Targets of each line in the abdomen frame A [m], shape (k, 2), in the order in which they are visited. The indenter slides
    along a smooth curve through them, at depth, and lifts at the end; in mode `point` each target is pressed by itself."""
    joined: bool = False
    """Whether it stays in contact from the end of a line to the beginning of the next, where these are near each other."""

    @property
    def targets(self) -> Array:
        """All targets in their order [m], shape (n, 2)."""
        return np.concatenate(self.lines)

    @property
    def line_of_target(self) -> NDArray[np.int64]:
        """The line of each target, shape (n,)."""
        return np.repeat(np.arange(len(self.lines)), [len(line) for line in self.lines])


def scan_of(exam: Exam, surface: Surface) -> Scan:
    """The scan that the examination's pattern makes. Raises PatternError for one that cannot be used, with what is wrong."""
    function = PATTERN.load(exam.pattern)
    try:
        made = function(exam, surface)
    except Exception as error:
        raise PatternError(PATTERN.told(exam.pattern, error)) from error
    if not isinstance(made, Scan):
        raise PatternError(f"exam.pattern = {exam.pattern!r}: returned {type(made).__name__}, want a Scan of {__name__}")
    lines = [np.asarray(line, dtype=np.float64) for line in made.lines]
    for k, line in enumerate(lines):
        if line.ndim != 2 or line.shape[1] != 2 or not len(line) or not np.isfinite(line).all():
            raise PatternError(f"exam.pattern = {exam.pattern!r}: line {k} has the shape {line.shape}, want finite (k, 2), k > 0")
    count = sum(map(len, lines))
    if not 0 < count <= LARGEST:
        raise PatternError(f"exam.pattern = {exam.pattern!r}: {count} targets, want 1 to {LARGEST}")
    scan = Scan(lines, made.joined)
    off = np.abs(scan.targets - exam.centre_m) - np.array(exam.region_m) / 2
    if off.max() > OUTSIDE_M:
        raise PatternError(
            f"exam.pattern = {exam.pattern!r}: targets lie up to {1e3 * off.max():.0f} mm outside of exam.region_m"
        )
    return scan
