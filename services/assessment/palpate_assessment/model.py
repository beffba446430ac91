"""The regression: log-force as a field over the belly, and errors in depth, time and force, all Gaussian.

    y = z(x) + (n - n0) log(d / D) + (n / d) (onset + stroke zero + breathing left over + surface(x)) + force zero / F_s + noise

z is a sum of fields of several lengths, of vertical strips that are symmetric about the midline (muscles and the linea alba), of
bone where ribs and iliac crests may lie, and of the lumps that were detected. The amplitudes of all parts but the lumps are found
as the mode of their posterior under log-normal priors (Rasmussen and Williams 2006, ch. 5): K = K0 + sum_j exp(2 a_j) K_j.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.linalg.lapack import dpotri
from scipy.optimize import minimize

from palpate_assessment.observations import Observations
from palpate_assessment.shapes import Bump, smooth
from palpate_assessment.standard import PressStandard
from palpate_models.numerics.frames import Array


class Prior(NamedTuple):
    """Prior of the field in logarithms, and how its amplitudes are fitted."""

    natural_sd: float = 0.08
    """Median amplitude of a field: its share of 0.2 over all lengths."""
    bone_sd: float = 0.5
    """Median amplitude of bone."""
    level_sd: float = 3.0
    """SD of the patient's own level about the median of the samples."""
    sure: float = 0.7
    """SD of the logarithms of the fields' amplitudes about their medians."""
    unsure: float = 1.2
    """The same of errors and bone."""
    lump_sd: float = 1.0
    """SD of a lump's log-contrast."""
    free_sd: float = 0.25
    """SD of its difference from the ideal shape, felt by slides over an abdomen."""
    free_press_sd: float = 0.1
    """The same of presses: a larger one would count a wide lump as rough, and so as improbable."""

    def free(self, standard: PressStandard) -> float:
        """Return the SD of a lump's difference from the ideal shape."""
        return self.free_press_sd if standard.anatomy is None else self.free_sd

    fitted: int = 250
    """Number of samples for the estimation of amplitudes: of lines that overlap; of presses, each its own stroke, the next."""
    fitted_presses: int = 800
    first_steps: int = 20
    """Steps from the medians."""
    steps: int = 6
    """Steps from earlier values."""


PRIOR = Prior()
KINDS_OF_ERROR = 4
"""Number of the covariances of `errors`."""


def inverse(triangle: Array) -> Array:
    """The inverse of a covariance whose lower Cholesky factor is `triangle`, shape (m, m)."""
    found = np.tril(dpotri(triangle, lower=True)[0])
    found += np.tril(found, -1).T
    return np.asarray(found)


def natural(a: Array, b: Array, standard: PressStandard) -> list[Array]:
    """Unit covariances of the fields of natural variation between places a (k, 2) and b (l, 2), each of shape (k, l).

    With an anatomy, the last two are of strips and of bone. Without one, distances count between points of the skin: on a steep
    side of a body, places are further apart than from above.
    """
    on_a, on_b = (p if standard.places is None else standard.places.lifted(p) for p in (a, b))
    parts = [smooth(on_a, on_b, length) for length in standard.lengths.fields_m]
    if (anatomy := standard.anatomy) is None:
        return parts
    fold = np.array((1.0, 0.0))
    folded_a, folded_b = (np.where(fold > 0, np.abs(p), p) for p in (a, b))
    strips = smooth(folded_a, folded_b, np.array(anatomy.strip_m))
    return [*parts, strips, np.outer(anatomy.bone(a), anatomy.bone(b)) * smooth(a, b, anatomy.bone_m)]


def lump_covariance(lump: Bump, a: Array, b: Array, standard: PressStandard) -> Array:
    """Prior covariance of a lump's log-contrast between places a (k, 2) and b (l, 2), shape (k, l)."""
    near = 2 * lump.edge
    free = PRIOR.free(standard) ** 2 * np.outer(lump(a, near), lump(b, near)) * smooth(a, b, standard.lengths.free_m)
    return np.asarray(PRIOR.lump_sd**2 * np.outer(lump(a), lump(b)) + free)


def errors(o: Observations) -> list[Array]:
    """Unit covariances of errors whose amplitude is found: stroke zero, breathing [m], zero of force [N], noise [1]; (m, m).

    The zero that strokes share counts by one force for all: strokes over soft places are weak, so that by their own forces a soft
    place would be evidence for a zero, and raise the level.
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


def _medians(o: Observations) -> tuple[Array, Array]:
    """Prior of the log-amplitudes: medians' logarithms and standard deviations."""
    e, standard = o.standard.errors, o.standard
    depth = max(0.5 * float(np.median(o.depth_uncertainty)), e.least_depth_m)
    fields = [PRIOR.natural_sd] * len(standard.lengths.fields_m)
    bones = [] if standard.anatomy is None else [PRIOR.natural_sd, PRIOR.bone_sd]
    medians = [*fields, *bones, depth, depth, standard.tare_n, e.white_sd]
    spread = [PRIOR.sure] * len(fields) + [PRIOR.sure, PRIOR.unsure][: len(bones)]
    return np.log(medians), np.array([*spread, PRIOR.unsure, PRIOR.unsure, PRIOR.sure, PRIOR.unsure])


