"""From the posterior stiffness to findings: stiff areas that a healthy wall's variation does not explain.

Candidates are connected areas that stand out of their surroundings. Each is tested on the data, not on the map: under
"healthy" the log-moduli are the healthy field alone, under "lesion" the area's log-modulus is raised by c. Generalised least
squares gives c, its variance and the Bayes factor; so a smooth rise towards the costal margin, which the healthy field
explains, does not count.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.ndimage import label
from scipy.stats import norm

from palpate_assessment.grid import MapGrid
from palpate_assessment.inversion import Z90, Observations, Posterior
from palpate_assessment.prior import Field
from palpate_models.frames import Array

Mask = NDArray[np.bool_]

CANDIDATE_RATIO = 1.5
"""Stiffness over the local background from which an area is looked at."""
FINDING_RATIO = 1.8
"""Modulus over the local background that a finding must have: 2.5 healthy standard deviations and more above it."""
SMALLEST = 2.5e-4
"""Area of the smallest finding [m^2], 9 mm in radius: smaller ones are below what the footprint (14 mm) lets be told."""
CONFIDENCE = 0.95
"""Posterior probability that a finding must have."""
EDGE_LEVEL = 0.4
"""Level of the outline between background (0) and plateau (1): what blur the inversion leaves lowers the half contrast to it
(calibrated on areas of simulated scans, see README)."""
PRIOR_ODDS = 0.05
"""Odds that a given candidate is a lesion, before its data are weighed."""
_LESION_MEAN, _LESION_SD = 1.1, 0.5
"""Log-ratio of lesions: 3 is typical, 1.3 to 7 is usual (guarding: facts, sweep 2-10)."""
_MISFIT_SD = 0.12
"""Log-ratio that an area may seem to have because the healthy model is not exact."""


@dataclass(frozen=True)
class StiffArea:
    """One finding, in the abdomen frame."""

    nodes: Mask
    """Which of the grid's nodes belong to it, shape (n,)."""
    centroid: Array
    """Centroid of the area [m], shape (3,)."""
    area: float
    """On the surface [m^2]."""
    ratio: float
    """Apparent stiffness against the surroundings [1]."""
    ratio_lower: float
    """Lower end of the 90 % band."""
    ratio_upper: float
    confidence: float
    """Posterior probability that the area is stiffer than healthy variation explains."""


def candidates(excess: Array, grid: MapGrid, reached: Mask) -> list[Mask]:
    """Connected areas whose log-ratio to the local background is above the candidate's, shape (n,) each, largest first."""
    shape = grid.z.shape
    above = ((excess > np.log(CANDIDATE_RATIO)) & reached).reshape(shape)
    labels, count = label(above)
    areas = [labels.ravel() == i + 1 for i in range(count)]
    areas = [a for a in areas if float(grid.area[a].sum()) >= 0.5 * SMALLEST]
    return sorted(areas, key=lambda a: -float(grid.area[a].sum()))


def outline(excess: Array, candidate: Mask, grid: MapGrid) -> Mask:
    """The part of a candidate, and of its surroundings, above half the contrast of its plateau to the background.

    `excess`: log-ratio to the local background, shape (n,). The plateau is the mean of the stiffer half of the candidate.
    """
    ratio = np.exp(excess)
    inside = np.sort(ratio[candidate])
    plateau = float(inside[len(inside) // 2 :].mean())
    level = 1.0 + EDGE_LEVEL * (plateau - 1.0)
    labels, _ = label((ratio > level).reshape(grid.z.shape))
    peak = labels.ravel()[np.argmax(np.where(candidate, ratio, 0.0))]
    return np.asarray((labels.ravel() == peak) & (peak > 0))


def weigh(areas: list[Mask], posterior: Posterior, observations: Observations, healthy: Field) -> tuple[Array, Array]:
    """Log-ratio of each area to its surroundings, and its covariance, by generalised least squares on the data.

    Under the healthy field, with the areas' log-modulus raised by c: shape (k,) and (k, k).
    """
    J = posterior.jacobian
    seen = healthy.factor(J)
    sigma = seen @ seen.T + observations.covariance
    template = J @ np.array(areas, dtype=float).T
    weighted = cho_solve(cho_factor(sigma, lower=True), template)
    covariance = np.linalg.inv(template.T @ weighted)
    return covariance @ (weighted.T @ posterior.residual), covariance


def confidence(log_ratio: float, variance: float) -> float:
    """Posterior probability that an area is a lesion, from its log-ratio against its surroundings and that one's variance."""
    healthy = norm.logpdf(log_ratio, 0.0, np.sqrt(variance + _MISFIT_SD**2))
    lesion = norm.logpdf(log_ratio, _LESION_MEAN, np.sqrt(variance + _LESION_SD**2))
    if log_ratio <= 0:
        return 0.0
    return float(1.0 / (1.0 + np.exp(-np.clip(np.log(PRIOR_ODDS) + lesion - healthy, -60, 60))))


def find(
    excess: Array,
    grid: MapGrid,
    reached: Mask,
    posterior: Posterior,
    observations: Observations,
    healthy: Field,
    felt: Callable[[Sequence[Mask]], list[tuple[float, float]]],
) -> list[StiffArea]:
    """The findings, most confident first.

    `felt` gives the log of each area's ratio of apparent stiffness to its surroundings, and its standard deviation.
    """
    areas: list[Mask] = []
    for candidate in candidates(excess, grid, reached):
        area = outline(excess, candidate, grid) & reached
        if float(grid.area[area].sum()) >= SMALLEST and not any((area & other).any() for other in areas):
            areas.append(area)
    if not areas:
        return []
    log_ratio, covariance = weigh(areas, posterior, observations, healthy)
    found = []
    for i, (area, (middle, sd)) in enumerate(zip(areas, felt(areas), strict=True)):
        probability = confidence(float(log_ratio[i]), float(covariance[i, i]))
        if probability < CONFIDENCE or np.exp(log_ratio[i]) < FINDING_RATIO:
            continue
        weight = grid.area * area
        found.append(
            StiffArea(
                nodes=area,
                centroid=weight @ grid.nodes / weight.sum(),
                area=float(weight.sum()),
                ratio=float(np.exp(middle)),
                ratio_lower=float(np.exp(middle - Z90 * sd)),
                ratio_upper=float(np.exp(middle + Z90 * sd)),
                confidence=probability,
            )
        )
    return sorted(found, key=lambda f: (-f.confidence, -f.area))
