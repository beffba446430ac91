"""The regression: log-force as a field over the belly, and errors in depth, time and force, all Gaussian.

    y = z(x) + (n - n0) log(d / D) + (n / d) (onset + stroke zero + breathing left over + surface(x)) + force zero / F_s + noise

z is a sum of fields of several lengths, of vertical strips that are symmetric about the midline (muscles and the linea alba), of
bone where ribs and iliac crests may lie, and of the lumps that were detected. The amplitudes of all parts but the lumps are found
as the mode of their posterior under log-normal priors (Rasmussen and Williams 2006, ch. 5): K = K0 + sum_j exp(2 a_j) K_j.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.linalg.lapack import dpotri
from scipy.optimize import minimize
from scipy.spatial.distance import cdist
from scipy.special import erfc, expit

from palpate_assessment.calibration import Calibration
from palpate_assessment.observations import Observations
from palpate_models.numerics.frames import Array

LENGTHS_M = (0.012, 0.022, 0.045, 0.09, 0.18)
"""Lengths of the fields that natural variation is made of."""
SMOOTH_M = 0.045
"""Fields of this length and more are smooth: alike over a hand's breadth."""
STRIP_M = (0.018, 0.08)
"""Lengths of the strips, across and along the body."""
BONE_M = 0.022
"""Length over which bone changes what is felt."""
ARCH_M, ARCH_SLOPE, ARCH_WIDTH_M = 0.18, 0.7, 0.025
"""The costal arch above the umbilicus on the midline, its descent a metre off it, and how unsure both are."""
ILIAC_M, ILIAC_WIDTH_M = (0.135, -0.12), 0.04
"""Iliac spines, lateral to and below the umbilicus, and the width of the bone around them."""
NATURAL_SD, BONE_SD = 0.08, 0.5
"""Prior medians of the amplitudes: each field's share of 0.2 in the logarithm over all lengths; of bone."""
LEVEL_SD = 3.0
"""Standard deviation of the patient's own level about the median of his samples."""
BREATHING_S = 1.0
"""Correlation time of residual breathing."""
LEAST_DEPTH_ERROR_M = 0.0001
"""Prior median of the depth's errors for strokes that claim to have none."""
SURFACE_M, SURFACE_SHARE = 0.015, 0.8
"""Correlation length of the surface error that strokes share (without offset and tilt), and its share of the depth
uncertainty. A scan cannot separate it from stiffness."""
WIDE_M, WIDE_SHARE = 0.15, 0.7
"""The same of the offset and tilt that remain after touches."""
SLIDE_SD = 0.015
"""SD of the log difference of slide and press from place to place, besides the common one."""
UNLIKE = 0.1
"""SD of the difference of press and slide over a lump, as a share of its log-contrast."""
ONSET_M = 0.00015
"""Error common to all touches: 0.11 mm with typical equipment, RMS over twelve examinations, 0.29 mm with poor, over ten
(tuning seeds) [C]. The contact model does not fit every wall exactly, and skin that was pressed before is lower."""
TARE_N = 0.06
"""Prior median of the zero of a stroke's force: 0.06 N with typical equipment, 0.12 N with poor (tuning seeds 0 to 9) [C]. What
all strokes share, by gain, cross-talk and the tool's weight, is expected to be as large: with poor equipment 0.08 N there [C]."""
WHITE_SD = 0.01
"""Prior median of what a sample gets wrong by itself, over the force."""
_SURE, _UNSURE = 0.7, 1.2
"""Standard deviations of the logarithms of amplitudes about their medians: of stiffness, of errors."""
_FITTED, _FIRST_STEPS, _STEPS = 250, 20, 6
"""Number of samples for the estimation of amplitudes, and of steps from their medians and from earlier values."""
EDGE_M = 0.007
"""Standard deviation of the edge with which a lump at the skin is felt: the indenter's footprint."""
LUMP_SD, LUMP_FREE_SD, LUMP_FREE_M = 1.0, 0.25, 0.012
"""Prior of a lump's log-contrast; and how it may differ from the ideal shape, and over which length."""


@dataclass(frozen=True)
class Bump:
    """The shape in which a round lump is felt: 1 inside, 0 outside, with a soft edge."""

    x: float
    y: float
    """Centre [m]."""
    radius: float
    """[m]"""
    edge: float = EDGE_M
    """Standard deviation of its edge [m]."""

    def __call__(self, xy: Array, beyond: float = 0.0) -> Array:
        """Return the shape at places [m], shape (k, 2) -> (k,), its radius greater by `beyond`."""
        r = np.hypot(xy[:, 0] - self.x, xy[:, 1] - self.y)
        return np.asarray(0.5 * erfc((r - self.radius - beyond) / (np.sqrt(2) * self.edge)))

    def covariance(self, a: Array, b: Array) -> Array:
        """Prior covariance of the lump's log-contrast between places a (k, 2) and b (l, 2), shape (k, l)."""
        near = 2 * self.edge
        free = LUMP_FREE_SD**2 * np.outer(self(a, near), self(b, near)) * _smooth(a, b, LUMP_FREE_M)
        return np.asarray(LUMP_SD**2 * np.outer(self(a), self(b)) + free)


