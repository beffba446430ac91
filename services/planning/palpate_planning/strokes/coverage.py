"""Coverage: from the lines of a scan pattern to strokes, each a smooth curve in the abdomen's xy plane.

A stroke is a line; where the pattern joins its lines, they are one stroke with arcs in between. In mode point each target is a
stroke. A skipped target ends a stroke: the arm must not slide over what it cannot reach. So does a break: the path between two
reachable targets may be out of reach.
"""

from collections.abc import Set
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from palpate_models.numerics.frames import Array, Ints, Mask
from palpate_models.scenario.patterns import touch_centres
from palpate_models.scenario.schema import Mode


class CoverageTuning(NamedTuple):
    """Sampling and joining of scan lines."""

    sample_m: float = 0.002
    """Spacing of the samples of a stroke."""
    join_spacings: float = 2.5
    """Line ends farther apart than this many spacings are not joined in contact."""


TUNING = CoverageTuning()


class Stroke(NamedTuple):
    """A curve to follow at depth. A single sample is a point to indent."""

    xy: Array
    """Samples in frame A [m], about `TUNING.sample_m` apart, shape (n, 2)."""
    targets: Ints
    """Indices of the targets that it visits, in order, shape (m,)."""
    visits: Ints
    """Sample at which each of them is reached, shape (m,)."""
    touch: bool = False
    """True if the wall is only touched, not pressed."""


def line_through(points: Array) -> tuple[Array, Ints]:
    """Return a chord-length spline through points, shape (k, 2): samples (n, 2), and the sample of each point."""
    if len(points) == 1:
        return points.copy(), np.zeros(1, dtype=np.int64)
    chords = np.maximum(np.linalg.norm(np.diff(points, axis=0), axis=1), 1e-6)
    knots = np.concatenate(([0.0], np.cumsum(chords)))
    counts = np.maximum(1, np.round(chords / TUNING.sample_m).astype(int))
    u = np.concatenate([np.linspace(a, b, k, endpoint=False) for (a, b), k in zip(pairwise(knots), counts, strict=True)])
    u = np.append(u, knots[-1])
    curve = CubicSpline(knots, points, bc_type="natural") if len(points) > 2 else None
    xy = curve(u) if curve else points[0] + (points[1] - points[0]) * (u / knots[-1])[:, None]
    return np.asarray(xy), np.concatenate(([0], np.cumsum(counts))).astype(np.int64)


def arc(p0: Array, t0: Array, p1: Array, t1: Array) -> Array:
    """Return inner samples, shape (n, 2), of the curve from p0, left along unit t0, to p1, entered along unit t1.

    A cubic Bezier with handles of 2/3 of the gap: for two opposite tangents across the gap it is a semicircle to 2 %.
    """
    gap = float(np.linalg.norm(p1 - p0))
    b1, b2 = p0 + t0 * (2 / 3 * gap), p1 - t1 * (2 / 3 * gap)
    length = 0.5 * (gap + float(np.linalg.norm(b1 - p0) + np.linalg.norm(b2 - b1) + np.linalg.norm(p1 - b2)))
    u = np.linspace(0.0, 1.0, max(2, round(length / TUNING.sample_m)) + 1)[1:-1, None]
    return np.asarray((1 - u) ** 3 * p0 + 3 * u * (1 - u) ** 2 * b1 + 3 * u**2 * (1 - u) * b2 + u**3 * p1)


def _runs(lines: Ints, usable: Mask, breaks: Set[int], *, pointwise: bool) -> list[Ints]:
    """Return unbroken runs of usable targets within one line, in order."""
    runs: list[list[int]] = []
    for i in np.flatnonzero(usable):
        joined = runs and not pointwise and runs[-1][-1] == i - 1 and lines[i - 1] == lines[i]
        if joined and i - 1 not in breaks:
            runs[-1].append(int(i))
        else:
            runs.append([int(i)])
    return [np.array(run, dtype=np.int64) for run in runs]


def _direction(a: Array, b: Array) -> Array:
    return np.asarray((b - a) / max(float(np.linalg.norm(b - a)), 1e-9))


def strokes(
    xy: Array, lines: Ints, usable: Mask, joined: bool, mode: Mode, spacing: float, breaks: Set[int] = frozenset()
) -> list[Stroke]:
    """Return strokes that visit all usable targets in their order.

    Args:
        xy: targets in frame A [m], shape (n, 2), in coverage order.
        lines: index of each target's scan line, shape (n,).
        usable: which targets may be visited, shape (n,).
        joined: True if line ends are joined in contact.
        mode: continuous, or one stroke per target.
        spacing: distance of the lines [m].
        breaks: targets after which the stroke ends.
    """
    pieces = []
    for run in _runs(lines, usable, breaks, pointwise=mode is Mode.POINT):
        samples, visits = line_through(xy[run])
        pieces.append(Stroke(samples, run, visits))
    if not joined or mode is Mode.POINT:
        return pieces
    merged: list[Stroke] = []
    for piece in pieces:
        last = merged[-1] if merged else None
        near = last is not None and np.linalg.norm(piece.xy[0] - last.xy[-1]) <= TUNING.join_spacings * spacing
        follows = last is not None and last.targets[-1] == piece.targets[0] - 1 and last.targets[-1] not in breaks
        if last is None or not near or not follows or min(len(last.xy), len(piece.xy)) < 2:
            merged.append(piece)
            continue
        t0, t1 = _direction(last.xy[-2], last.xy[-1]), _direction(piece.xy[0], piece.xy[1])
        bridge = arc(last.xy[-1], t0, piece.xy[0], t1)
        offset = len(last.xy) + len(bridge)
        merged[-1] = Stroke(
            np.vstack((last.xy, bridge, piece.xy)),
            np.concatenate((last.targets, piece.targets)),
            np.concatenate((last.visits, piece.visits + offset)),
        )
    return merged


def touches(xy: Array, usable: Mask) -> list[Stroke]:
    """Return touches at usable targets near the centres of equal cells, the last one near the first target."""
    candidates = np.flatnonzero(usable)
    if not len(candidates):
        return []
    nearest = [candidates[np.argmin(np.linalg.norm(xy[candidates] - c, axis=1))] for c in touch_centres(xy)]
    return [Stroke(xy[[i]], np.array([i]), np.zeros(1, np.int64), touch=True) for i in dict.fromkeys(nearest)]


def transfer(a: Array, b: Array) -> Array:
    """Return samples of the straight path above the surface from a to b in frame A, shape (n, 2)."""
    length = float(np.linalg.norm(b - a))
    if length < 1e-6:
        return a[None].copy()
    n = max(2, round(length / TUNING.sample_m) + 1)
    return np.asarray(a + (b - a) * np.linspace(0.0, 1.0, n)[:, None])
