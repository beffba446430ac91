"""Estimated abdominal wall: the perceived surface, corrected by touches and moved by the breath.

At a position x in A's xy plane the wall is outward of the perceived surface by

    c(x) + m(x) w(t)

with the correction c (`TouchCorrection`), the breathing mode m (`perception/surface`) and the displacement w where m is 1
(`Breath`: perception's forecasts in `perception/motion`, interpolated to any time). The correction is a Gaussian process.
Camera and arm agree to centimetres, but the error is smooth: an offset, a tilt,
and a bending field of the camera (parameters of `CorrectionPrior`),

    k(x, x') = offset_m^2 + tilt_rad^2 x.x' + a^2 field_m^2 exp(-|x - x'|^2 / (2 field_length_m^2)).

Each touch measures c at its position with an independent error s_i and the error of the breathing estimate b_i, which persists
for some seconds and is shared with the next touch. From n touches (Rasmussen and Williams 2006, eq. 2.25 and 2.26)

    c(x) = k(x)^T (K + S)^-1 y,     var c(x) = k(x, x) - k(x)^T (K + S)^-1 k(x),
    S_ij = s_i^2 [i = j] + b_i b_j exp(-|t_i - t_j| / PRIOR.persistence_s).

The roughness a of the error is estimated: of a few values the one with the highest posterior probability (their eq. 2.30).
Without camera error a becomes small, and the wall is known to within the error of a touch.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from math import exp, hypot, sqrt
from typing import NamedTuple

import numpy as np
from scipy.interpolate import NearestNDInterpolator
from scipy.linalg import cho_factor, cho_solve

from palpate_models.numerics.frames import Array
from palpate_planning.periods import MS, SECOND
from palpate_planning.wall.surface import Foot, PerceivedSurface
from palpate_planning.wall.touch import Onset, WallDepth

FORECAST_STEP = 50 * MS
"""Spacing of the forecast's values [ns]; the first is at the exposure."""
HIDDEN_M = 0.002
"""Uncertainty up to which an occluded wall is followed by forecast."""


class ForecastTuning(NamedTuple):
    """Blending of forecasts and estimation of their error."""

    stale_ns: int = 500 * MS
    """Age above which a motion is not followed: the length of the forecast."""
    join_s: float = 0.03
    """Time constant of the blend from one forecast to the next. During the blend the older forecast still adds its error (0.69 mm
    with 0.1 s, 0.53 mm with this; tuning seeds 1 and 2, 8 mm deep)."""
    inward_mps: float = 0.1
    """Maximum speed at which a receding wall is joined: four times that of a deep breath. A camera may be wrong."""
    steps_kept: float = 0.98
    """Forgetting factor of the mean square step per message: an average over 50 messages, about a breath."""
    exposures: int = 60
    """Number of exposures kept: 6 s, longer than a descent."""
    forecast_error_scale: float = 1.3
    """Scale on the error estimated from consecutive forecasts, whose errors are correlated (1.0-1.3, tuning seeds)."""


TUNING = ForecastTuning()


class BreathObservation(NamedTuple):
    """One message of perception about the breath."""

    stamp: int
    """Time of the exposure [ns]."""
    forecast: Array
    """Outward displacement [m] at `stamp` and every `FORECAST_STEP` after it, at the point that moves most; shape (k,)."""
    uncertainty: float
    """SD of the displacement [m]."""
    calm: bool
    """True if the wall is visible and follows the forecast: neither cough nor deep breath."""
    moved: bool = False
    """True if the patient has moved since the surface was perceived."""
    shift_A: tuple[float, float] = (0.0, 0.0)
    """Shift of the patient along the table since the first scan of the surface, in A [m]."""
    seen: bool = True
    """True if enough of the wall is visible; the arm may occlude it."""


