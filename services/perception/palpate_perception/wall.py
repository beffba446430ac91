"""Wall model from a scan of a few breaths: surface at the end of expiration, and breathing amplitude of each part.

A small depth image z(t) of the wall is, at pixel i with viewing ray r_i (unit z) and outward normal n_i,

    z_i(t) = z_i + g_i m_i d(t) + noise,   g_i = 1 / (n_i . r_i)

with the displacement d and the mode m. The outward displacements (z_i(t) - mean z_i) / g_i are fitted by polynomials in x and y
of A, frame by frame; the singular value decomposition of their coefficients, whitened by their covariance, gives d(t) and m.
Errors that are fixed to the image cancel, since only changes of a pixel count.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, map_coordinates

from palpate_models.numerics.frames import Array, apply, inverse
from palpate_models.robot.table import TABLE_TOP_M
from palpate_models.scenario.schema import Exam
from palpate_perception import cloud, surface
from palpate_perception.cloud import HEIGHT_M, TABLE_CLEARANCE_M, Intrinsics, RegionBox
from palpate_perception.fusion import Image

MARGIN_M: Final = 0.12
"""Margin of the tracked area around the region [m]; it distinguishes a shift from a breath."""
HALF_M: Final = 0.22
"""Least half width of the tracked area [m]."""
CUTOFF_M: Final = 0.06
"""Shorter waves of the wall are not seen by pixels 14 mm apart."""
DEGREE: Final = 4
"""Total degree of the mode's polynomial."""
UNKNOWN_M: Final = 2e-3
"""Noise of a pixel without an estimate [m]."""
VALID: Final = 0.7
"""A pixel that was seen in fewer of the frames is left out."""
STEEP: Final = 0.35
"""A pixel whose ray meets the wall at a smaller cosine is left out: a little error of its place is a large one of depth."""
EDGE: Final = 2.5
"""Noise, as a multiple of the usual, from which a pixel is at an edge and left out."""
STILL_M: Final = 3e-4
"""A wall that moves by a smaller standard deviation is still: then every part of it is expected to move alike."""
EXPIRED: Final = 0.05
"""Share of the time in which the wall seems lower than at the end of expiration, for the noise of an image's displacement."""
LEAST_PIXELS: Final = 60


class UnseenWallError(ValueError):
    """Too little of the wall was in view to learn anything."""


