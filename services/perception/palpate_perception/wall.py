"""Wall model from a scan of a few breaths: surface at the end of expiration, and breathing amplitude of each part.

A small depth image z(t) of the wall is, at pixel i with viewing ray r_i (unit z) and outward normal n_i,

    z_i(t) = z_i + g_i m_i d(t) + noise,   g_i = 1 / (n_i . r_i)

with the displacement d and the mode m. The outward displacements (z_i(t) - mean z_i) / g_i are fitted by polynomials in x and y
of A, frame by frame; the singular value decomposition of their coefficients, whitened by their covariance, gives d(t) and m.
Errors that are fixed to the image cancel, since only changes of a pixel count.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.polynomial import legendre
from scipy.ndimage import distance_transform_edt, map_coordinates

from palpate_models.numerics.frames import Array, Indices, Mask, apply, inverse
from palpate_models.robot.arm import TABLE
from palpate_models.scenario.schema import Exam
from palpate_perception import cloud, surface
from palpate_perception.cloud import CROP, Image, Intrinsics, RegionBox


class WallFitTuning(NamedTuple):
    """Tuning of the wall model."""

    margin_m: float = 0.12
    """Margin of the tracked area around the region [m]; it distinguishes a shift from a breath."""
    half_m: float = 0.22
    """Minimum half width of the tracked area [m]."""
    cutoff_m: float = 0.06
    """Cut-off wavelength of the wall's surface [m]; the pixels are 14 mm apart."""
    degree: int = 4
    """Total degree of the mode's polynomial."""
    unknown_noise_m: float = 2e-3
    """Noise of a pixel without an estimate [m]."""
    valid_share: float = 0.7
    """Minimum fraction of the frames in which a pixel must be valid."""
    min_cosine: float = 0.35
    """Minimum cosine between ray and normal; below it a small lateral error causes a large depth error."""
    edge_noise: float = 2.5
    """Noise, as a multiple of the median, above which a pixel counts as an edge and is excluded."""
    still_m: float = 3e-4
    """SD of the displacement below which the wall is still [m]; then the mode is uniform."""
    expired_share: float = 0.05
    """Quantile of the displacement that is taken as the end of expiration; noise makes lower values."""
    min_pixels: int = 60


WALL_FIT: Final = WallFitTuning()


class WallNotVisibleError(ValueError):
    """Too little of the wall was in view to fit the model."""


class BreathingMode(NamedTuple):
    """Breathing amplitude at a position, relative to the largest in the region: a polynomial in x and y of A."""

    low: Array
    """Lower corner of the fitted rectangle in A [m], shape (2,)."""
    high: Array
    """Upper corner [m], shape (2,)."""
    coefficients: Array
    """Coefficients of the products of Legendre polynomials of `basis`."""

    def __call__(self, p_A: Array) -> Array:
        """Return the mode, between 0 and 1, shape (n,), at positions in A [m], shape (n, 2 or 3)."""
        return np.clip(basis(p_A, self.low, self.high) @ self.coefficients, 0.0, 1.0)


class WallPixels(NamedTuple):
    """Wall model at the n pixels of the small image that show it."""

    pixel: Indices
    """Flat indices, shape (n,)."""
    depth: Array
    """Depth at the end of expiration [m], shape (n,)."""
    gain: Array
    """g: change of depth by outward displacement, shape (n,), negative."""
    sigma: Array
    """Noise of a frame's depth [m], shape (n,)."""
    p_A: Array
    """Positions in A [m], shape (n, 3)."""
    n_A: Array
    """Outward unit normals, shape (n, 3)."""
    mode: BreathingMode
    lifts: Array
    """Mode at the pixels, shape (n,)."""
    r_W: Array
    """Viewing rays of unit depth, in world axes, shape (n, 3)."""
    camera: Intrinsics
    """Intrinsics of the small image."""

    def depth_per_metre(self, camera: Intrinsics, window: tuple[slice, slice]) -> Image:
        """Return the change of depth per displacement, g m, in a window (rows, columns) of another image of this camera."""
        rows, columns = (np.arange(part.start, part.stop) for part in window)
        v, u = np.meshgrid(*(to_small(x, i, camera.K, self.camera.K) for x, i in ((rows, 1), (columns, 0))), indexing="ij")
        values = np.full(self.camera.shape, np.nan)
        values.ravel()[self.pixel] = self.gain * self.lifts
        nearest = distance_transform_edt(np.isnan(values), return_distances=False, return_indices=True)
        return np.asarray(map_coordinates(values[tuple(nearest)], (v, u), order=1, mode="nearest"), np.float32)


def to_small(x: Array, axis: int, K: Array, K_small: Array) -> Array:
    """Convert coordinates along x (axis 0) or y (1) [px] from another image of the camera to the small image."""
    return np.asarray((x - K[axis, 2]) / K[axis, axis] * K_small[axis, axis] + K_small[axis, 2])


def tracked_area(exam: Exam) -> RegionBox:
    """Return the tracked area, in A."""
    return RegionBox.of(exam, max(WALL_FIT.margin_m, WALL_FIT.half_m - min(exam.region_m) / 2), CROP.height_m)


def basis(p_A: Array, low: Array, high: Array) -> Array:
    """Products of Legendre polynomials of total degree up to WALL_FIT.degree over a rectangle, at places, shape (n, 2 or 3)."""
    x, y = (2 * (np.clip(p_A[:, :2], low, high) - low) / (high - low) - 1).T
    degree = WALL_FIT.degree
    i, j = np.indices((degree + 1, degree + 1)).reshape(2, -1)
    return np.asarray(legendre.legvander2d(x, y, [degree, degree])[:, i + j <= degree])