class Breath:
    """Wall displacement at the point that moves most. Without messages the wall is at rest at the end of expiration."""

    def __init__(self) -> None:
        self._motion: BreathObservation | None = None
        self._gap, self._since = 0.0, 0
        """Last step between forecasts [m] and its time [ns]."""
        self._seen: deque[tuple[int, float]] = deque(maxlen=TUNING.exposures)
        """Times of exposures [ns] and measured displacements [m]."""
        self._steps, self._growths = 0.0, 0.0
        """Weighted number of steps, and weighted sum of r^2 in `uncertainty` [m^2/s^2]."""

    def receive(self, motion: BreathObservation, t: int) -> None:
        """Update with the latest motion of perception at `t` [ns]."""
        before, last = self.displacement(t), self._motion
        self._motion, self._gap = motion, 0.0
        self._seen.append((motion.stamp, float(motion.forecast[0])))
        if last is None:
            return
        self._gap, self._since = before - self.displacement(t), t
        if last.calm and motion.calm:
            longer = ((t - last.stamp) ** 2 - (t - motion.stamp) ** 2) / SECOND**2
            growth = self._gap**2 / max(longer, TUNING.join_s**2)
            self._steps, self._growths = 1.0 + TUNING.steps_kept * self._steps, growth + TUNING.steps_kept * self._growths

    def displacement(self, t: int) -> float:
        """Return the forecast displacement at `t` [ns], outward [m], blended with the previous forecast."""
        motion = self._motion
        if motion is None:
            return 0.0
        k = (t - motion.stamp) / FORECAST_STEP
        forecast = float(np.interp(k, np.arange(len(motion.forecast)), motion.forecast))
        since_s = (t - self._since) / SECOND
        return forecast + max(self._gap * exp(-since_s / TUNING.join_s), self._gap - TUNING.inward_mps * since_s)

    def measured_at(self, times: Array) -> Array | None:
        """Return measured displacements [m] at past times [ns], shape (n,), or None if not measured yet."""
        if not self._seen or self._seen[0][0] > times[0] or self._seen[-1][0] < times[-1]:
            return None
        exposed, displacement = zip(*self._seen, strict=True)
        return np.asarray(np.interp(times, exposed, displacement))

    @property
    def seen_uncertainty(self) -> float:
        """SD of a measured displacement [m]."""
        return 0.0 if self._motion is None else self._motion.uncertainty

    def uncertainty(self, t: int) -> float:
        """Return the SD of the displacement [m] at `t` [ns].

        The forecast error grows with its age, sigma(t)^2 = sigma_0^2 + (r (t - t_0))^2. r is estimated from the mean square step
        when a forecast is replaced by the next one.
        """
        if self._motion is None:
            return 0.0
        rate = TUNING.forecast_error_scale * sqrt(self._growths / self._steps) if self._steps else 0.0
        return hypot(self._motion.uncertainty, rate * (t - self._motion.stamp) / SECOND)

    def calm(self, t: int) -> bool:
        """Return True if the forecast is reliable at `t` [ns]."""
        return self._motion is None or (self._motion.calm and t - self._motion.stamp <= TUNING.stale_ns)

    @property
    def shift_A(self) -> Array:
        """Shift of the patient along the table since the first scan of the surface, in A [m], shape (2,)."""
        return np.zeros(2) if self._motion is None else np.array(self._motion.shift_A)

    @property
    def hidden(self) -> bool:
        """True if the wall is occluded."""
        return self._motion is not None and not self._motion.seen

    @property
    def moved(self) -> bool:
        """True if the patient has moved."""
        return self._motion is not None and self._motion.moved


ROUGHNESSES = 2.0 ** np.arange(-5, 2)
"""Candidate values of a."""


class CorrectionPrior(NamedTuple):
    """Prior of the correction."""

    offset_m: float = 0.012
    """SD of the offset before any touch: camera and its calibration, arm and warm-up together (computed)."""
    tilt_rad: float = 0.025
    """SD of the tilt about two axes: a laterally displaced camera sees a curved wall tilted, by 18 mrad on 12 tuning patients."""
    field_m: float = 0.0006
    """SD of the remaining camera field and of its drift beyond the fused frames: 0.50 mm on these patients."""
    field_length_m: float = 0.020
    """Correlation length of that field, from the variogram of these patients."""
    log_roughness_sd: float = 0.5
    """SD of log a about its expected value (assumed)."""
    persistence_s: float = 10.0
    """Time constant of depth errors shared by neighbouring pixels."""
    mean_image_roughness: float = 0.35
    """Expected a of a surface averaged over the images of a whole examination."""


PRIOR = CorrectionPrior()


class HeightMeasurement(NamedTuple):
    """Height of the wall measured by a touch."""

    xy_A: Array
    """Position in A [m], shape (2,)."""
    height: float
    """Distance outward of the perceived surface [m]."""
    sigma: float
    """SD of the independent error [m]."""
    breath_sigma: float = 0.0
    """SD of the breathing estimate's error, which persists for some seconds [m]."""
    t_s: float = 0.0
    """Time [s]."""