@dataclass(frozen=True, slots=True)
class BreathingMode:
    """Breathing amplitude of each place, relative to the largest in the region: a polynomial in x and y of A."""

    low: Array
    """Lower corner of the fitted rectangle in A [m], shape (2,)."""
    high: Array
    """Upper corner [m], shape (2,)."""
    coefficients: Array
    """Coefficients of the products of Legendre polynomials that `basis` gives."""

    def __call__(self, p_A: Array) -> Array:
        """The mode, between 0 and 1, at places in A [m], shape (n, 2 or 3): shape (n,)."""
        return np.clip(basis(p_A, self.low, self.high) @ self.coefficients, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class SeenWall:
    """The wall as n pixels of the small image see it."""

    pixel: NDArray[np.intp]
    """Flat indices, shape (n,)."""
    depth: Array
    """At the end of expiration [m], shape (n,)."""
    gain: Array
    """g: change of depth by outward displacement, shape (n,), negative."""
    sigma: Array
    """Noise of a frame's depth [m], shape (n,)."""
    p_A: Array
    """Places [m], shape (n, 3)."""
    n_A: Array
    """Outward unit normals, shape (n, 3)."""
    mode: BreathingMode
    lifts: Array
    """The mode at the pixels, shape (n,)."""
    r_W: Array
    """Viewing rays of unit z in the camera's frame, shape (n, 3)."""
    camera: Intrinsics
    """Intrinsics of the small image."""

    def depth_per_metre(self, camera: Intrinsics, window: tuple[slice, slice]) -> Image:
        """By how much depth changes for a displacement of 1 m, g m, in a window (rows, columns) of another of its images."""
        rows, columns = (np.arange(part.start, part.stop) for part in window)
        v, u = np.meshgrid(*(to_small(x, i, camera.K, self.camera.K) for x, i in ((rows, 1), (columns, 0))), indexing="ij")
        values = np.full(self.camera.shape, np.nan)
        values.ravel()[self.pixel] = self.gain * self.lifts
        nearest = distance_transform_edt(np.isnan(values), return_distances=False, return_indices=True)
        return np.asarray(map_coordinates(values[tuple(nearest)], (v, u), order=1, mode="nearest"), np.float32)


def to_small(x: Array, axis: int, K: Array, K_small: Array) -> Array:
    """Coordinates in the small image [px] of those in another of the same camera, along x (axis 0) or y (1)."""
    return np.asarray((x - K[axis, 2]) / K[axis, axis] * K_small[axis, axis] + K_small[axis, 2])


def watched(exam: Exam) -> RegionBox:
    """Return the tracked area, in A."""
    return RegionBox.of(exam, max(MARGIN_M, HALF_M - min(exam.region_m) / 2), HEIGHT_M)


def basis(p_A: Array, low: Array, high: Array) -> Array:
    """Products of Legendre polynomials of total degree up to DEGREE over a rectangle, at places, shape (n, 2 or 3)."""
    x, y = (2 * (np.clip(p_A[:, :2], low, high) - low) / (high - low) - 1).T
    columns = legendre.legvander2d(x, y, [DEGREE, DEGREE]).reshape(len(x), DEGREE + 1, DEGREE + 1)
    i, j = np.indices((DEGREE + 1, DEGREE + 1))
    return np.asarray(columns[:, i + j <= DEGREE])


def learn(frames: Array, camera: Intrinsics, X_WA: Array, exam: Exam) -> tuple[SeenWall, Array]:
    """The wall, and its displacement [m] in each frame, shape (frames,), from small depth images, shape (frames, height, width).

    NaN where a pixel is invalid or hidden. Raises UnseenWallError when too few pixels show the wall.
    """
    pixel, mean, sigma = steady(frames)
    X_AC = inverse(X_WA) @ camera.X_WC
    r_C = cloud.deproject(np.ones(camera.shape), camera.K).reshape(-1, 3)[pixel]
    p_A = apply(X_AC, mean[:, np.newaxis] * r_C)
    box = watched(exam)
    keep = box.holds(p_A) & (apply(X_WA, p_A)[:, 2] > TABLE_TOP_M + TABLE_CLEARANCE_M)
    keep[keep] &= sigma[keep] < EDGE * np.median(sigma[keep]) if keep.any() else False
    if np.count_nonzero(keep) < LEAST_PIXELS:
        raise UnseenWallError(f"{np.count_nonzero(keep)} pixels of the small image show the wall, want {LEAST_PIXELS}")
    field = surface.fit(p_A[keep], sigma[keep], box.low[:2], box.high[:2], CUTOFF_M)
    n_A = field.normal(p_A[:, 0], p_A[:, 1])
    slope = np.einsum("ij,ij->i", n_A, r_C @ X_AC[:3, :3].T)
    keep &= -slope > STEEP * np.linalg.norm(r_C, axis=1)
    if np.count_nonzero(keep) < LEAST_PIXELS:
        raise UnseenWallError(f"{np.count_nonzero(keep)} pixels of the small image see the wall well, want {LEAST_PIXELS}")
    pixel, gain = pixel[keep], 1 / slope[keep]
    mean, sigma, p_A, n_A = mean[keep], sigma[keep], p_A[keep], n_A[keep]

    outward = (without_gaps(frames.reshape(len(frames), -1)[:, pixel]) - mean) / gain
    mode = _mode(outward, np.abs(gain) / sigma, p_A, exam)
    lifts = mode(p_A)
    weight = lifts * (gain / sigma) ** 2
    d = outward @ weight / (weight @ lifts)
    if not mode.coefficients[1:].any():  # still: what d shows is noise
        d = np.zeros(len(d))
    expired = float(np.quantile(np.convolve(d, np.full(3, 1 / 3), "valid"), EXPIRED)) if len(d) > 2 else float(d.min())
    depth = mean + gain * lifts * expired
    r_W = r_C[keep] @ camera.X_WC[:3, :3].T
    return SeenWall(pixel, depth, gain, sigma, p_A, n_A, mode, lifts, r_W, camera), d - expired


def steady(frames: Array) -> tuple[NDArray[np.intp], Array, Array]:
    """The pixels that were mostly seen (flat), with their mean depth and the noise of a frame [m], shape (n,) each."""
    flat = frames.reshape(len(frames), -1)
    pixel = np.flatnonzero(np.isfinite(flat).mean(axis=0) > VALID)
    seen = flat[:, pixel]
    step = np.diff(without_gaps(seen), axis=0)
    between = np.isfinite(seen[1:]) & np.isfinite(seen[:-1])  # a step into a gap or out of it is not noise alone
    noise = np.sqrt(np.sum(np.where(between, step, 0.0) ** 2, axis=0) / np.maximum(between.sum(axis=0), 1) / 2)
    sigma = np.where(between.any(axis=0), noise, UNKNOWN_M) if len(frames) > 2 else np.full(len(pixel), UNKNOWN_M)
    return pixel, np.nanmean(seen, axis=0), np.maximum(sigma, 1e-4)


def without_gaps(seen: Array) -> Array:
    """Depths of pixels, shape (frames, n), with what a frame lacks (NaN) between those before and after it.

    Real cameras' holes flicker: a pixel that is not seen for a frame does not stand still in it.
    """
    filled, k = seen.copy(), np.arange(len(seen))
    for column in np.flatnonzero(~np.isfinite(seen).all(axis=0)):
        known = np.isfinite(seen[:, column])
        filled[:, column] = np.interp(k, k[known], seen[known, column])
    return filled


def _mode(outward: Array, certainty: Array, p_A: Array, exam: Exam) -> BreathingMode:
    """The mode of outward displacements [m], shape (frames, n), whose noise is 1 / `certainty` [1/m], shape (n,)."""
    low, high = p_A[:, :2].min(axis=0), p_A[:, :2].max(axis=0)
    waves = basis(p_A, low, high)
    Q, R = np.linalg.qr(certainty[:, np.newaxis] * waves)
    score, size, shape = np.linalg.svd((certainty * outward) @ Q, full_matrices=False)
    coefficients = np.linalg.solve(R, shape[0])
    region = RegionBox.of(exam, 0.0, HEIGHT_M)
    inside = region.holds(p_A)
    lifts = waves @ coefficients
    most = lifts[inside if inside.any() else slice(None)]
    most = most[np.argmax(np.abs(most))]
    if np.std(score[:, 0]) * size[0] * abs(most) < STILL_M:
        level = np.zeros(len(coefficients))
        level[0] = 1.0
        return BreathingMode(low, high, level)
    return BreathingMode(low, high, coefficients / most)