def learn(frames: Array, camera: Intrinsics, X_WA: Array, exam: Exam) -> tuple[WallPixels, Array]:
    """Fit the wall to small depth images, shape (frames, height, width), NaN where a pixel is invalid or hidden.

    Returns the wall and its displacement [m] in each frame, shape (frames,). Raises WallNotVisibleError.
    """
    pixel, mean, sigma = find_steady(frames)
    X_AC = inverse(X_WA) @ camera.X_WC
    r_C = cloud.deproject(np.ones(camera.shape), camera.K).reshape(-1, 3)[pixel]
    p_A = apply(X_AC, mean[:, np.newaxis] * r_C)
    box = tracked_area(exam)
    keep = box.holds(p_A) & (apply(X_WA, p_A)[:, 2] > TABLE.top_m + CROP.table_clearance_m)
    keep[keep] &= sigma[keep] < WALL_FIT.edge_noise * np.median(sigma[keep]) if keep.any() else False
    _check_count(keep, "show the wall")
    field = surface.fit(p_A[keep], sigma[keep], box.low[:2], box.high[:2], WALL_FIT.cutoff_m)
    n_A = field.normal(p_A[:, 0], p_A[:, 1])
    slope = np.einsum("ij,ij->i", n_A, r_C @ X_AC[:3, :3].T)
    keep &= -slope > WALL_FIT.min_cosine * np.linalg.norm(r_C, axis=1)
    _check_count(keep, "show the wall at a usable angle")
    pixel, gain = pixel[keep], 1 / slope[keep]
    mean, sigma, p_A, n_A = mean[keep], sigma[keep], p_A[keep], n_A[keep]

    outward = (fill_gaps(frames.reshape(len(frames), -1)[:, pixel]) - mean) / gain
    mode = _mode(outward, np.abs(gain) / sigma, p_A, exam)
    lifts = mode(p_A)
    weight = lifts * (gain / sigma) ** 2
    d = outward @ weight / (weight @ lifts)
    if not mode.coefficients[1:].any():  # still: what d shows is noise
        d = np.zeros(len(d))
    smooth, share = (np.convolve(d, np.full(3, 1 / 3), "valid"), WALL_FIT.expired_share) if len(d) > 2 else (d, 0.0)
    expired = float(np.quantile(smooth, share))
    depth = mean + gain * lifts * expired
    r_W = r_C[keep] @ camera.X_WC[:3, :3].T
    return WallPixels(pixel, depth, gain, sigma, p_A, n_A, mode, lifts, r_W, camera), d - expired


def _check_count(keep: Mask, what: str) -> None:
    """Raise WallNotVisibleError if too few pixels are kept."""
    if (count := np.count_nonzero(keep)) < WALL_FIT.min_pixels:
        raise WallNotVisibleError(f"{count} pixels of the small image {what}, expected {WALL_FIT.min_pixels}")


def find_steady(frames: Array) -> tuple[Indices, Array, Array]:
    """Return the mostly valid pixels (flat), their mean depth and the noise of a frame [m], shape (n,) each."""
    flat = frames.reshape(len(frames), -1)
    pixel = np.flatnonzero(np.isfinite(flat).mean(axis=0) > WALL_FIT.valid_share)
    seen = flat[:, pixel]
    step = np.diff(fill_gaps(seen), axis=0)
    between = np.isfinite(seen[1:]) & np.isfinite(seen[:-1])  # steps at the edges of gaps are not noise
    noise = np.sqrt(np.sum(np.where(between, step, 0.0) ** 2, axis=0) / np.maximum(between.sum(axis=0), 1) / 2)
    sigma = np.where(between.any(axis=0) & (len(frames) > 2), noise, WALL_FIT.unknown_noise_m)
    return pixel, np.nanmean(seen, axis=0), np.maximum(sigma, 1e-4)


def fill_gaps(seen: Array) -> Array:
    """Return depths of pixels, shape (frames, n), with gaps (NaN) interpolated over the frames.

    Holes of real cameras flicker, and the wall continues to move in a gap.
    """
    filled, k = seen.copy(), np.arange(len(seen))
    for column in np.flatnonzero(~np.isfinite(seen).all(axis=0)):
        known = np.isfinite(seen[:, column])
        filled[:, column] = np.interp(k, k[known], seen[known, column])
    return filled


def _mode(outward: Array, certainty: Array, p_A: Array, exam: Exam) -> BreathingMode:
    """Return the mode of outward displacements [m], shape (frames, n), with noise 1 / `certainty` [1/m], shape (n,)."""
    low, high = p_A[:, :2].min(axis=0), p_A[:, :2].max(axis=0)
    waves = basis(p_A, low, high)
    Q, R = np.linalg.qr(certainty[:, np.newaxis] * waves)
    score, size, shape = np.linalg.svd((certainty * outward) @ Q, full_matrices=False)
    coefficients = np.linalg.solve(R, shape[0])
    region = RegionBox.of(exam, 0.0, CROP.height_m)
    inside = region.holds(p_A)
    lifts = waves @ coefficients
    most = lifts[inside if inside.any() else slice(None)]
    most = most[np.argmax(np.abs(most))]
    if np.std(score[:, 0]) * size[0] * abs(most) < WALL_FIT.still_m:
        level = np.zeros(len(coefficients))
        level[0] = 1.0
        return BreathingMode(low, high, level)
    return BreathingMode(low, high, coefficients / most)