class TouchCorrection:
    """The outward correction c(x) [m] and its SD. Positions are in A's xy plane [m]."""

    def __init__(self, expected_roughness: float = 1.0) -> None:
        """`expected_roughness`: expected a, 1 for the surface of one camera burst."""
        self._expected = expected_roughness
        self._touches: tuple[HeightMeasurement, ...] = ()
        self._blurred = np.empty(0)
        """Variance added to each touch by later scans of the surface [m^2]."""
        self._learn()

    def touch(self, touch: HeightMeasurement) -> None:
        """Add a touch."""
        self._touches = (*self._touches, touch)
        self._blurred = np.append(self._blurred, 0.0)
        self._learn()

    def revise(self, touch: HeightMeasurement) -> None:
        """Replace the latest touch."""
        self._touches = (*self._touches[:-1], touch)
        self._learn()

    def blur(self) -> None:
        """Account for a new scan of the surface: earlier touches still inform offset and tilt, but not the field."""
        self._blurred = self._blurred + 2 * (self._fit.roughness * PRIOR.field_m) ** 2
        self._learn()

    def _learn(self) -> None:
        self._places = np.array([touch.xy_A for touch in self._touches]).reshape(-1, 2)
        heights = np.array([touch.height for touch in self._touches])
        errors = _errors(self._touches) + np.diag(self._blurred)
        fits = (_fit(float(a), self._expected, self._places, heights, errors) for a in ROUGHNESSES)
        self._fit = max(fits, key=lambda fit: fit.log_probability)

    def for_surface(self, outward: Callable[[Array], Array]) -> TouchCorrection:
        """Return the correction, from the same touches, of a better surface, `outward` [m] of this one at positions (n, 2)."""
        better = TouchCorrection(PRIOR.mean_image_roughness)
        less = outward(self._places)
        better._touches = tuple(t._replace(height=t.height - h) for t, h in zip(self._touches, less.tolist(), strict=True))
        better._blurred = self._blurred
        better._learn()
        return better

    def height(self, xy_A: Array) -> float:
        """Return c [m] at a position, shape (2,)."""
        return float(_covariance(xy_A, self._places, self._fit.roughness) @ self._fit.weights)

    def at(self, xy_A: Array) -> tuple[float, float]:
        """Return c and its SD [m] at a position, shape (2,)."""
        height, sigma = self.over(xy_A[None])
        return float(height[0]), float(sigma[0])

    def over(self, xy_A: Array) -> tuple[Array, Array]:
        """Return c and its SD [m] at positions, shape (n, 2): shapes (n,)."""
        prior = PRIOR.offset_m**2 + PRIOR.tilt_rad**2 * (xy_A**2).sum(axis=1) + self._fit.roughness**2 * PRIOR.field_m**2
        k = _covariance(xy_A, self._places, self._fit.roughness)
        known = ((k @ self._fit.precision) * k).sum(axis=1)
        return k @ self._fit.weights, np.sqrt(np.maximum(prior - known, 0.0))


class _Fit(NamedTuple):
    """The process given the touches for one roughness."""

    roughness: float
    precision: Array
    """(K + S)^-1 [1/m^2]: evaluated at every step, changed rarely."""
    weights: Array
    """(K + S)^-1 y [1/m]."""
    log_probability: float
    """Log probability of touches and roughness up to a constant."""


def _errors(touches: Sequence[HeightMeasurement]) -> Array:
    """Return S, the covariance of the errors of n touches [m^2], shape (n, n)."""
    own, breath, t = np.array([(touch.sigma, touch.breath_sigma, touch.t_s) for touch in touches]).reshape(-1, 3).T
    return np.asarray(np.diag(own**2) + np.outer(breath, breath) * np.exp(-np.abs(t[:, None] - t) / PRIOR.persistence_s))


def _fit(roughness: float, expected: float, places: Array, heights: Array, errors: Array) -> _Fit:
    """Fit the process with expected roughness `expected` to touches at positions (n, 2) with heights (n,) [m] and errors S."""
    factor = cho_factor(_covariance(places, places, roughness) + errors, lower=True)
    weights = cho_solve(factor, heights)
    prior = -0.5 * (math.log(roughness / expected) / PRIOR.log_roughness_sd) ** 2
    evidence = -0.5 * float(heights @ weights) - float(np.log(np.diag(factor[0])).sum())
    return _Fit(roughness, cho_solve(factor, np.eye(len(heights))), weights, prior + evidence)


def _covariance(a: Array, b: Array, roughness: float) -> Array:
    """Return the prior covariance of positions a, shape (..., 2), and b, shape (n, 2): shape (..., n)."""
    apart = ((a[..., None, :] - b) ** 2).sum(axis=-1)
    field = PRIOR.field_m**2 * np.exp(-apart / (2 * PRIOR.field_length_m**2))
    return np.asarray(PRIOR.offset_m**2 + PRIOR.tilt_rad**2 * (a @ b.T) + roughness**2 * field)


class PublishedTouch(NamedTuple):
    """One touch of the wall, as published on `exam/touches`."""

    p_W: Array
    """Point of the perceived surface [m], shape (3,)."""
    stroke: int
    height: float
    """Measured height of the wall above the perceived surface at the end of expiration [m]."""
    sigma: float
    """SD of `height` [m]."""
    expected: float
    """Height predicted before the touch [m]."""
    expected_sigma: float
    """SD of `expected` [m]."""


