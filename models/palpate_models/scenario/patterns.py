"""Scan patterns: functions of examination and perceived surface that return lines of targets."""

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np

from palpate_models.numerics.frames import Array, Ints
from palpate_models.scenario.schema import PATTERN, Exam
from palpate_plugins import PluginError

Surface = Callable[[Array], tuple[Array, Array]]
"""Perceived surface: maps xy in A [m], shape (n, 2), to points [m] and outward unit normals, both (n, 3), in A."""


class PatternLimits(NamedTuple):
    """Targets that a pattern may give, and the first touches."""

    max_targets: int = 20_000
    """Maximum number of targets, which already take hours."""
    outside_m: float = 0.001
    """Tolerance of targets outside of the examined region."""
    apart_m: float = 1e-4
    """Minimum distance of consecutive targets of a stroke."""
    touches_m: float = 0.07
    """Maximum spacing of the first touches, which determine offset, tilt and field of the surface correction."""


LIMITS: Final = PatternLimits()


class Scan(NamedTuple):
    """Lines of a scan, in order."""

    lines: Sequence[Array]
    """Targets of each line in the abdomen frame A [m], shape (k, 2), in visiting order. The indenter slides along a smooth
    curve through them, at depth, and lifts at the end; in mode `point` each target is pressed separately."""
    joined: bool = False
    """Stay in contact between the end of a line and the start of the next if they are close."""

    @property
    def targets(self) -> Array:
        """All targets in their order [m], shape (n, 2)."""
        return np.concatenate(self.lines)

    @property
    def line_of_target(self) -> Ints:
        """The line of each target, shape (n,)."""
        return np.repeat(np.arange(len(self.lines)), [len(line) for line in self.lines])


def scan_of(exam: Exam, surface: Surface) -> Scan:
    """Return the scan of the examination's pattern. Raises PluginError if it is unusable."""
    function = PATTERN.load(exam.pattern)
    try:
        made = function(exam, surface)
    except (Exception, SystemExit) as error:
        raise PATTERN.failure(exam.pattern, error) from error
    if not isinstance(made, Scan):
        raise PluginError(f"exam.pattern = {exam.pattern!r}: returned {type(made).__name__}, expected a Scan of {__name__}")
    lines = [np.asarray(line, dtype=np.float64) for line in made.lines]
    for k, line in enumerate(lines):
        if line.ndim != 2 or line.shape[1] != 2 or not len(line) or not np.isfinite(line).all():
            raise PluginError(f"exam.pattern = {exam.pattern!r}: line {k} has shape {line.shape}, expected finite (k, 2), k > 0")
    count = sum(map(len, lines))
    if not 0 < count <= LIMITS.max_targets:
        raise PluginError(f"exam.pattern = {exam.pattern!r}: {count} targets, expected 1 to {LIMITS.max_targets}")
    scan = Scan(lines, made.joined)
    off = np.abs(scan.targets - exam.centre_m) - np.array(exam.region_m) / 2
    if off.max() > LIMITS.outside_m:
        raise PluginError(f"exam.pattern = {exam.pattern!r}: targets lie up to {1e3 * off.max():.0f} mm outside of exam.region_m")
    for k, stroke in enumerate([scan.targets] if scan.joined else lines):
        steps = np.linalg.norm(np.diff(stroke, axis=0), axis=1)
        if len(steps) and steps.min() < LIMITS.apart_m:
            i = int(steps.argmin())
            where = "" if scan.joined else f" of line {k}"
            raise PluginError(
                f"exam.pattern = {exam.pattern!r}: targets {i} and {i + 1}{where} are both at {stroke[i].round(4).tolist()} m; "
                f"consecutive targets must be {1e3 * LIMITS.apart_m:g} mm apart"
            )
    return scan


def touch_centres(targets: Array) -> Array:
    """The centres of the cells for targets in frame A [m], shape (n, 2): shape (k, 2), in the order in which they are touched.

    They go to and fro, and end near the first target.
    """
    low, high = targets.min(axis=0), targets.max(axis=0)
    counts = np.maximum(1, np.ceil((high - low) / LIMITS.touches_m - 1e-9)).astype(int)
    columns, rows = (low[k] + (high[k] - low[k]) * (np.arange(counts[k]) + 0.5) / counts[k] for k in (0, 1))
    centres = np.array([(x, y) for j, y in enumerate(rows) for x in columns[:: -1 if j % 2 else 1]])
    if np.linalg.norm(centres[-1] - targets[0]) > np.linalg.norm(centres[0] - targets[0]):
        centres = centres[::-1]
    return centres


def lines(exam: Exam, _: Surface) -> Scan:
    """Lines in alternating directions, every second one first. The tool lifts at their ends, for a touch and a tare per line.

    Pressed skin recovers slowly, and a touch next to it would be too deep: the lines in between are pressed a minute later.
    """
    along = _upward(exam)
    return Scan(_there_and_back(along[::2] + along[1::2]))


def raster(exam: Exam, _: Surface) -> Scan:
    """All lines from the feet to the head; the tool lifts at their ends."""
    return Scan(_upward(exam))


def snake(exam: Exam, _: Surface) -> Scan:
    """Lines in alternating directions, joined in contact by arcs."""
    return Scan(_there_and_back(_upward(exam)), joined=True)


def search(exam: Exam, _: Surface) -> Scan:
    """All targets that a search may request."""
    return Scan(_there_and_back(_upward(exam)))


def stations(centre: float, length: float, spacing: float) -> Array:
    """Evenly spread coordinates [m] over `length` about `centre`, both ends included, at most `spacing` apart."""
    count = int(np.ceil(length / spacing - 1e-9)) + 1
    return np.linspace(centre - length / 2, centre + length / 2, count)


def lattice(exam: Exam) -> tuple[Array, Array]:
    """Stations of the region in A: x of the lines, y on a line [m]."""
    (cx, cy), (width, height) = exam.centre_m, exam.region_m
    return stations(cx, width, exam.spacing_m), stations(cy, height, exam.spacing_m)


def _upward(exam: Exam) -> list[Array]:
    x, y = lattice(exam)
    return list(np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1))


def _there_and_back(along: list[Array]) -> list[Array]:
    return [line[::-1] if k % 2 else line for k, line in enumerate(along)]
