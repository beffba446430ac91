"""The regression: log-force as a field over the belly, and errors in depth, time and force, all Gaussian.

    y = z(x) + (n - n0) log(d / D) + (n / d) (onset + stroke zero + breathing left over + surface(x)) + force zero / F_s + noise

y is the log force, d the depth, D the depth of the standard press, n the exponent of this wall and n0 the usual one, and F_s the
median force of the stroke. z is a sum of fields of several lengths, of vertical strips that are symmetric about the midline
(muscles and the linea alba), of bone where ribs and iliac crests may lie, and of the lumps that were detected. The amplitudes of
all parts but the lumps are found as the mode of their posterior under log-normal priors (Rasmussen and Williams 2006, ch. 5):
K = K0 + sum_j exp(2 a_j) K_j.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.linalg.lapack import dpotri
from scipy.optimize import minimize

from palpate_assessment.shapes import Bump, smooth
from palpate_assessment.standard import Observations, PressStandard
from palpate_models.numerics.frames import Array


class Prior(NamedTuple):
    """Prior of the field of log force, and limits of the fit of its amplitudes."""

    field_sd: float = 0.08
    """Prior median SD of one field [log force]; six fields give 0.2 in total."""
    bone_sd: float = 0.5
    """Prior median SD of bone [log force]."""
    level_sd: float = 3.0
    """SD of the patient's own level about the median of the samples."""
    field_log_sd: float = 0.7
    """SD of the log-amplitudes of fields about their prior medians."""
    error_log_sd: float = 1.2
    """SD of the log-amplitudes of errors and bone about their prior medians."""
    lump_sd: float = 1.0
    """SD of a lump's log-contrast."""
    free_sd: float = 0.25
    """SD of the log-contrast about the ideal shape, for slides over an abdomen."""
    free_press_sd: float = 0.1
    """SD of the log-contrast about the ideal shape, for presses: a larger one would make a wide lump rough, and so improbable."""

    def free(self, standard: PressStandard) -> float:
        """Return the SD of a lump's difference from the ideal shape."""
        return self.free_press_sd if standard.anatomy is None else self.free_sd

    max_fit_samples: int = 250
    """Maximum number of samples in the fit of the amplitudes, for strokes that overlap."""
    max_fit_presses: int = 800
    """Maximum number in that fit of presses, each its own stroke."""
    first_steps: int = 20
    """Optimizer steps from the prior medians."""
    steps: int = 6
    """Optimizer steps from the amplitudes of an earlier fit."""


PRIOR = Prior()
KINDS_OF_ERROR = 4
"""Length of `error_covariances`."""


def cholesky_inverse(L: Array) -> Array:
    """Return the inverse of L L^T, where L is a lower Cholesky factor, shape (m, m)."""
    found = np.tril(dpotri(L, lower=True)[0])
    found += np.tril(found, -1).T
    return np.asarray(found)


def field_covariances(a: Array, b: Array, standard: PressStandard) -> list[Array]:
    """Return unit covariances of the fields of natural variation between places a (k, 2) and b (l, 2), each of shape (k, l).

    With an anatomy, the last two are of strips and of bone. Without one, distances count between points of the skin: on a steep
    side of a body, places are further apart than from above.
    """
    on_a, on_b = (p if standard.places is None else standard.places.lift(p) for p in (a, b))
    parts = [smooth(on_a, on_b, length) for length in standard.lengths.fields_m]
    if (anatomy := standard.anatomy) is None:
        return parts
    fold = np.array((1.0, 0.0))
    folded_a, folded_b = (np.where(fold > 0, np.abs(p), p) for p in (a, b))
    strips = smooth(folded_a, folded_b, np.array(anatomy.strip_m))
    return [*parts, strips, np.outer(anatomy.bone(a), anatomy.bone(b)) * smooth(a, b, anatomy.bone_m)]


def lump_covariance(lump: Bump, a: Array, b: Array, standard: PressStandard) -> Array:
    """Return the prior covariance of a lump's log-contrast between places a (k, 2) and b (l, 2), shape (k, l)."""
    near = 2 * lump.edge
    free = PRIOR.free(standard) ** 2 * np.outer(lump(a, near), lump(b, near)) * smooth(a, b, standard.lengths.free_m)
    return np.asarray(PRIOR.lump_sd**2 * np.outer(lump(a), lump(b)) + free)


def lump_variance(lump: Bump, xy: Array, standard: PressStandard) -> Array:
    """Return the prior variance of a lump's log-contrast at places: the diagonal of `lump_covariance`, shape (k, 2) -> (k,)."""
    return np.asarray((PRIOR.lump_sd * lump(xy)) ** 2 + (PRIOR.free(standard) * lump(xy, 2 * lump.edge)) ** 2)