class WallEstimate(NamedTuple):
    """Estimated wall at one position, outward of the perceived surface at the end of expiration."""

    correction: float
    """Correction from touches [m]."""
    displacement: float
    """Displacement by the breath [m]."""
    sigma: float
    """SD of the sum [m]."""


class Wall:
    """Estimated position of the wall and its uncertainty."""

    def __init__(self, perceived: PerceivedSurface, breath: Breath) -> None:
        """Start without correction."""
        self.perceived, self.breath = perceived, breath
        self.correction = TouchCorrection()
        self.shift_A = np.zeros(2)
        """Shift of the body along the table since the first scan of the surface, in A [m], shape (2,)."""
        self._first = perceived
        self._touched: tuple[Foot, float] | None = None
        """Foot of the latest touch and the correction there before it [m]."""

    def rescan(self, perceived: PerceivedSurface) -> None:
        """Take a new perceived surface; the offset and tilt learned from touches stay."""
        self.perceived, self.shift_A, self._touched = perceived, np.zeros(2), None
        self.correction.blur()

    def heights_above(self, vertices_W: Array, averaged: Array | None) -> tuple[Array, Array]:
        """Return the height of the wall above vertices of the perceived surface and its SD [m], shapes (n,).

        Uses all touches, and the height of the mean of all images above these vertices [m] if `averaged` is given.
        """
        xy = np.array([self.perceived.xy(p) for p in vertices_W])
        if averaged is None:
            return self.correction.over(xy)
        height, sigma = self.correction.for_surface(NearestNDInterpolator(xy, averaged)).over(xy)
        return averaged + height, sigma

    def point(self, foot: Foot, correction: float) -> tuple[Array, Array]:
        """Return the wall point `correction` [m] above `foot` and its outward normal, shapes (3,).

        Both refer to the body's position at the first scan, at the end of expiration, so that all samples share one frame.
        """
        if not self.shift_A.any():
            return foot.p_W + correction * foot.n_W, foot.n_W
        p, n = self._first.at((foot.xy_A - self.shift_A)[None])
        return p[0] + correction * n[0], n[0]

    def outward(self, p_W: Array, t: int) -> float:
        """Return the height of the wall above the perceived surface [m] at its point p_W, shape (3,), at `t` [ns]."""
        xy = self.perceived.xy(p_W)
        return self.correction.height(xy) + self.displacement(xy, t)

    def displacement(self, xy_A: Array, t: int) -> float:
        """Return the outward displacement by the breath [m] at a position, shape (2,), at `t` [ns]."""
        return self.perceived.breathing(xy_A) * self.breath.displacement(t)

    def at(self, xy_A: Array, t: int) -> WallEstimate:
        """Return the wall at a position, shape (2,), at `t` [ns]."""
        (correction, sigma), share = self.correction.at(xy_A), self.perceived.breathing(xy_A)
        return WallEstimate(
            correction, share * self.breath.displacement(t), math.hypot(sigma, share * self.breath.uncertainty(t))
        )

    def touch(self, foot: Foot, touch: WallDepth, stroke: int, t: int) -> tuple[PublishedTouch, float]:
        """Update the correction by a touch under `foot` at `t` [ns]; return the touch and the change in wall height [m]."""
        before, before_sigma = self.correction.at(foot.xy_A)
        moved = self.perceived.breathing(foot.xy_A) * self.breath.uncertainty(t)
        measured = HeightMeasurement(foot.xy_A, before - touch.depth, touch.sigma, moved, t / SECOND)
        self.correction.touch(measured)
        self._touched = foot, before
        observed = PublishedTouch(foot.p_W, stroke, measured.height, math.hypot(touch.sigma, moved), before, before_sigma)
        return observed, self.correction.height(foot.xy_A) - before

    def revise(self, onset: Onset) -> float | None:
        """Refit the last touch with measured instead of forecast breathing; return the change in wall height [m].

        Returns None while the breathing is not measured. With the forecast the error of a touch is 0.5 to 1.2 mm, with measured
        breathing half of that.
        """
        seen = self.breath.measured_at(onset.times)
        if seen is None or self._touched is None:
            return None
        foot, before = self._touched
        share, previous = self.perceived.breathing(foot.xy_A), self.correction.height(foot.xy_A)
        touch = onset.touch_again(share * seen)
        moved = share * self.breath.seen_uncertainty
        self.correction.revise(HeightMeasurement(foot.xy_A, before - touch.depth, touch.sigma, moved, onset.times[-1] / SECOND))
        return self.correction.height(foot.xy_A) - previous


def plane(X_WA: Array) -> Wall:
    """Return the xy plane of A at rest, used before the first perceived surface."""
    wall = Wall(PerceivedSurface.plane(X_WA), Breath())
    wall.perceived.nearest(np.zeros(3))  # compiles it before the first deadline
    return wall
