"""Samples to map, candidates to findings: the whole of the assessment, arrays in, arrays out.

The map's mesh is a regular grid over the examined region in the xy plane of A, lifted to the perceived surface.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyvander
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import label
from scipy.spatial import cKDTree
from scipy.special import chdtrc, expit, log_ndtr, logit

from palpate_assessment.detection import SOFTER, SURE, Candidate, detect
from palpate_assessment.model import Regression, cholesky_inverse, prior_log_amplitudes
from palpate_assessment.sampling import ForceSample
from palpate_assessment.shapes import Bump, ridge
from palpate_assessment.standard import USABLE, USUAL, Calibration, Observations, PressStandard, distance_to_samples, observe
from palpate_bus.messages.codes import FindingKind, UnassessedReason
from palpate_models.numerics.frames import Array, Indices, Mask, Unsigned
from palpate_models.scenario.schema import Marked

_DEGREE = 4
"""Degree of the polynomial that stands for the abdomen's shape: slopes are those of the trunk, not of the noise."""
_POWER_X, _POWER_Y = np.array([(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]).T
"""Exponents of its terms."""


class MapGrid(NamedTuple):
    """A regular grid of nodes on the perceived surface, row by row: node j * nx + i is at (x[i], y[j])."""

    x: Array
    """[m], shape (nx,), in A."""
    y: Array
    """[m], shape (ny,), in A."""
    z: Array
    """Height of the perceived surface [m], shape (ny, nx)."""
    area: Array
    """Area of the surface that belongs to each node [m^2], shape (ny * nx,)."""

    @property
    def pitch(self) -> float:
        """Distance of neighbouring nodes in the xy plane [m]."""
        return float(self.x[1] - self.x[0])

    @property
    def nodes(self) -> Array:
        """Positions [m], shape (ny * nx, 3), in A."""
        xx, yy = np.meshgrid(self.x, self.y)
        return np.column_stack((xx.ravel(), yy.ravel(), self.z.ravel()))

    @property
    def triangles(self) -> Unsigned:
        """Two triangles a cell, shape (m, 3), counter-clockwise seen from outside."""
        nx, ny = len(self.x), len(self.y)
        corner = (np.arange(ny - 1)[:, None] * nx + np.arange(nx - 1)).ravel()
        lower = np.column_stack((corner, corner + 1, corner + nx + 1))
        upper = np.column_stack((corner, corner + nx + 1, corner + nx))
        return np.concatenate((lower, upper)).astype(np.uint32)


def _terms(x: Array, y: Array) -> Array:
    return np.asarray(polyvander(x / 0.1, _DEGREE)[..., _POWER_X] * polyvander(y / 0.1, _DEGREE)[..., _POWER_Y])


def map_grid(surface: Array, centre: tuple[float, float], size: tuple[float, float], margin: float, pitch: float) -> MapGrid:
    """Return the grid over a region of `size` [m] about `centre` [m], widened by `margin` [m], on a perceived surface.

    `surface`: vertices [m], shape (n, 3), in A. Where none is near, the smooth shape through all of them stands in.
    Raises ValueError when fewer than 30 vertices lie in the region.
    """
    half = 0.5 * np.asarray(size) + margin
    near = surface[np.all(np.abs(surface[:, :2] - centre) <= half + 0.03, axis=1)]
    near = near[np.isfinite(near).all(axis=1)]
    if len(near) < 30:
        raise ValueError(f"perceived surface: {len(near)} vertices in the examined region, expected at least 30")
    shape = np.linalg.lstsq(_terms(near[:, 0], near[:, 1]), near[:, 2], rcond=None)[0]
    count = np.maximum(np.round(2 * half / pitch).astype(int) + 1, 3)
    x = centre[0] + (np.arange(count[0]) - 0.5 * (count[0] - 1)) * pitch
    y = centre[1] + (np.arange(count[1]) - 0.5 * (count[1] - 1)) * pitch
    xx, yy = np.meshgrid(x, y)
    smooth = _terms(xx, yy) @ shape
    rest = near[:, 2] - _terms(near[:, 0], near[:, 1]) @ shape
    z = smooth + LinearNDInterpolator(near[:, :2], rest, fill_value=0.0)(xx, yy)
    zy, zx = np.gradient(smooth, pitch)
    area = pitch**2 * np.sqrt(1 + zx**2 + zy**2)
    return MapGrid(x, y, z, area.ravel())


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
    kinds: Array
    """Probability of each `FindingKind`, shape (5,): that of LUMP is of a lump of felt contrast 1.3 or more."""
    logit: float
    """Log-odds of a lump at the prevalence of the fit, by which the operating point is chosen."""
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
        kinds=kinds,
        logit=logit,
        strength=abs(candidate.t),
        length=bump.length,
    )


_MOST_CONTRADICTED = 0.3
"""When more than this part of the samples contradicts the rest, it is not known which of them is right: all stay in."""


class AssessedMap(NamedTuple):
    """The stiffness map on a grid's nodes, and the findings."""

    grid: MapGrid
    apparent: Array
    """Apparent stiffness: median of the force of the standard press [N], shape (n,)."""
    lower: Array
    """Lower end of its 90 % band [N]."""
    upper: Array
    unassessed: NDArray[np.uint8]
    """Values of `UnassessedReason`, shape (n,)."""
    background: float
    """Robust level of the unremarkable wall's apparent stiffness [N]."""
    findings: list[Area]
    candidates: list[Area]
    """Areas that were weighed and not reported."""
    samples: int


