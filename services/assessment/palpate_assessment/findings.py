"""From candidates to findings: how probable each is, where it ends, and how it feels against its surroundings."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import label
from scipy.special import expit, log_ndtr

from palpate_assessment.calibration import Calibration
from palpate_assessment.detection import SOFTER, SURE, Candidate
from palpate_assessment.grid import MapGrid
from palpate_assessment.model import Regression
from palpate_assessment.shapes import Bump, ridge
from palpate_bus.messages.codes import FindingKind
from palpate_models.numerics.frames import Array, Mask
from palpate_models.scenario.schema import Marked

Z90 = 1.6449
"""Two-sided 90 % quantile of the normal distribution."""
CANDIDATE_PROBABILITY_MIN = 0.01
"""Probability from which an area is reported as a candidate."""
OUTLINE_FRACTION = 0.5
"""The outline is where the log-contrast is this part of its peak."""


class StatedPrior(NamedTuple):
    """Assumptions about a body of which nothing is known."""

    structures: float = 0.5
    """Expected number of structures in the region, of each size equally many, anywhere."""
    contrast: float = 1.1
    """Minimum contrast of a structure."""


STATED = StatedPrior()


class Area(NamedTuple):
    """An area that is stiffer or softer than its surroundings, in the abdomen frame."""

    nodes: Mask
    """Mask of its grid nodes, shape (n,)."""
    centroid: Array
    """Centroid of the area [m], shape (3,)."""
    area: float
    """Area on the surface [m^2]."""
    ratio: float
    """Apparent stiffness against the surroundings, geometric mean over the area [1]."""
    ratio_lower: float
    """Lower end of its 90 % band."""
    ratio_upper: float
    confidence: float
    """Probability that a lump of felt contrast 1.3 or more is there."""
    logit: float
    """Its log-odds at the prevalence of the fit, by which the operating point is chosen."""
    guarding: float
    """Probability that the lump is a tensed muscle."""
    ridge: float
    """Probability that the lump is a scar or another ridge."""
    bone: float
    """Probability that the lump is bone."""
    soft: float
    """Probability that the lump is a soft defect of the wall, such as a hernia."""
    kind: FindingKind
    """Most probable kind."""
    strength: float
    """Absolute log-contrast divided by its SD."""
    length: float
    """Length of a ridge [m]; 0 for a disc."""


def areas(
    regression: Regression,
    candidates: Sequence[Candidate],
    grid: MapGrid,
    assessed: Mask,
    shift: float = 0.0,
    marked: Sequence[Marked] = (),
) -> list[Area]:
    """Return the areas of candidates, the likeliest first; a candidate within the area of a likelier one belongs to that.

    Structures whose contrast is surely below a lump's, such as the navel, are left out.
    """
    if regression.observations.standard.anatomy is not None:
        candidates = [candidate for candidate in candidates if candidate.beyond > -SURE]
    if not candidates:
        return []
    if regression.observations.standard.anatomy is None:
        logits = np.array([stated_logit(c) for c in candidates])
        kinds = np.column_stack((expit(logits), np.zeros((len(logits), len(FindingKind) - 1))))
    else:
        features, signs = np.array([c.features for c in candidates]), np.array([c.signs for c in candidates])
        evidence = np.array([c.structures(marked_share(marked, c.bump)) for c in candidates])
        logits, kinds = causes(regression.observations.standard.calibration, features, signs, evidence, shift)
    found: list[Area] = []
    for index in np.argsort(-kinds.sum(axis=1) - kinds[:, FindingKind.LUMP]):
        if kinds[index].sum() < CANDIDATE_PROBABILITY_MIN:
            break
        area = _area(regression, candidates[index], grid, assessed, float(logits[index]), kinds[index])
        if area is not None and not any((area.nodes & other.nodes).any() for other in found):
            found.append(area)
    return sorted(found, key=lambda area: -area.logit)


def stated_logit(candidate: Candidate) -> float:
    """Return the logit that a candidate is a structure under the stated prior."""
    contrast = abs(candidate.log_contrast)
    sd = max(contrast / max(abs(candidate.t), 1e-9), 1e-9)
    return candidate.evidence + float(log_ndtr((contrast - np.log(STATED.contrast)) / sd) + np.log(STATED.structures))


def causes(calibration: Calibration, features: Array, signs: Array, evidence: Array, shift: float = 0.0) -> tuple[Array, Array]:
    """Return the logit that each candidate is a lump, shape (k,), and the probability of each `FindingKind`, shape (k, 5).

    `features`, `signs`, `evidence`: of candidates, of muscles about them and of structures, shapes (k, f), (k, 2), (k, 10).
    The causes compete: a lump has the weight exp(l), a muscle exp(g), a structure s exp(l + s), nothing 1. What is softer is
    neither a muscle nor a scar nor bone, and what is stiffer is not a soft defect. `shift`: of the log odds of a lump, by its
    prevalence; the logits that decide what is reported are those of the fit.
    """
    softer = features[:, SOFTER] > 0
    lump, muscle = calibration.logit(features), np.where(softer, -np.inf, calibration.muscle(signs))
    scar, bone, soft = calibration.structures(evidence).T
    soft = np.logaddexp(scar, soft)  # a long one is a diastasis
    structures = (*np.where(softer, -np.inf, (scar, bone)), np.where(softer, soft, -np.inf))
    weights = np.column_stack((lump, muscle, *(lump + one for one in structures)))
    other = np.logaddexp.reduce(np.column_stack((weights[:, 1:], np.zeros(len(lump)))), axis=1)
    weights[:, FindingKind.LUMP] += shift
    return lump - other, np.exp(weights - np.logaddexp(weights[:, :1], other[:, None]))


def marked_share(marked: Sequence[Marked], shape: Bump) -> float:
    """Return the overlap coefficient of a shape and the skin that the user has marked as scarred: of the marking that fits best,
    the common area over the smaller of both, so that a short scar is not lost in a wider shape.
    """
    low, high = shape.corners.min(axis=0) - shape.radius, shape.corners.max(axis=0) + shape.radius
    xy = np.stack(np.meshgrid(*np.linspace(low, high, 25).T), axis=-1).reshape(-1, 2)
    inside = xy[shape.distance(xy) < shape.radius]
    scars = [ridge(np.array(one.path_m), one.width_m / 2, 1e-3) for one in marked] if len(inside) else []
    common = [shape.area * float((scar.distance(inside) < scar.radius).mean()) / min(shape.area, scar.area) for scar in scars]
    return min(max(common, default=0.0), 1.0)


def _area(regression: Regression, candidate: Candidate, grid: MapGrid, assessed: Mask, logit: float, kinds: Array) -> Area | None:
    """Return the connected nodes about a candidate's peak with at least half of its log-contrast; None if nothing of it is left.

    `logit`, `kinds`: as of `causes`.
    """
    xy, standard = grid.nodes[:, :2], regression.observations.standard
    bump, sign = candidate.bump, float(np.sign(candidate.log_contrast))
    near = np.flatnonzero(bump(xy, 0.5 * bump.radius + standard.lengths.pitch_m) > 1e-3)
    if not len(near):
        return None
    mean, covariance = regression.contrast(bump, xy[near])
    excess = np.zeros(len(xy))
    excess[near] = sign * mean
    peak = int(np.argmax(np.where(assessed, excess, 0.0)))
    parts, _ = label((excess > OUTLINE_FRACTION * excess[peak]).reshape(grid.z.shape))
    nodes = (parts.ravel() == parts.ravel()[peak]) & (excess > 0) & assessed
    if not nodes.any():
        return None
    weight = grid.area[nodes] / grid.area[nodes].sum()
    inside = nodes[near]
    middle = float(weight @ mean[inside])
    sd = float(np.hypot(np.sqrt(weight @ covariance[np.ix_(inside, inside)] @ weight), standard.errors.lump_press_sd * middle))
    return Area(
        nodes=nodes,
        centroid=weight @ grid.nodes[nodes],
        area=float(grid.area[nodes].sum()),
        ratio=float(np.exp(middle)),
        ratio_lower=float(np.exp(middle - Z90 * sd)),
        ratio_upper=float(np.exp(middle + Z90 * sd)),
        confidence=float(kinds[FindingKind.LUMP]),
        logit=logit,
        guarding=float(kinds[FindingKind.MUSCLE]),
        ridge=float(kinds[FindingKind.RIDGE]),
        bone=float(kinds[FindingKind.BONE]),
        soft=float(kinds[FindingKind.SOFT_DEFECT]),
        kind=FindingKind(int(np.argmax(kinds))),
        strength=abs(candidate.t),
        length=bump.length,
    )