def usual_amplitudes(o: Observations) -> Array:
    """Log-amplitudes before anything is known of the patient."""
    return _medians(o)[0]


def amplitudes(o: Observations, lumps: Sequence[Bump], start: Array | None = None) -> Array:
    """Log-amplitudes of the natural fields and the errors under which the data are most likely, given the lumps."""
    most = PRIOR.fitted_presses if o.standard.anatomy is None else PRIOR.fitted
    few = o.part(slice(None, None, -(-len(o.y) // most)))
    parts = np.array(natural(few.xy, few.xy, o.standard) + errors(few))
    rest = fixed_covariance(few) + sum(lump_covariance(lump, few.xy, few.xy, o.standard) for lump in lumps)
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
    first, steps = (middle, PRIOR.first_steps) if start is None else (start, PRIOR.steps)
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
        """Median of the observations, about which the level is sought."""
        return float(np.median(self.observations.y))

    @cached_property
    def transfer_variance(self) -> float:
        """Variance of the log force of a standard press about the field: of its difference from held presses and slides, or,
        where presses were felt themselves, of the errors that each press has of its own.
        """
        o, e = self.observations, self.observations.standard.errors
        if o.standard.anatomy is not None:
            return e.press_sd**2 + e.slide_sd**2
        own = sum(
            np.exp(2 * size) * np.diag(part) for size, part in zip(self.log_amplitudes[-KINDS_OF_ERROR:], errors(o), strict=True)
        )
        return float(np.median(own + o.noise**2))

    @cached_property
    def triangle(self) -> Array:
        """Lower Cholesky factor of the observations' covariance, shape (m, m)."""
        o = self.observations
        covariance = fixed_covariance(o)
        for log_amplitude, part in zip(self.log_amplitudes, natural(o.xy, o.xy, o.standard) + errors(o), strict=True):
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
        """Logarithm of the probability density of observations and amplitudes, but for a constant."""
        middle, spread = _medians(self.observations)
        off = (self.log_amplitudes - middle) / spread
        return float(-0.5 * (self.whitened @ self.whitened + off @ off) - np.log(np.diag(self.triangle)).sum())

    def whiten(self, columns: Array) -> Array:
        """L^-1 times vectors over the samples, shape (m,) or (m, k)."""
        return np.asarray(solve_triangular(self.triangle, columns, lower=True))

    def healthy_covariance(self, a: Array, b: Array) -> Array:
        """Covariance of the field without lumps between places, shape (k, l)."""
        parts = zip(self.log_amplitudes, natural(a, b, self.observations.standard), strict=False)
        return np.asarray(PRIOR.level_sd**2 + sum(np.exp(2 * log_amplitude) * part for log_amplitude, part in parts))

    def lump_covariance(self, a: Array, b: Array) -> Array:
        """Covariance of all lumps together between places, shape (k, l)."""
        covariances = (lump_covariance(lump, a, b, self.observations.standard) for lump in self.lumps)
        return np.asarray(sum(covariances, np.zeros((len(a), len(b)))))

    def field(self, xy: Array) -> tuple[Array, Array]:
        """Posterior mean and standard deviation of z at places [m], shape (k, 2) -> (k,) each."""
        o = self.observations
        seen = self.whiten(self.healthy_covariance(o.xy, xy) + self.lump_covariance(o.xy, xy))
        anatomy, e = o.standard.anatomy, o.standard.errors
        variances = np.exp(2 * self.log_amplitudes[:-KINDS_OF_ERROR])
        last = 1.0 if anatomy is None else anatomy.bone(xy) ** 2
        prior = PRIOR.level_sd**2 + variances[:-1].sum() + variances[-1] * last
        for lump in self.lumps:
            prior = prior + (PRIOR.lump_sd * lump(xy)) ** 2 + (PRIOR.free(o.standard) * lump(xy, 2 * lump.edge)) ** 2
        variance = np.maximum(prior - (seen**2).sum(axis=0), 1e-8) + self.transfer_variance
        if self.lumps and e.lump_press_sd:
            variance += (e.lump_press_sd * (self.whitened @ self.whiten(self.lump_covariance(o.xy, xy)))) ** 2
        return self.level + self.whitened @ seen, np.sqrt(variance)

    def smooth(self, xy: Array) -> Array:
        """Posterior mean of the smooth fields at places [m], shape (k, 2) -> (k,)."""
        o, lengths = self.observations, self.observations.standard.lengths
        fields = zip(self.log_amplitudes, lengths.fields_m, strict=False)
        parts = [np.exp(2 * size) * smooth(o.xy, xy, length) for size, length in fields if length >= lengths.smooth_m]
        return self.whitened @ self.whiten(np.sum(parts, axis=0))

    def contrast(self, lump: Bump, xy: Array) -> tuple[Array, Array]:
        """Posterior mean (k,) and covariance (k, k) of one lump's log-contrast at places [m], shape (k, 2)."""
        o = self.observations
        seen = self.whiten(lump_covariance(lump, o.xy, xy, o.standard))
        return self.whitened @ seen, lump_covariance(lump, xy, xy, o.standard) - seen.T @ seen
