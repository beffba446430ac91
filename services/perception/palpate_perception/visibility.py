"""Coverage of the region of interest by the camera, and the reasons for gaps."""

from typing import Final, NamedTuple

import numpy as np

from palpate_bus.messages.codes import ViewReason
from palpate_models.numerics.frames import Array, Mask, apply, inverse
from palpate_models.scenario.schema import Exam
from palpate_perception.cloud import project


class VisibilityTuning(NamedTuple):
    """Sizes of the search for gaps."""

    cell_m: float = 0.01
    """Edge of the cells in which coverage is counted: five pixels of a Kinect at 1.1 m."""
    clearance_m: float = 0.025
    """Distance from the expected surface above which a nearer point hides it and a farther one is not the abdomen."""
    crest_m: float = 0.03
    """Maximum height of the abdomen in A, whose origin is the umbilicus [m]."""


TUNING: Final = VisibilityTuning()


def cells(exam: Exam) -> tuple[Array, tuple[int, int]]:
    """Return the centres of the region's cells in A, xy [m], shape (nx * ny, 2), and (nx, ny)."""
    counts = tuple(max(round(length / TUNING.cell_m), 1) for length in exam.region_m)
    axes = [
        centre + length * ((np.arange(count) + 0.5) / count - 0.5)
        for centre, length, count in zip(exam.centre_m, exam.region_m, counts, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2), (counts[0], counts[1])


def find_seen(p_A: Array, exam: Exam) -> Mask:
    """Return the mask of cells with a point of the cloud, shape (nx * ny,)."""
    _, (nx, ny) = cells(exam)
    low = np.array(exam.centre_m) - np.array(exam.region_m) / 2
    cell = np.floor((p_A[:, :2] - low) / np.array(exam.region_m) * (nx, ny)).astype(np.intp)
    cell = cell[np.all((cell >= 0) & (cell < (nx, ny)), axis=1)]
    count = np.bincount(cell[:, 0] * ny + cell[:, 1], minlength=nx * ny)
    return np.asarray(count > 0)


def quadric(p_A: Array, xy: Array) -> Array:
    """Return the height [m] at `xy`, shape (m, 2), of a quadric through a cloud: an estimate for gaps.

    Returns 0, the height of the umbilicus, if the cloud is too small.
    """
    if len(p_A) < 100:
        return np.zeros(len(xy))

    def rows(q: Array) -> Array:
        x, y = q[:, 0], q[:, 1]
        return np.stack((np.ones(len(q)), x, y, x * x, x * y, y * y), axis=1)

    # A weak prior of a flat wall at the umbilicus bounds the estimate if only a corner is in view.
    prior = np.diag(np.sqrt(len(p_A)) * np.array([1e-3, 2e-3, 2e-3, 3e-4, 3e-4, 3e-4]))
    system, right = np.vstack((rows(p_A), prior)), np.concatenate((p_A[:, 2], np.zeros(6)))
    return np.asarray(rows(xy) @ np.linalg.lstsq(system, right)[0])


HINTS: Final = {
    ViewReason.VIEW_BLOCKED: "view blocked by an object, probably the arm (its home_rad), up to {:.2f} m in front of the surface",
    ViewReason.SELF_OCCLUDED: "hidden behind the abdomen itself: place the camera higher",
    ViewReason.OUT_OF_IMAGE: "outside the image: turn the camera towards the region",
    ViewReason.NO_DEPTH: "no depth: seen at too grazing an angle or out of range",
    ViewReason.BEYOND_ABDOMEN: "no abdomen: the surface is deeper, the region extends past the edge",
    ViewReason.TOO_FEW_POINTS: "seen by too few pixels, or cut off by a jump in depth",
}


class Gaps(NamedTuple):
    """Parts of the region that were not in view, by reason."""

    shares: dict[ViewReason, float]
    """Fraction of the region, largest first, without those of at most half a percent."""
    obstacle_m: float
    """Maximum distance of an obstacle from the surface behind it [m]."""

    @property
    def reason(self) -> ViewReason:
        """The reason to act on: a blocked view even if it is not the largest part, since another view can avoid it."""
        blocked = ViewReason.VIEW_BLOCKED
        return blocked if blocked in self.shares else next(iter(self.shares), ViewReason.TOO_FEW_POINTS)

    def __str__(self) -> str:
        """Text for people."""
        parts = (f"{HINTS[r].format(self.obstacle_m)} ({100 * share:.0f} % of the region)" for r, share in self.shares.items())
        return "; ".join(parts)


def gaps(missing: Array, total: int, X_CA: Array, K: Array, depth: Array, origin: tuple[int, int], size: tuple[int, int]) -> Gaps:
    """Return the reasons for which cells were not in view.

    `missing`: points expected in those cells, in A [m], shape (m, 3); `total`: number of cells of the region; `depth`: the
    fused window [m], whose first pixel is `origin` of an image of shape `size`.
    """
    if len(missing) == 0:
        return Gaps({}, 0.0)
    p_C = apply(X_CA, missing)
    front = p_C[:, 2] > 0.01
    u, v = project(np.where(front[:, np.newaxis], p_C, (0.0, 0.0, 1.0)), K)
    row, column = np.rint(v).astype(np.intp), np.rint(u).astype(np.intp)
    inside = front & (row >= 0) & (row < size[0]) & (column >= 0) & (column < size[1])
    row, column = row - origin[0], column - origin[1]
    held = inside & (row >= 0) & (row < depth.shape[0]) & (column >= 0) & (column < depth.shape[1])
    measured = np.full(len(missing), np.nan)
    measured[held] = depth[row[held], column[held]]
    nearer = p_C[:, 2] - measured
    behind, beyond = inside & (nearer > TUNING.clearance_m), inside & (nearer < -TUNING.clearance_m)
    before_it = apply(inverse(X_CA), p_C * (measured / p_C[:, 2])[:, np.newaxis])  # the point in view instead, in A
    itself = behind & (before_it[:, 2] < TUNING.crest_m)
    hidden = behind & ~itself
    none = inside & np.isnan(measured)
    before = float(np.max(nearer[hidden], initial=0.0))
    masks = {
        ViewReason.VIEW_BLOCKED: hidden,
        ViewReason.SELF_OCCLUDED: itself,
        ViewReason.OUT_OF_IMAGE: ~inside,
        ViewReason.NO_DEPTH: none,
        ViewReason.BEYOND_ABDOMEN: beyond,
        ViewReason.TOO_FEW_POINTS: inside & ~behind & ~beyond & ~none,
    }
    shares = {reason: float(np.count_nonzero(mask)) / total for reason, mask in masks.items()}
    listed = {r: share for r, share in sorted(shares.items(), key=lambda item: -item[1]) if share > 0.005}
    return Gaps(listed, before)
