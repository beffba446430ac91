"""Tracking of the wall from one small depth image to the next.

The outward displacements of the wall's pixels, y = (z - z_ref) / g, are explained by breathing and by the motion of a body on a
table, a shift s_x, s_y and a turn theta about its long axis:

    y_i = m_i d + n_i . (s_x, s_y, 0) + theta n_i . (e_y x p_i) + noise

d is estimated alone, robustly, for the breath filter; then the residual, over some images, by all four with a prior of each.

Errors of neighbouring pixels are correlated for seconds, so the error of d is larger than the number of pixels suggests, and no
filter of breaths removes it. Its size is estimated from patches P of the wall wider than such errors, by the change of d without
each of them (a jackknife, Efron and Stein 1981): with w the weights

    var d = sum_P (d - d_P)^2,   d - d_P = sum_{i in P} w_i m_i (y_i - m_i d) / sum_{i not in P} w_i m_i^2,

half of which is the error of the images that the wall model was fitted to.

*Registration* (`shift_between`): after the patient has moved, the walls of two scans are compared pixel by pixel with the same
model. The normals n_i are midway between both scans, which leaves no error of second order. Both walls are means over two
breaths, so the remaining error is the systematic error of the camera, not pixel noise.

*Average* (`WallAverage`): the mean of all small images corrects the surface of a burst. A burst lasts two seconds, so camera
errors of a few seconds are part of its surface; small images continue for minutes. Pixel i, with the outward displacement y_i of
the wall, gives the displacement of the wall without breathing

    r_i = mean of (y_i - m_i d)

over all images in which the arm does not hide it. These displacements are fitted over x and y of A by the smoothing spline of
the surface.
"""

from enum import Enum, auto
from typing import Final, NamedTuple

import numpy as np

from palpate_models.numerics.frames import Array, Indices, Mask, apply
from palpate_perception import surface
from palpate_perception.breath_filter import BreathFilter
from palpate_perception.surface import FittedSurface
from palpate_perception.wall import WallPixels


class ShiftTuning(NamedTuple):
    """Tuning of the registration of a patient who has moved."""

    prior_sd: tuple[float, ...] = (0.010, 0.015, 0.015, 0.05)
    """Standard deviations of the rise d [m], s_x, s_y [m] and theta [rad] of a body that moves."""
    pixel_error_m: float = 1.4e-3
    """Equivalent independent error of a pixel in both scans [m]: 0.7 mm shared by four neighbours (docs/errors.md)."""
    tukey: float = 5.0
    """Tukey's biweight, in standard deviations of a pixel: clothes and arms move otherwise."""
    rounds: int = 4


SHIFT: Final = ShiftTuning()


def reasons(lifts: Array, n_A: Array, from_middle: Array) -> Array:
    """Return the outward displacement of pixels by unit d, s_x, s_y and theta, shape (n, 4); theta turns about the middle."""
    turn = from_middle[:, 2] * n_A[:, 0] - from_middle[:, 0] * n_A[:, 2]  # n . (e_y x p)
    return np.column_stack((lifts, n_A[:, :2], turn))


def shift_between(before: WallPixels, after: WallPixels, middle: Array, drift: float) -> Array:
    """Return the shift of the skin around `middle` (A, [m], shape (3,)) along the table [m], in A, shape (2,).

    `drift`: drift of the camera's depth between the scans [m]; in an oblique view it would look like a shift.
    """
    _, i, j = np.intersect1d(before.pixel, after.pixel, assume_unique=True, return_indices=True)
    y = 2 * (after.depth[j] - drift - before.depth[i]) / (after.gain[j] + before.gain[i])
    n_A = (before.n_A[i] + after.n_A[j]) / 2
    X = reasons((before.lifts[i] + after.lifts[j]) / 2, n_A, (before.p_A[i] + after.p_A[j]) / 2 - middle)
    motion: Array = np.zeros(4)
    prior = np.diag(np.array(SHIFT.prior_sd) ** -2.0)
    weight: Array = np.full(len(y), SHIFT.pixel_error_m**-2.0)
    for _ in range(SHIFT.rounds):
        motion = np.asarray(np.linalg.solve(X.T @ (weight[:, np.newaxis] * X) + prior, X.T @ (weight * y)))
        scale = max(SHIFT.pixel_error_m, 1.5 * float(np.median(np.abs(y - X @ motion))))
        weight = np.clip(1 - ((y - X @ motion) / (SHIFT.tukey * scale)) ** 2, 0, None) ** 2 / scale**2
    return np.asarray(motion[1:3])


