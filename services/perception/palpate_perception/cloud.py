"""Point clouds of one camera view: the five steps of the paper's processing, from a depth image to palpation points.

Frames: C is the camera's optical frame (x right, y down, z forward), W world, A the abdomen's registered frame. Patterns in
`palpate_models.scenario.patterns` choose the points and their order.

A burst of frames is first fused pixel by pixel.

A frame has 2 mm of noise and is rounded to steps of 3 mm at 1 m. The noise dithers the rounding, so the mean over frames
converges to the true depth, which the median does not. The mean is taken over the frames within a gate about the median, which
excludes frames in which the pixel shows something behind an edge.
"""

from typing import Final, NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from palpate_models.numerics.frames import Array, Array32, Indices, Mask, apply, inverse
from palpate_models.scenario.schema import Exam


class CloudTuning(NamedTuple):
    """Limits of the cropped cloud."""

    height_m: tuple[float, float] = (-0.16, 0.06)
    """Range of heights in A that may be abdomen: below the hovering arm, and down to the whole height of the body."""
    table_clearance_m: float = 0.02
    """Distance from the table's top within which points belong to the table."""
    jump: float = 0.015
    """Neighbouring pixels belong to one sheet if their depths differ by less than this part of the depth [1]: 16 mm at 1.1 m,
    more than a surface seen at 75 deg and less than from the arm to the skin."""


CROP: Final = CloudTuning()


class Intrinsics(NamedTuple):
    """Intrinsics and pose from camera_info and tf_static."""

    K: Array
    """[px], shape (3, 3)."""
    X_WC: Array
    """Calibrated pose of the optical frame in world, shape (4, 4)."""
    shape: tuple[int, int]
    """Height and width of the full image [px]."""

    def same(self, other: "Intrinsics") -> bool:
        """Return True if the other has the same intrinsics and pose."""
        return self.shape == other.shape and np.array_equal(self.K, other.K) and np.array_equal(self.X_WC, other.X_WC)


class Cloud(NamedTuple):
    """n points with their pixels."""

    p_W: Array
    """Positions [m] in world, shape (n, 3)."""
    sigma: Array
    """Standard deviation along the viewing ray [m], shape (n,)."""
    pixel: Indices
    """Row and column in the fused window, shape (n, 2)."""

    def where(self, keep: Mask) -> "Cloud":
        """Return the points of a mask, shape (n,)."""
        return Cloud(self.p_W[keep], self.sigma[keep], self.pixel[keep])


class RegionBox(NamedTuple):
    """The region of interest with its margin: an axis-aligned box in A [m]."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    @classmethod
    def of(cls, exam: Exam, margin: float, z: tuple[float, float]) -> "RegionBox":
        """Return the region of an exam, wider by `margin` [m] on each side, between the heights `z` [m]."""
        (cx, cy), (width, height) = exam.centre_m, exam.region_m
        half_x, half_y = width / 2 + margin, height / 2 + margin
        return cls((cx - half_x, cy - half_y, z[0]), (cx + half_x, cy + half_y, z[1]))

    @property
    def corners(self) -> Array:
        """Corners in A, shape (8, 3)."""
        grid = np.meshgrid(*zip(self.low, self.high, strict=True), indexing="ij")
        return np.stack([axis.ravel() for axis in grid], axis=1)

    def holds(self, p_A: Array) -> Mask:
        """Return the mask of points in A, shape (n, 3), inside the box."""
        return np.asarray(np.all((p_A >= self.low) & (p_A <= self.high), axis=1))


def deproject(depth: Array, K: Array, origin: tuple[int, int] = (0, 0)) -> Array:
    """Return the points of a depth image [m] in C [m], shape (height, width, 3); NaN stays NaN.

    K: intrinsics, shape (3, 3). `origin`: row and column of the image's first pixel in the full image.
    """
    rows, columns = np.indices(depth.shape)
    x = (columns + origin[1] - K[0, 2]) / K[0, 0]
    y = (rows + origin[0] - K[1, 2]) / K[1, 1]
    return np.stack((x * depth, y * depth, depth), axis=-1)


def project(p_C: Array, K: Array) -> tuple[Array, Array]:
    """Return pixel coordinates u, v, shapes (n,), of points in C, shape (n, 3), in front of the camera."""
    return K[0, 0] * p_C[:, 0] / p_C[:, 2] + K[0, 2], K[1, 1] * p_C[:, 1] / p_C[:, 2] + K[1, 2]


def window(box: RegionBox, X_CA: Array, K: Array, shape: tuple[int, int]) -> tuple[slice, slice]:
    """Return rows and columns of the image that can show the box; empty slices if none can.

    Returns the whole image if a corner is behind the camera.
    """
    p_C = apply(X_CA, box.corners)
    if p_C[:, 2].min() < 0.01:
        return slice(0, shape[0]), slice(0, shape[1])
    u, v = project(p_C, K)
    rows, columns = (
        (min(max(int(np.floor(x.min())), 0), n), min(max(int(np.ceil(x.max())) + 1, 0), n))
        for x, n in zip((v, u), shape, strict=True)
    )
    return slice(*rows), slice(*columns)


def to_world(p_C: Array, sigma: Array, X_WC: Array) -> Cloud:
    """Step 1: convert organised points in C, shape (height, width, 3), to a cloud in world, with invalid points."""
    pixel = np.argwhere(np.ones(sigma.shape, np.bool_))
    return Cloud(apply(X_WC, p_C.reshape(-1, 3)), sigma.ravel(), pixel)


def remove_invalid(cloud: Cloud) -> Cloud:
    """Step 2: remove points without depth."""
    return cloud.where(np.asarray(np.isfinite(cloud.p_W).all(axis=1), np.bool_))


def crop(cloud: Cloud, X_WA: Array, box: RegionBox, floor_m: float) -> Cloud:
    """Step 3: keep the points in the box and above the height `floor_m` in world (the table's top plus noise)."""
    inside = box.holds(apply(inverse(X_WA), cloud.p_W))
    return cloud.where(np.asarray(inside & (cloud.p_W[:, 2] > floor_m)))


def main_sheet(cloud: Cloud, depth: Array, inside: Mask) -> Cloud:
    """Step 3, second part: split the cloud into sheets at depth jumps and keep the one with most points `inside`.

    Objects above the skin (arm, tool, stray pixels) are on other sheets. `depth`: the fused window [m]; `inside`:
    mask of the points in the region without its margin, shape (n,).
    """
    n = len(cloud.p_W)
    if n == 0:
        return cloud
    index = np.full(depth.shape, -1)
    index[cloud.pixel[:, 0], cloud.pixel[:, 1]] = np.arange(n)
    pairs = []
    for a, b, za, zb in (
        (index[1:], index[:-1], depth[1:], depth[:-1]),
        (index[:, 1:], index[:, :-1], depth[:, 1:], depth[:, :-1]),
    ):
        joined = (a >= 0) & (b >= 0) & (np.abs(za - zb) < CROP.jump * za)
        pairs.append((a[joined], b[joined]))
    a, b = (np.concatenate(side) for side in zip(*pairs, strict=True))
    _, sheet = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(n, n)), directed=False)
    best = np.argmax(np.bincount(sheet, weights=inside.astype(np.float64)))
    return cloud.where(np.asarray(sheet == best, np.bool_))