def assess(
    samples: Sequence[ForceSample],
    grid: MapGrid,
    reach: float,
    false_findings: float,
    standard: PressStandard = USUAL,
    *,
    prevalence: float | None = None,
    marked: Sequence[Marked] = (),
) -> AssessedMap | None:
    """Map and findings of a scan; None while there are too few samples.

    `reach`: distance within which a sample speaks for a node [m]. `false_findings`: how many a healthy examination may have;
    without an anatomy, how probable it may be that a finding is none. `prevalence`: share of such patients who have a lump; None
    for that of the fit. `marked`: skin that is scarred.
    """
    o = observe(samples, standard)
    judged = None if o is None else weigh_all(o)
    if o is None or judged is None:
        return None
    regression, candidates, reasons = judged
    unassessed = reasons[cKDTree(o.xy).query(grid.nodes[:, :2])[1]]
    unassessed[distance_to_samples(grid.nodes[:, :2], samples, standard) > reach] = UnassessedReason.NOT_REACHED
    shift = 0.0 if prevalence is None else float(logit(prevalence) - logit(standard.calibration.prevalence))
    weighed = areas(regression, candidates, grid, unassessed == UnassessedReason.ASSESSED, shift, marked)
    threshold = standard.calibration.threshold(false_findings) if standard.anatomy else float(logit(1.0 - false_findings))
    findings = [area for area in weighed if area.logit >= threshold]
    return _assessment(regression, grid, unassessed.astype(np.uint8), findings, weighed[len(findings) :])


def weigh_all(o: Observations) -> tuple[Regression, list[Candidate], NDArray[np.int_]] | None:
    """Return the regression of consistent samples, the candidate lumps, and the `UnassessedReason` of each excluded sample.

    None with too few samples.
    """
    reasons = np.where(o.yielded, UnassessedReason.YIELDED, UnassessedReason.ASSESSED)
    telling = np.flatnonzero(~o.yielded)
    if len(telling) < USABLE.min_samples:
        return None
    regression, candidates = detect(o.part(telling))
    wrong = find_contradicted(regression)
    if 0 < wrong.mean() < _MOST_CONTRADICTED:
        reasons[telling[wrong]] = UnassessedReason.CONTRADICTED
        regression, candidates = detect(o.part(telling[~wrong]))
    return regression, candidates, reasons


SURPRISE = 1e-5
"""A piece whose residual is less probable than this contradicts the model: of an examination's hundred pieces, one in a thousand
examinations where the model holds."""


def find_contradicted(regression: Regression) -> Mask:
    """Return the mask of samples in a piece of a stroke that the others contradict, shape (m,): a posterior predictive check.

    With the covariance K of all observations and P = K^-1, the piece k held out has the residual e = (P_kk)^-1 (P y)_k with
    covariance (P_kk)^-1 (Rasmussen and Williams 2006, sec. 5.4.2), so e' P_kk e is chi-squared if the model holds.
    """
    o = regression.observations
    precision = cholesky_inverse(regression.cholesky_factor)
    pull = precision @ (o.y - regression.level)
    marked = np.zeros(len(o.y), dtype=bool)
    for piece in pieces(o):
        own = pull[piece]
        surprise = float(own @ np.linalg.solve(precision[np.ix_(piece, piece)], own))
        marked[piece] = chdtrc(len(piece), surprise) < SURPRISE
    return marked


def pieces(o: Observations) -> list[Indices]:
    """Indices of the samples of each piece: strokes cut at every `piece_m` of travel."""
    step = np.hypot(*np.diff(o.xy, axis=0, prepend=o.xy[:1]).T)
    travel = np.cumsum(np.where(np.diff(o.stroke, prepend=o.stroke[0]) == 0, step, 0.0))
    start = np.array([travel[o.stroke == stroke].min() for stroke in o.stroke])
    key = np.column_stack((o.stroke, np.floor((travel - start) / o.standard.lengths.piece_m)))
    _, group = np.unique(key, axis=0, return_inverse=True)
    return [np.flatnonzero(group.ravel() == g) for g in range(int(group.max()) + 1)]


def assess_growing(samples: Sequence[ForceSample], grid: MapGrid, reach: float) -> AssessedMap | None:
    """Return the cheap variant for a growing map: with usual amplitudes, and without findings."""
    o = observe(samples, USUAL)
    if o is None:
        return None
    apart = distance_to_samples(grid.nodes[:, :2], samples, USUAL)
    unassessed = np.where(apart <= reach, UnassessedReason.ASSESSED, UnassessedReason.NOT_REACHED).astype(np.uint8)
    return _assessment(Regression(o, (), prior_log_amplitudes(o)), grid, unassessed, [], [])


def _assessment(
    regression: Regression, grid: MapGrid, unassessed: NDArray[np.uint8], findings: list[Area], candidates: list[Area]
) -> AssessedMap:
    o = regression.observations
    mean, sd = regression.field(grid.nodes[:, :2])
    remarkable = np.any([area.nodes for area in findings], axis=0) if findings else np.zeros(len(mean), dtype=bool)
    rest = (unassessed == UnassessedReason.ASSESSED) & ~remarkable
    usual = mean[rest if rest.any() else slice(None)]
    if o.standard.anatomy is None:  # presses were felt themselves, and may be dense in one part of the region
        away = ~remarkable[cKDTree(grid.nodes[:, :2]).query(o.xy)[1]]
        usual = o.y[away if away.mean() > 0.5 else slice(None)]  # a finding that covers most of the places has no surroundings
    return AssessedMap(
        grid=grid,
        apparent=np.exp(mean),
        lower=np.exp(mean - Z90 * sd),
        upper=np.exp(mean + Z90 * sd),
        unassessed=unassessed,
        background=float(np.exp(np.median(usual))),
        findings=findings,
        candidates=candidates,
        samples=len(o.y),
    )