def _smooth(a: Array, b: Array, length: float | Array) -> Array:
    """Squared-exponential covariance, shape (k, l)."""
    return np.asarray(np.exp(-0.5 * cdist(a / length, b / length, "sqeuclidean")))


def inverse(triangle: Array) -> Array:
    """The inverse of a covariance whose lower Cholesky factor is `triangle`, shape (m, m)."""
    found = np.tril(dpotri(triangle, lower=True)[0])
    found += np.tril(found, -1).T
    return np.asarray(found)


def natural(a: Array, b: Array) -> list[Array]:
    """Unit covariances of the fields of natural variation between places a (k, 2) and b (l, 2), each of shape (k, l)."""
    fold = np.array((1.0, 0.0))
    folded_a, folded_b = (np.where(fold > 0, np.abs(p), p) for p in (a, b))
    strips = _smooth(folded_a, folded_b, np.array(STRIP_M))
    over_bone = np.outer(bone(a), bone(b)) * _smooth(a, b, BONE_M)
    return [*(_smooth(a, b, length) for length in LENGTHS_M), strips, over_bone]


def bone(xy: Array) -> Array:
    """Return the prior of ribs or iliac crests under places of the abdomen [m], shape (k, 2) -> (k,)."""
    lateral, up = np.abs(xy[:, 0]), xy[:, 1]
    ribs = expit((up - ARCH_M + ARCH_SLOPE * lateral) / ARCH_WIDTH_M)
    spine = np.exp(-0.5 * ((lateral - ILIAC_M[0]) ** 2 + (up - ILIAC_M[1]) ** 2) / ILIAC_WIDTH_M**2)
    return np.asarray(np.maximum(ribs, spine))


def errors(o: Observations) -> list[Array]:
    """Unit covariances of errors whose amplitude is found: stroke zero, breathing [m], zero of force [N], noise [1]; (m, m)."""
    lever, weakness = np.outer(o.per_metre, o.per_metre), np.outer(o.per_newton, o.per_newton)
    breathing = np.exp(-np.abs(o.time[:, None] - o.time) / BREATHING_S)
    return [lever * o.same_stroke, lever * breathing, weakness * (1.0 + o.same_stroke), np.eye(len(o.y))]


def fixed(o: Observations, calibration: Calibration) -> Array:
    """Return the covariance of level, exponent, surface and sensor, which a scan cannot estimate; shape (m, m)."""
    lever = np.outer(o.per_metre, o.per_metre)
    surface = SURFACE_SHARE**2 * _smooth(o.xy, o.xy, SURFACE_M) + WIDE_SHARE**2 * _smooth(o.xy, o.xy, WIDE_M)
    surface = (surface * np.outer(o.depth_uncertainty, o.depth_uncertainty) + ONSET_M**2) * lever
    covariance = LEVEL_SD**2 + calibration.exponent_sd**2 * np.outer(o.log_depth, o.log_depth) + surface
    covariance[np.diag_indices(len(o.y))] += o.noise**2
    return np.asarray(covariance)


def _medians(o: Observations) -> tuple[Array, Array]:
    """Prior of the log-amplitudes: medians' logarithms and standard deviations."""
    depth = max(0.5 * float(np.median(o.depth_uncertainty)), LEAST_DEPTH_ERROR_M)
    fields = len(LENGTHS_M) + 1
    medians = [NATURAL_SD] * fields + [BONE_SD, depth, depth, TARE_N, WHITE_SD]
    return np.log(medians), np.array([_SURE] * fields + [_UNSURE] * 3 + [_SURE, _UNSURE])


def usual_amplitudes(o: Observations) -> Array:
    """Log-amplitudes before anything is known of the patient."""
    return _medians(o)[0]