class AverageTuning(NamedTuple):
    """Tuning of the surface correction from the mean of all small images."""

    min_images: int = 30
    """Minimum number of images of a pixel."""
    min_pixels: int = 12
    """Fewer pixels over the surface correct nothing."""
    pixel_error_m: float = 2e-4
    """Error of a pixel's mean [m] (assumed); uniform, so it does not change weights."""


AVERAGE: Final = AverageTuning()


class WallAverage:
    """Mean of the displacement of each pixel of the wall."""

    def __init__(self, wall: WallPixels, watched: int) -> None:
        """Start with the wall as the mean of `watched` images."""
        self._wall = wall
        self._images = np.full(len(wall.pixel), float(watched))
        self._sum = np.zeros(len(wall.pixel))

    def add(self, still: Array, seen: Mask) -> None:
        """Add an image: outward displacement without the breath [m] and mask of visible pixels, shape (n,) each."""
        self._images += seen
        self._sum += np.where(seen, still, 0.0)

    def outward_of(self, field: FittedSurface, X_AW: Array) -> FittedSurface | None:
        """Return the outward offset of the wall from a surface [m], over its rectangle; None with too few pixels."""
        wall = self._wall
        z = wall.depth + wall.gain * self._sum / self._images
        x, y, height = apply(X_AW, wall.camera.X_WC[:3, 3] + z[:, np.newaxis] * wall.r_W).T
        low, high = ((getattr(field.x, end), getattr(field.y, end)) for end in ("low", "high"))
        over = (self._images >= AVERAGE.min_images) & (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1])
        if np.count_nonzero(over) < AVERAGE.min_pixels:
            return None
        x, y, height = x[over], y[over], height[over]
        outward = (height - field.height(x, y)) * field.normal(x, y)[:, 2]
        return surface.fit(np.column_stack((x, y, outward)), np.full(len(x), AVERAGE.pixel_error_m), low, high)


FORECAST_S: Final[Array] = 0.050 * np.arange(11.0)
"""Forecast times after an exposure [s]."""


class TrackerTuning(NamedTuple):
    """Tuning of the tracking of breathing."""

    patch_m: float = 0.11
    """Size of a patch [m]; errors are correlated over less: 25 pixels of a poor camera, 5 cm (docs/errors.md)."""
    shared_error_m: float = 1.5e-4
    """Initial SD of the displacement error shared by neighbouring pixels [m]."""
    shared_error_tau_s: float = 20.0
    """Time constant of the estimate of that SD [s]."""
    reach_m: float = 0.06
    """Maximum distance of a wall pixel from the expected wall [m]."""
    tukey: float = 5.0
    """Tukey's biweight, in standard deviations of a pixel."""
    min_share: float = 0.015
    """Minimum share of the wall's weight in view; below it the wall is lost."""
    surprise: float = 5.0
    """Innovation, in standard deviations, from which a displacement is not a normal breath."""
    surprise_m: float = 2.5e-3
    """Minimum innovation of such a displacement [m]."""
    deep: float = 2.2
    """Depth of a deep breath, as a multiple of the usual depth."""
    calm_s: float = 0.6
    """Time after the last surprise until the wall is quiet again [s]."""
    gap_s: float = 0.2
    """Maximum time that one image represents, also after a gap in which the patient may have moved [s]."""


TRACKING: Final = TrackerTuning()


class PatientMotionTuning(NamedTuple):
    """Tuning of the detection of patient motion."""

    memory: float = 0.7
    """Weight of the previous residuals at the next image.

    It averages about six images. White noise falls by that to the level of the errors shared by neighbouring pixels, which do not
    fall, so the average is about as accurate as the white noise of one image."""
    min_m: float = 0.002
    """Minimum patient motion [m]: root mean square over the region's corners, without a common rise."""
    threshold: float = 14.0
    """Motion is detected when its squared Mahalanobis distance exceeds this multiple of the running mean.

    Largest value in three images in a row (tuning seeds): 8.5 for 35 patients with quiet breathing (89 min), 8.9 for 10 with poor
    equipment (25 min); at least 73 for 60 shifts of 10 mm, 23 for one along a body of uniform height."""
    mean_tau_s: float = 20.0
    """Time constant of the running mean [s], which is at least 1. Shared pixel errors, not in the covariance, raise it."""
    mean_clip: float = 3.0
    """Samples of the running mean are clipped at this multiple, so that a starting motion does not raise it."""
    drift_tau_s: float = 8.0
    """Slower changes are camera drift, not patient motion [s]."""
    images: int = 3
    """Number of consecutive images that must exceed the threshold."""


