"""Samples to map and findings: the whole of the assessment, arrays in, arrays out."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import chdtrc, logit

from palpate_assessment.detection import Candidate, detect
from palpate_assessment.findings import Z90, Area, areas
from palpate_assessment.grid import MapGrid
from palpate_assessment.model import Regression, cholesky_inverse, prior_log_amplitudes
from palpate_assessment.observations import USABLE, Observations, distance_to_samples, observe
from palpate_assessment.sampling import ForceSample
from palpate_assessment.standard import USUAL, PressStandard
from palpate_bus.messages.codes import UnassessedReason
from palpate_models.numerics.frames import Array, Indices, Mask
from palpate_models.scenario.schema import Marked

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