def amplitudes(o: Observations, calibration: Calibration, lumps: Sequence[Bump], start: Array | None = None) -> Array:
    """Log-amplitudes of the natural fields and the errors under which the data are most likely, given the lumps."""
    few = o.part(slice(None, None, -(-len(o.y) // _FITTED)))
    parts = np.array(natural(few.xy, few.xy) + errors(few))
    rest = fixed(few, calibration) + sum(lump.covariance(few.xy, few.xy) for lump in lumps)
    middle, spread = _medians(o)
    y = few.y - np.median(o.y)

    def loss(a: Array) -> tuple[float, Array]:
        variance = np.exp(2 * a)
        triangle = cholesky(rest + np.tensordot(variance, parts, 1), lower=True)
        weights = cho_solve((triangle, True), y)
        precision = inverse(triangle)
        difference = (a - middle) / spread
        value = 0.5 * y @ weights + np.log(np.diag(triangle)).sum() + 0.5 * difference @ difference
        slope = variance * np.tensordot(parts, precision - np.outer(weights, weights), 2) + difference / spread
        return float(value), slope

    bounds = list(zip(middle - 3 * spread, middle + 3 * spread, strict=True))
    first, steps = (middle, _FIRST_STEPS) if start is None else (start, _STEPS)
    found = minimize(loss, first, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": steps})
    return np.asarray(found.x)


@dataclass(frozen=True)
class Regression:
    """The field given the samples."""

    observations: Observations
    calibration: Calibration
    lumps: tuple[Bump, ...]
    log_amplitudes: Array

    @cached_property
    def level(self) -> float:
        """Median of the observations, about which the level is sought."""
        return float(np.median(self.observations.y))

    @cached_property
    def triangle(self) -> Array:
        """Lower Cholesky factor of the observations' covariance, shape (m, m)."""
        o = self.observations
        covariance = fixed(o, self.calibration)
        for log_amplitude, part in zip(self.log_amplitudes, natural(o.xy, o.xy) + errors(o), strict=True):
            covariance += np.exp(2 * log_amplitude) * part
        for lump in self.lumps:
            covariance += lump.covariance(o.xy, o.xy)
        return np.asarray(cholesky(covariance, lower=True))

    @cached_property
    def whitened(self) -> Array:
        """Observations in units of their standard deviation, decorrelated, shape (m,)."""
        return self.whiten(self.observations.y - self.level)

    def whiten(self, columns: Array) -> Array:
        """L^-1 times vectors over the samples, shape (m,) or (m, k)."""
        return np.asarray(solve_triangular(self.triangle, columns, lower=True))

    def healthy_covariance(self, a: Array, b: Array) -> Array:
        """Covariance of the field without lumps between places, shape (k, l)."""
        parts = zip(self.log_amplitudes, natural(a, b), strict=False)
        return np.asarray(LEVEL_SD**2 + sum(np.exp(2 * log_amplitude) * part for log_amplitude, part in parts))

    def lump_covariance(self, a: Array, b: Array) -> Array:
        """Covariance of all lumps together between places, shape (k, l)."""
        return np.asarray(sum((lump.covariance(a, b) for lump in self.lumps), np.zeros((len(a), len(b)))))

    def field(self, xy: Array) -> tuple[Array, Array]:
        """Posterior mean and standard deviation of z at places [m], shape (k, 2) -> (k,) each."""
        o = self.observations
        seen = self.whiten(self.healthy_covariance(o.xy, xy) + self.lump_covariance(o.xy, xy))
        variances = np.exp(2 * self.log_amplitudes[: len(LENGTHS_M) + 2])
        prior = LEVEL_SD**2 + variances[:-1].sum() + variances[-1] * bone(xy) ** 2
        prior = prior + sum((LUMP_SD * lump(xy)) ** 2 + (LUMP_FREE_SD * lump(xy, 2 * lump.edge)) ** 2 for lump in self.lumps)
        variance = np.maximum(prior - (seen**2).sum(axis=0), 1e-8) + self.calibration.conversion_sd**2 + SLIDE_SD**2
        if self.lumps:
            variance += (UNLIKE * (self.whitened @ self.whiten(self.lump_covariance(o.xy, xy)))) ** 2
        return self.level + self.whitened @ seen, np.sqrt(variance)

    def smooth(self, xy: Array) -> Array:
        """Posterior mean of the smooth fields at places [m], shape (k, 2) -> (k,)."""
        o = self.observations
        fields = zip(self.log_amplitudes, LENGTHS_M, strict=False)
        parts = [np.exp(2 * log_amplitude) * _smooth(o.xy, xy, length) for log_amplitude, length in fields if length >= SMOOTH_M]
        return self.whitened @ self.whiten(np.sum(parts, axis=0))

    def contrast(self, lump: Bump, xy: Array) -> tuple[Array, Array]:
        """Posterior mean (k,) and covariance (k, k) of one lump's log-contrast at places [m], shape (k, 2)."""
        seen = self.whiten(lump.covariance(self.observations.xy, xy))
        return self.whitened @ seen, lump.covariance(xy, xy) - seen.T @ seen