def find_supported(p: Array, xy: Array, spacing: float | Array) -> Mask:
    """Step 4: return the mask of targets whose cell has a point, shape (m,).

    `p`: points in A [m], shape (n, 3); `xy`: targets in A [m], shape (m, 2); cells are squares of the side `spacing` [m], or
    rectangles of its two sides, shape (2,).
    """
    distance, _ = cKDTree(p[:, :2] / spacing).query(xy / spacing, p=np.inf, distance_upper_bound=0.5)
    return np.isfinite(distance)


Image = Array32

GATE: Final = 6.0
"""Half width of the gate, in standard deviations of a single frame."""


def frame_sigma(z: Image) -> Image:
    """Return the SD [m] of a frame's depth at depth `z` [m] for a perpendicular surface (Nguyen 2012)."""
    return np.asarray(0.0012 + 0.0019 * (z - 0.4) ** 2, np.float32)


class FusedDepth(NamedTuple):
    """Depth image fused from several; all arrays have the same shape."""

    depth: Image
    """Mean depth [m], NaN where no frame was valid."""
    sigma: Image
    """Standard deviation of the mean [m], NaN where no frame was valid."""
    frames: int
    """Number of fused frames."""
    agreeing: float
    """Share of the valid depths that are within the gate."""


class DepthFusion:
    """Collects the frames of a burst, cropped to `window` (rows, columns)."""

    def __init__(self, window: tuple[slice, slice]) -> None:
        """`window`: rows and columns of the full image, as of `cloud.window`."""
        self.window = window
        self._frames: list[Image] = []

    def add(self, depth: Image) -> None:
        """Add a full frame [m], shape (height, width), NaN where invalid. All must have the size of the first."""
        self._frames.append(np.array(depth[self.window], np.float32))

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self._frames)

    def level(self, displacements: Array, per_metre: Image) -> None:
        """Remove breathing from the frames, in which the wall was displaced by `displacements` [m], shape (frames,).

        `per_metre`: change of depth per outward displacement [1], of the window's shape.
        """
        self._frames = [frame - np.float32(d) * per_metre for frame, d in zip(self._frames, displacements, strict=True)]

    def motion(self, depth: Image, pixel: Indices) -> float:
        """Return the SD [m] over the frames of their mean offset from `depth` at pixels.

        `pixel`: rows and columns in the window, shape (n, 2). Noise averages out over thousands of pixels; a moving surface, as
        in breathing, remains.
        """
        row, column = pixel[:, 0], pixel[:, 1]
        offset = np.stack([frame[row, column] for frame in self._frames]) - depth[row, column]
        kept = np.isfinite(offset)
        mean = np.where(kept, offset, 0).sum(axis=1, dtype=np.float64) / np.maximum(kept.sum(axis=1), 1)
        return float(np.std(mean))

    def fuse(self) -> FusedDepth:
        """Return the fused window of one frame or more."""
        stack = np.sort(np.stack(self._frames), axis=0)  # NaN goes last
        valid = np.isfinite(stack)
        count = valid.sum(axis=0)
        middle = np.maximum(count - 1, 0)
        low, high = (np.take_along_axis(stack, i[np.newaxis], 0)[0] for i in (middle // 2, (middle + 1) // 2))
        median = (low + high) / 2
        gate = GATE * frame_sigma(median)
        kept = np.abs(stack - median) <= gate
        n = np.maximum(kept.sum(axis=0), 1)
        offset = np.where(kept, stack - median, 0)
        mean = offset.sum(axis=0) / n
        variance = np.where(kept, (offset - mean) ** 2, 0).sum(axis=0) / np.maximum(n - 1, 1)
        sigma = np.sqrt(np.maximum(variance, frame_sigma(median) ** 2) / n)
        agreeing = float(kept.sum() / valid.sum()) if valid.any() else 1.0
        return FusedDepth((median + mean).astype(np.float32), sigma.astype(np.float32), len(self._frames), agreeing)
