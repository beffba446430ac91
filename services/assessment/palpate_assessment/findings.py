"""From candidates to findings: how probable each is, where it ends, and how it feels against its surroundings."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label
from scipy.special import expit, log_ndtr

from palpate_assessment.calibration import Calibration
from palpate_assessment.detection import SOFTER, SURE, Candidate
from palpate_assessment.grid import MapGrid
from palpate_assessment.model import Regression
from palpate_models.numerics.frames import Array

Mask = NDArray[np.bool_]

Z90 = 1.6449
"""Two-sided 90 % quantile of the normal distribution."""
WEIGHED = 0.01
"""Probability from which an area is reported as a candidate."""
HALF = 0.5
"""The outline is where the log-contrast is this part of its peak."""


@dataclass(frozen=True)
class StatedPrior:
    """Assumptions about a body of which nothing is known."""

    structures: float = 0.5
    """Expected number of structures in the region, of each size equally many, anywhere."""
    contrast: float = 1.1
    """Least contrast of a structure."""


STATED = StatedPrior()


@dataclass(frozen=True)
class Area:
    """An area that is stiffer or softer than its surroundings, in the abdomen frame."""

    nodes: Mask
    """Mask of its grid nodes, shape (n,)."""
    centroid: Array
    """Centroid of the area [m], shape (3,)."""
    area: float
    """On the surface [m^2]."""
    ratio: float
    """Apparent stiffness against the surroundings, geometric mean over the area [1]."""
    ratio_lower: float
    """Lower end of its 90 % band."""
    ratio_upper: float
    confidence: float
    """Probability that a lump of felt contrast 1.3 or more is there."""
    logit: float
    """The same as log-odds, by which the operating point is chosen."""
    guarding: float
    """Probability that it is a tensed muscle."""
    strength: float
    """Its log-contrast over the SD of that."""
    length: float
    """Length of a ridge [m]; 0 for a disc."""


def areas(regression: Regression, candidates: Sequence[Candidate], grid: MapGrid, assessed: Mask) -> list[Area]:
    """The areas of candidates, most probable first; a candidate that lies in the area of a more probable one belongs to that.

    What is there, but surely of less contrast than a lump, is none: a navel, say, where everything else is known well.
    """
    if regression.observations.standard.anatomy is not None:
        candidates = [candidate for candidate in candidates if candidate.beyond > -SURE]
    if not candidates:
        return []
    if regression.observations.standard.anatomy is None:
        logits, guarding = np.array([stated(c) for c in candidates]), np.zeros(len(candidates))
    else:
        features, signs = np.array([c.features for c in candidates]), np.array([c.signs.features for c in candidates])
        logits, guarding = causes(regression.observations.standard.calibration, features, signs)
    found: list[Area] = []
    for index in np.argsort(-logits):
        if expit(logits[index]) < WEIGHED:
            break
        area = _area(regression, candidates[index], grid, assessed, (float(logits[index]), float(guarding[index])))
        if area is not None and not any((area.nodes & other.nodes).any() for other in found):
            found.append(area)
    return found


def stated(candidate: Candidate) -> float:
    """Return the logit that a candidate is a structure under the stated prior."""
    contrast = abs(candidate.log_contrast)
    sd = max(contrast / max(abs(candidate.t), 1e-9), 1e-9)
    return candidate.evidence + float(log_ndtr((contrast - np.log(STATED.contrast)) / sd) + np.log(STATED.structures))


def causes(calibration: Calibration, features: Array, signs: Array) -> tuple[Array, Array]:
    """Return the logit that each candidate is a lump, and the probability that it is a tensed muscle, shape (k,) each.

    `features`, `signs`: of candidates and of muscles about them, shapes (k, f) and (k, 2). Three causes compete, of weights
    exp(l) a lump, exp(g) a muscle, 1 neither. A muscle that is tensed is never softer.
    """
    lump = calibration.logit(features)
    muscle = np.where(features[:, SOFTER] > 0, -np.inf, calibration.muscle(signs))
    return lump - np.logaddexp(0, muscle), np.exp(muscle - np.logaddexp(np.logaddexp(0, lump), muscle))


def _area(
    regression: Regression, candidate: Candidate, grid: MapGrid, assessed: Mask, probability: tuple[float, float]
) -> Area | None:
    """Return the connected nodes about a candidate's peak with at least half of its log-contrast; None if nothing of it is left.

    `probability`: as of `causes`.
    """
    logit, guarding = probability
    xy, standard = grid.nodes[:, :2], regression.observations.standard
    bump, sign = candidate.bump, float(np.sign(candidate.log_contrast))
    near = np.flatnonzero(bump(xy, 0.5 * bump.radius + standard.lengths.pitch_m) > 1e-3)
    if not len(near):
        return None
    mean, covariance = regression.contrast(bump, xy[near])
    excess = np.zeros(len(xy))
    excess[near] = sign * mean
    peak = int(np.argmax(np.where(assessed, excess, 0.0)))
    parts, _ = label((excess > HALF * excess[peak]).reshape(grid.z.shape))
    nodes = (parts.ravel() == parts.ravel()[peak]) & (excess > 0) & assessed
    if not nodes.any():
        return None
    weight = grid.area[nodes] / grid.area[nodes].sum()
    inside = nodes[near]
    middle = float(weight @ mean[inside])
    sd = float(np.hypot(np.sqrt(weight @ covariance[np.ix_(inside, inside)] @ weight), standard.errors.unlike * middle))
    return Area(
        nodes=nodes,
        centroid=weight @ grid.nodes[nodes],
        area=float(grid.area[nodes].sum()),
        ratio=float(np.exp(middle)),
        ratio_lower=float(np.exp(middle - Z90 * sd)),
        ratio_upper=float(np.exp(middle + Z90 * sd)),
        confidence=float(expit(logit)),
        logit=logit,
        guarding=guarding,
        strength=abs(candidate.t),
        length=bump.length,
    )