def error_covariances(o: Observations) -> list[Array]:
    """Return unit covariances of the fitted errors: stroke zero, breathing [m], zero of force [N], noise [1]; shape (m, m).

    The zero shared by all strokes uses the median 1/F for every sample. With each stroke's own 1/F, low forces over soft tissue
    would count as evidence for a zero error and raise the level.
    """
    lever, weakness = np.outer(o.per_metre, o.per_metre), np.outer(o.per_newton, o.per_newton)
    breathing = np.exp(-np.abs(o.time[:, None] - o.time) / o.standard.errors.breathing_s)
    return [
        lever * o.same_stroke,
        lever * breathing,
        weakness * o.same_stroke + o.standard.errors.shared_tare * float(np.median(o.per_newton)) ** 2,
        np.eye(len(o.y)),
    ]


def fixed_covariance(o: Observations) -> Array:
    """Return the covariance of level, exponent, surface and sensor, which a scan cannot estimate; shape (m, m)."""
    e = o.standard.errors
    lever = np.outer(o.per_metre, o.per_metre)
    surface = e.surface_share**2 * smooth(o.xy, o.xy, e.surface_m) + e.wide_share**2 * smooth(o.xy, o.xy, e.wide_m)
    surface = (surface * np.outer(o.depth_uncertainty, o.depth_uncertainty) + e.onset_m**2) * lever
    calibration = o.standard.calibration
    covariance = PRIOR.level_sd**2 + calibration.exponent_sd**2 * np.outer(o.log_depth, o.log_depth) + surface
    covariance += calibration.conversion_sd**2 * np.outer(o.slid, o.slid) + e.rate_sd**2 * np.outer(o.rate, o.rate)
    covariance[np.diag_indices(len(o.y))] += o.noise**2
    return np.asarray(covariance)


def _log_amplitude_prior(o: Observations) -> tuple[Array, Array]:
    """Return mean and standard deviation of the prior of the log-amplitudes."""
    e, standard = o.standard.errors, o.standard
    depth = max(0.5 * float(np.median(o.depth_uncertainty)), e.min_depth_m)
    fields = [PRIOR.field_sd] * len(standard.lengths.fields_m)
    bones = [] if standard.anatomy is None else [PRIOR.field_sd, PRIOR.bone_sd]
    medians = [*fields, *bones, depth, depth, standard.tare_n, e.white_sd]
    field, error = PRIOR.field_log_sd, PRIOR.error_log_sd
    return np.log(medians), np.array([field] * len(fields) + [field, error][: len(bones)] + [error, error, field, error])


def prior_log_amplitudes(o: Observations) -> Array:
    """Return the prior means of the log-amplitudes."""
    return _log_amplitude_prior(o)[0]


