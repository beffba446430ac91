"""Coverage of the region of interest by the camera, and reasons for gaps."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from palpate_models.numerics.frames import Array, apply, inverse
from palpate_models.scenario.schema import Exam
from palpate_perception.cloud import project

CELL_M: Final = 0.01
"""Edge of the cells in which coverage is counted: five pixels of a Kinect at 1.1 m."""
CLEARANCE_M: Final = 0.025
"""Points nearer than the expected surface by more hide it; points farther by more are not the abdomen [m]."""


CREST_M: Final = 0.03
"""Largest height of the abdomen in A, whose origin is the umbilicus [m]."""


def cells(exam: Exam) -> tuple[Array, tuple[int, int]]:
    """Centres of the region's cells in A, xy [m], shape (nx * ny, 2), and (nx, ny)."""
    counts = tuple(max(round(length / CELL_M), 1) for length in exam.region_m)
    axes = [
        centre + length * ((np.arange(count) + 0.5) / count - 0.5)
        for centre, length, count in zip(exam.centre_m, exam.region_m, counts, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2), (counts[0], counts[1])


def seen(p_A: Array, exam: Exam) -> NDArray[np.bool_]:
    """Return the mask of cells with a point of the cloud, shape (nx * ny,)."""
    _, (nx, ny) = cells(exam)
    low = np.array(exam.centre_m) - np.array(exam.region_m) / 2
    cell = np.floor((p_A[:, :2] - low) / np.array(exam.region_m) * (nx, ny)).astype(np.intp)
    cell = cell[np.all((cell >= 0) & (cell < (nx, ny)), axis=1)]
    count = np.bincount(cell[:, 0] * ny + cell[:, 1], minlength=nx * ny)
    return np.asarray(count > 0)


def quadric(p_A: Array, xy: Array) -> Array:
    """Return the height [m] at `xy`, shape (m, 2), of a quadric through a cloud: an estimate for gaps.

    The umbilicus' height, 0, if the cloud is too small.
    """
    if len(p_A) < 100:
        return np.zeros(len(xy))

    def rows(q: Array) -> Array:
        x, y = q[:, 0], q[:, 1]
        return np.stack((np.ones(len(q)), x, y, x * x, x * y, y * y), axis=1)

    # A weak prior of a flat wall at the umbilicus' height keeps the guess sane when only a corner was seen.
    prior = np.diag(np.sqrt(len(p_A)) * np.array([1e-3, 2e-3, 2e-3, 3e-4, 3e-4, 3e-4]))
    system, right = np.vstack((rows(p_A), prior)), np.concatenate((p_A[:, 2], np.zeros(6)))
    return np.asarray(rows(xy) @ np.linalg.lstsq(system, right)[0])


def explain(
    missing: Array,
    total: int,
    X_CA: Array,
    K: Array,
    depth: Array,
    origin: tuple[int, int],
    image: tuple[int, int],
) -> str:
    """Describe why cells have no points, most frequent reason first; empty if none is missing.

    `missing`: expected points, in A, shape (m, 3); `total`: cells in all; `depth`: the fused window [m], whose
    first pixel is `origin` of an image of shape `image`.
    """
    if len(missing) == 0:
        return ""
    p_C = apply(X_CA, missing)
    front = p_C[:, 2] > 0.01
    u, v = project(np.where(front[:, np.newaxis], p_C, (0.0, 0.0, 1.0)), K)
    row, column = np.rint(v).astype(np.intp), np.rint(u).astype(np.intp)
    inside = front & (row >= 0) & (row < image[0]) & (column >= 0) & (column < image[1])
    row, column = row - origin[0], column - origin[1]
    held = inside & (row >= 0) & (row < depth.shape[0]) & (column >= 0) & (column < depth.shape[1])
    measured = np.full(len(missing), np.nan)
    measured[held] = depth[row[held], column[held]]
    nearer = p_C[:, 2] - measured
    behind, beyond = inside & (nearer > CLEARANCE_M), inside & (nearer < -CLEARANCE_M)
    before_it = apply(inverse(X_CA), p_C * (measured / p_C[:, 2])[:, np.newaxis])  # what is seen instead, in A
    itself = behind & (before_it[:, 2] < CREST_M)
    hidden = behind & ~itself
    none = inside & np.isnan(measured)
    before = float(np.max(nearer[hidden], initial=0.0))
    reasons = (
        (hidden, f"view blocked: something, likely the arm, stands up to {before:.2f} m before the surface"),
        (itself, "hidden behind the abdomen itself: place the camera higher"),
        (~inside, "outside the image: turn the camera towards the region"),
        (none, "no depth there: seen at too grazing an angle or out of range"),
        (beyond, "no abdomen there: the surface lies deeper, the region reaches past its edge"),
        (inside & ~behind & ~beyond & ~none, "seen by too few pixels, or cut off by a jump in depth"),
    )
    counted = [(int(np.count_nonzero(mask)), words) for mask, words in reasons]
    parts = [
        f"{words} ({100 * count / total:.0f} % of the region)"
        for count, words in sorted(counted, key=lambda item: -item[0])
        if count > 0.005 * total
    ]
    return "; ".join(parts)