MOTION: Final = PatientMotionTuning()


class State(Enum):
    """State of the wall; SurfaceMotion.msg explains the names."""

    QUIET = auto()
    SPOILED = auto()
    MOVED = auto()
    LOST = auto()


class Followed(NamedTuple):
    """Result of one image."""

    state: State
    displacement: float
    """[m] at the exposure."""
    forecast: Array
    """[m] FORECAST_S after it."""
    sigma: float
    """Standard deviation of the displacement [m]."""
    shift: Array
    """Displacement of the body since the first scan, in A [m], shape (3,)."""


NOTHING: Final = Followed(State.LOST, 0.0, np.zeros(len(FORECAST_S)), 0.1, np.zeros(3))
"""Result before a wall is known."""


class Tracker:
    """Follows one wall."""

    def __init__(self, wall: WallPixels, t_s: Array, d: Array, corners: Array) -> None:
        """Start with a wall displaced by `d` [m] at times `t_s` [s], (n,) each; `corners` of the region in A, shape (m, 3)."""
        self.wall = wall
        self.average = WallAverage(wall, len(t_s))
        """Mean of the images of a quiet wall."""
        self._filter = BreathFilter(t_s, d)
        middle = corners.mean(axis=0)
        self._reasons = reasons(wall.lifts, wall.n_A, wall.p_A - middle)
        self._corners = corners - middle
        self._patch = _patches(wall.p_A)
        self._shared = TRACKING.shared_error_m**2
        self._certainty = (wall.gain / wall.sigma) ** 2
        self._whole = float(self._certainty @ wall.lifts**2)
        self._precision = np.zeros((4, 4))
        self._pull = np.zeros(4)
        self._prior = np.diag(np.array(SHIFT.prior_sd) ** -2.0)
        self._calm_s = float(t_s[-1])
        self._drift = np.zeros(4)
        self._usual = 1.0
        self._last_s = float(t_s[-1])
        self._votes = 0
        self.moved = False
        """True if the patient has moved since the wall model was fitted."""

    def follow(self, t_s: float, depth: Array, hidden: Mask) -> Followed:
        """Process the wall's pixels of an image exposed at `t_s` [s]: depth [m] and mask of hidden pixels, (n,) each."""
        expected, spread = self._filter.forward(t_s)
        y = (depth - self.wall.depth) / self.wall.gain
        use = np.isfinite(depth) & ~hidden & (np.abs(y - self.wall.lifts * expected) < TRACKING.reach_m)
        y = np.where(use, y, 0.0)
        weight = np.where(use, self._certainty, 0.0)
        if float(weight @ self.wall.lifts**2) < TRACKING.min_share * self._whole:
            return self._result(State.MOVED if self.moved else State.LOST, expected)
        d, weight = self._displacement(y, weight, expected)
        if not weight.any():
            return self._result(State.MOVED if self.moved else State.LOST, expected)
        still = y - self.wall.lifts * d
        elapsed = min(t_s - self._last_s, TRACKING.gap_s)
        self._weigh_error(elapsed, still, weight)
        self._weigh_motion(elapsed, still, weight)
        self._last_s = t_s
        noise = float(np.sqrt(1 / (weight @ self.wall.lifts**2) + self._shared))
        surprise = abs(d - expected)
        if (
            surprise > max(TRACKING.surprise * np.hypot(spread, noise), TRACKING.surprise_m)
            or d > TRACKING.deep * self._filter.depth + TRACKING.surprise_m
        ):
            self._calm_s = t_s + TRACKING.calm_s
        if surprise > TRACKING.surprise * np.hypot(spread, noise) and surprise > TRACKING.surprise_m:
            self._filter.forget(d)
        else:
            self._filter.update(d, noise)
        self._filter.remember(d)
        if self.moved:
            return self._result(State.MOVED, d)
        quiet = t_s >= self._calm_s
        if quiet:
            self.average.add(still, weight > 0)
        return self._result(State.QUIET if quiet else State.SPOILED, float(self._filter.forecast(np.zeros(1))[0]))

    def _result(self, state: State, d: float) -> Followed:
        shift = np.append((self._motion - self._drift)[1:3], 0.0) if state is State.MOVED else np.zeros(3)
        sigma = float(np.hypot(self._filter.sigma, np.sqrt(self._shared)))
        return Followed(state, float(d), self._filter.forecast(FORECAST_S), sigma, shift)

    def _displacement(self, y: Array, weight: Array, expected: float) -> tuple[float, Array]:
        """Return the displacement by the breath [m] and the pixels' weights: Tukey's biweight, first about the median."""
        lifts = self.wall.lifts
        clear = (weight > 0) & (lifts > 0.3)
        d = float(np.median(y[clear] / lifts[clear])) if clear.any() else expected
        robust = weight
        for _ in range(2):
            away = (y - lifts * d) ** 2 * self._certainty / TRACKING.tukey**2
            robust = weight * np.clip(1 - away, 0, None) ** 2
            d = float(robust @ (lifts * y)) / max(float(robust @ lifts**2), 1e-9)
        return d, robust

    def _weigh_error(self, elapsed_s: float, left: Array, weight: Array) -> None:
        """Update the shared pixel error by the residual [m], shape (n,), of an image `elapsed_s` [s] after the last."""
        variance = jackknife(left, weight, self.wall.lifts, self._patch)
        if variance is not None:
            self._shared += (1 - np.exp(-elapsed_s / TRACKING.shared_error_tau_s)) * (0.5 * variance - self._shared)

    def _weigh_motion(self, elapsed_s: float, left: Array, weight: Array) -> None:
        """Update the rigid motion by the residual [m], shape (n,), of an image `elapsed_s` [s] after the last."""
        weighted = weight[:, np.newaxis] * self._reasons
        self._precision = MOTION.memory * self._precision + (1 - MOTION.memory) * self._reasons.T @ weighted
        self._pull = MOTION.memory * self._pull + (1 - MOTION.memory) * weighted.T @ left
        moving = self.moved_by > MOTION.min_m and self.evidence > MOTION.threshold * self._usual
        self._votes = self._votes + 1 if moving else 0
        if not self._votes and not self.moved:
            evidence = min(self.evidence, MOTION.mean_clip * self._usual)
            self._usual = max(1.0, self._usual + (1 - np.exp(-elapsed_s / MOTION.mean_tau_s)) * (evidence - self._usual))
            self._drift += (1 - np.exp(-elapsed_s / MOTION.drift_tau_s)) * (self._motion - self._drift)
        self.moved = self.moved or self._votes >= MOTION.images

    @property
    def _motion(self) -> Array:
        """Return the residual d, s_x, s_y and theta, shape (4,)."""
        return np.asarray(np.linalg.solve(self._precision + self._prior, self._pull))

    @property
    def evidence(self) -> float:
        """Squared Mahalanobis distance of the body's motion from none, by its posterior covariance."""
        covariance = np.linalg.inv(self._precision + self._prior)[1:, 1:]
        motion = (self._motion - self._drift)[1:]
        return float(motion @ np.linalg.solve(covariance, motion))

    @property
    def moved_by(self) -> float:
        """Motion of the region [m], root mean square over its corners, without a common rise."""
        _, s_x, s_y, theta = self._motion - self._drift
        moved = np.array((s_x, s_y, 0.0)) + np.cross((0.0, theta, 0.0), self._corners)
        moved[:, 2] -= moved[:, 2].mean()
        return float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))


def jackknife(left: Array, weight: Array, lifts: Array, patch: Indices) -> float | None:
    """Return the variance [m^2] of d by patches, from residual [m], weight, mode and patch of each pixel, (n,) each.

    None if one patch has more weight than all others together, since the shared error is then unknown.
    """
    total, pull = np.bincount(patch, weight * lifts**2), np.bincount(patch, weight * lifts * left)
    if not total.any() or total.max() > 0.5 * total.sum():
        return None
    return float(np.sum((pull / (total.sum() - total)) ** 2))


def _patches(p_A: Array) -> Indices:
    """Return the number of the patch of the wall for each position [m], shape (n, 3) -> (n,)."""
    cell = np.floor((p_A[:, :2] - p_A[:, :2].min(axis=0)) / TRACKING.patch_m).astype(np.intp)
    return np.asarray(np.unique(cell, axis=0, return_inverse=True)[1]).ravel()