def fit_log_amplitudes(o: Observations, lumps: Sequence[Bump], start: Array | None = None) -> Array:
    """Return the log-amplitudes of fields and errors at the mode of their posterior, given the lumps."""
    limit = PRIOR.max_fit_presses if o.standard.anatomy is None else PRIOR.max_fit_samples
    subset = o.part(slice(None, None, -(-len(o.y) // limit)))
    parts = np.array(field_covariances(subset.xy, subset.xy, o.standard) + error_covariances(subset))
    rest = fixed_covariance(subset) + sum(lump_covariance(lump, subset.xy, subset.xy, o.standard) for lump in lumps)
    mean, sd = _log_amplitude_prior(o)
    y = subset.y - np.median(o.y)

    def loss(a: Array) -> tuple[float, Array]:
        variance = np.exp(2 * a)
        L = cholesky(rest + np.tensordot(variance, parts, 1), lower=True)
        weights = cho_solve((L, True), y)
        precision = cholesky_inverse(L)
        difference = (a - mean) / sd
        value = 0.5 * y @ weights + np.log(np.diag(L)).sum() + 0.5 * difference @ difference
        slope = variance * np.tensordot(parts, precision - np.outer(weights, weights), 2) + difference / sd
        return float(value), slope

    bounds = list(zip(mean - 3 * sd, mean + 3 * sd, strict=True))
    first, steps = (mean, PRIOR.first_steps) if start is None else (start, PRIOR.steps)
    found = minimize(loss, first, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": steps})
    return np.asarray(found.x)


@dataclass(frozen=True)
class Regression:
    """The field given the samples."""

    observations: Observations
    lumps: tuple[Bump, ...]
    log_amplitudes: Array

    @cached_property
    def level(self) -> float:
        """Median of the observations; the prior of the level is centred on it."""
        return float(np.median(self.observations.y))

    @cached_property
    def transfer_variance(self) -> float:
        """Variance of a standard press's log force about the field [1].

        With an anatomy it is that of the difference from held presses and slides, otherwise that of each press's own errors.
        """
        o, e = self.observations, self.observations.standard.errors
        if o.standard.anatomy is not None:
            return e.press_sd**2 + e.slide_sd**2
        fitted = zip(self.log_amplitudes[-KINDS_OF_ERROR:], error_covariances(o), strict=True)
        own = sum(np.exp(2 * log_amplitude) * np.diag(part) for log_amplitude, part in fitted)
        return float(np.median(own + o.noise**2))

    @cached_property
    def cholesky_factor(self) -> Array:
        """Lower Cholesky factor of the observations' covariance, shape (m, m)."""
        o = self.observations
        covariance = fixed_covariance(o)
        parts = field_covariances(o.xy, o.xy, o.standard) + error_covariances(o)
        for log_amplitude, part in zip(self.log_amplitudes, parts, strict=True):
            covariance += np.exp(2 * log_amplitude) * part
        for lump in self.lumps:
            covariance += lump_covariance(lump, o.xy, o.xy, o.standard)
        return np.asarray(cholesky(covariance, lower=True))

    @cached_property
    def whitened(self) -> Array:
        """Observations in units of their standard deviation, decorrelated, shape (m,)."""
        return self.whiten(self.observations.y - self.level)

    @property
    def log_evidence(self) -> float:
        """Log of the joint probability density of observations and log-amplitudes, up to an additive constant."""
        mean, sd = _log_amplitude_prior(self.observations)
        off = (self.log_amplitudes - mean) / sd
        return float(-0.5 * (self.whitened @ self.whitened + off @ off) - np.log(np.diag(self.cholesky_factor)).sum())

    def whiten(self, columns: Array) -> Array:
        """Return L^-1 times vectors over the samples, L the Cholesky factor, shape (m,) or (m, k)."""
        return np.asarray(solve_triangular(self.cholesky_factor, columns, lower=True))

    def healthy_covariance(self, a: Array, b: Array) -> Array:
        """Return the covariance of the field without lumps between places, shape (k, l)."""
        parts = zip(self.log_amplitudes, field_covariances(a, b, self.observations.standard), strict=False)
        return np.asarray(PRIOR.level_sd**2 + sum(np.exp(2 * log_amplitude) * part for log_amplitude, part in parts))

    def lump_covariance(self, a: Array, b: Array) -> Array:
        """Return the covariance of all lumps together between places, shape (k, l)."""
        covariances = (lump_covariance(lump, a, b, self.observations.standard) for lump in self.lumps)
        return np.asarray(sum(covariances, np.zeros((len(a), len(b)))))

    def field(self, xy: Array) -> tuple[Array, Array]:
        """Return posterior mean and standard deviation of z at places [m], shape (k, 2) -> (k,) each."""
        o = self.observations
        whitened_cross = self.whiten(self.healthy_covariance(o.xy, xy) + self.lump_covariance(o.xy, xy))
        anatomy, e = o.standard.anatomy, o.standard.errors
        variances = np.exp(2 * self.log_amplitudes[:-KINDS_OF_ERROR])
        last = 1.0 if anatomy is None else anatomy.bone(xy) ** 2
        prior = PRIOR.level_sd**2 + variances[:-1].sum() + variances[-1] * last
        for lump in self.lumps:
            prior = prior + lump_variance(lump, xy, o.standard)
        variance = np.maximum(prior - (whitened_cross**2).sum(axis=0), 1e-8) + self.transfer_variance
        if self.lumps and e.lump_press_sd:
            variance += (e.lump_press_sd * (self.whitened @ self.whiten(self.lump_covariance(o.xy, xy)))) ** 2
        return self.level + self.whitened @ whitened_cross, np.sqrt(variance)

    def smooth(self, xy: Array) -> Array:
        """Return the posterior mean of the smooth fields at places [m], shape (k, 2) -> (k,)."""
        o, lengths = self.observations, self.observations.standard.lengths
        fields = zip(self.log_amplitudes, lengths.fields_m, strict=False)
        parts = [np.exp(2 * size) * smooth(o.xy, xy, length) for size, length in fields if length >= lengths.smooth_m]
        return self.whitened @ self.whiten(np.sum(parts, axis=0))

    def contrast(self, lump: Bump, xy: Array) -> tuple[Array, Array]:
        """Return posterior mean (k,) and covariance (k, k) of one lump's log-contrast at places [m], shape (k, 2)."""
        o = self.observations
        whitened_cross = self.whiten(lump_covariance(lump, o.xy, xy, o.standard))
        return self.whitened @ whitened_cross, lump_covariance(lump, xy, xy, o.standard) - whitened_cross.T @ whitened_cross
