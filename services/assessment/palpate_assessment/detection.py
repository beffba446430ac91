"""Detection of lumps: the search for the disc or ridge that stands out most from what a regression explains, the shapes that
join the model, and the evidence of what each is: lump, ridge, bone, tensed muscle.

A muscle is tensed over a hand's breadth, so that a candidate on it lies on a rise of the smooth fields. Voluntary guarding fades
during a slow slide, so that the same place becomes softer during a stroke: with w(x) a muscle's shape around the candidate and t
the time since contact, the strength of f = w(x) exp(-t / relaxation_s) with a prior of fade_sd,
f' S^-1 y / (f' S^-1 f + fade_sd^-2).
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import Bounds, minimize
from scipy.spatial import cKDTree

from palpate_assessment.model import KINDS_OF_ERROR, PRIOR, Regression, cholesky_inverse, fit_log_amplitudes, prior_log_amplitudes
from palpate_assessment.shapes import Bump, ridge
from palpate_assessment.standard import ABDOMEN, LENGTHS, USABLE, Observations
from palpate_models.numerics.frames import Array

Found = tuple[Bump | None, float]
"""A shape, None if no shape is possible, and its strength."""


class ShapeSearch(NamedTuple):
    """Shapes that are tried first, and their refinement."""

    tries: int = 120
    """Evaluations for place, radius and edge of the strongest bump that was tried."""
    starts: int = 3
    """Bumps apart from each other that are refined where no anatomy is assumed: a small lump may be between those tried first."""
    narrowest: float = 0.5
    """Minimum radius or half width where no anatomy is assumed, over that of the smallest bump."""
    widest: float = 1.3
    """Maximum radius over the largest one of the bumps that are tried first. Of a ridge of the abdomen: the usual radius, since a
    scar is narrow and a broad ridge is a lump that is not round."""
    too_near: float = 0.7
    """Two lumps are at least this part of the sum of their radii apart."""
    angles: int = 8
    """Directions of the ridges that are tried."""
    half_lengths: tuple[float, ...] = (0.75, 1.5)
    """Half of their lengths, over the radius of the largest bump."""
    turns: tuple[float, ...] = (-0.8, -0.4, 0.0, 0.4, 0.8)
    """Angles [rad] by which a ridge may turn from one piece to the next."""
    gain: float = 1.6
    """Gain of the log evidence from which a ridge becomes longer by a piece: the logarithm of the number of turns."""
    usual: int = 2
    """Index of the usual radius, which is the length of a piece."""
    surrounded: float = 0.5
    """Minimum share of a structure's outline that is within the samples where no anatomy is assumed: it may be at the border."""
    narrow: float = 0.354
    """Maximum radius, over the lesser width of the samples, where no anatomy is assumed: within a circle of that width, a disc of
    1/sqrt(8) of it has as much area as its surroundings."""
    rival_offsets_m: tuple[float, ...] = (-0.012, 0.0, 0.012)
    """Distances of the middles of ridges from the disc that they may be instead, along each axis."""
    rival_tries: int = 80
    """Evaluations for the strongest of them."""


SEARCH = ShapeSearch()


def match_bumps(regression: Regression, bumps: Sequence[Bump]) -> tuple[Array, Array]:
    """Log-contrast e and strength t of bumps under a regression that does not have them, shape (k,) each."""
    seen = regression.whiten(np.array([bump(regression.observations.xy) for bump in bumps]).T)
    power = np.maximum((seen**2).sum(axis=0), 1e-9)
    return regression.whitened @ seen / power, regression.whitened @ seen / np.sqrt(power)


def find_disc(regression: Regression) -> Found:
    """Return the disc that stands out most from what the regression explains, and how much (|t|)."""
    lengths = regression.observations.standard.lengths
    bumps = [Bump(x, y, radius, lengths.edge_m) for x, y in _centres(regression).tolist() for radius in lengths.radii_m]
    return _best(regression, bumps, lambda p: Bump(p[0], p[1], *np.exp(p[2:])))


def find_ridge(regression: Regression) -> Found:
    """Return the ridge that stands out most from what the regression explains, and how much (t)."""
    band, t = _best_ridge(regression, _centres(regression))
    return (band, t) if band is None else _grow(regression, band, t)


def _best_ridge(regression: Regression, centres: Array, tries: int = SEARCH.tries, sign: float = 0.0) -> Found:
    """Return the strongest ridge about centres [m], shape (k, 2), as `_best` does."""
    lengths = regression.observations.standard.lengths
    angles = np.linspace(0.0, np.pi, SEARCH.angles, endpoint=False)
    halves = np.array([h * lengths.radii_m[-1] * np.array((np.cos(a), np.sin(a))) for a in angles for h in SEARCH.half_lengths])
    ridges = [ridge(np.array((c - half, c + half)), lengths.radii_m[0], lengths.edge_m) for c in centres for half in halves]
    return _best(regression, ridges, lambda p: ridge(p[:4].reshape(2, 2), *np.exp(p[4:])), tries, sign)


def _centres(regression: Regression) -> Array:
    """Return centres of the bumps that are tried [m], shape (k, 2)."""
    xy, pitch = regression.observations.xy, regression.observations.standard.lengths.pitch_m
    x, y = (np.arange(a - pitch, b + pitch + 1e-9, pitch) for a, b in zip(xy.min(axis=0), xy.max(axis=0), strict=True))
    centres = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return centres[cKDTree(xy).query(centres)[0] <= pitch]


def _best(
    regression: Regression, bumps: list[Bump], shape: Callable[[Array], Bump], tries: int = SEARCH.tries, sign: float = 0.0
) -> Found:
    """Return the strongest of some bumps after place, radius and edge were refined, and its strength.

    `shape`: the bump of its parameters: points [m], and the logarithms of radius and edge. `sign`: of the contrast of ridges; 0:
    those which are stiffer than their surroundings, as vessels, scars and tendons are.
    """
    bumps = [bump for bump in bumps if _is_possible(regression, bump)]
    if not bumps:
        return None, 0.0
    xy, lengths = regression.observations.xy, regression.observations.standard.lengths
    t = _strengths(regression, bumps, sign)

    def loss(p: Array) -> float:
        bump = shape(p)
        return -float(_strengths(regression, [bump], sign)[0]) if _is_possible(regression, bump) else 0.0

    anatomy = regression.observations.standard.anatomy is not None
    narrowest = np.log((lengths.radii_m[0] * (1.0 if anatomy and not bumps[0].path else SEARCH.narrowest), lengths.edge_m))
    broadest = lengths.radii_m[SEARCH.usual] if anatomy and bumps[0].path else lengths.radii_m[-1] * SEARCH.widest
    widest = np.log((broadest, lengths.wide_edge_m))
    low, high = xy.min(axis=0) - lengths.pitch_m, xy.max(axis=0) + lengths.pitch_m
    firsts: list[Bump] = []
    for k in np.argsort(-t, kind="stable"):
        if all(bumps[k].apart(one) >= SEARCH.too_near for one in firsts):
            firsts.append(bumps[k])
        if len(firsts) >= (1 if anatomy else SEARCH.starts):
            break
    found = []
    for first in firsts:
        points = first.corners.ravel()
        limits = Bounds((*np.resize(low, len(points)), *narrowest), (*np.resize(high, len(points)), *widest))
        start: Array = np.clip((*points, np.log(first.radius), np.log(first.edge)), limits.lb, limits.ub)
        simplex = start + np.vstack((np.zeros(len(start)), np.diag([lengths.refined_m] * len(points) + [0.25, 0.3])))
        options: Any = {"initial_simplex": simplex, "maxfev": tries, "xatol": 1e-4, "fatol": 1e-2}
        found.append(minimize(loss, start, method="Nelder-Mead", bounds=limits, options=options))
    best = min(found, key=lambda one: float(one.fun))
    return shape(best.x), -float(best.fun)


def _strengths(regression: Regression, bumps: Sequence[Bump], sign: float = 0.0) -> Array:
    """Return |t| of discs, and t of ridges times the sign of their contrast, that of stiffer ones if 0; shape (k,)."""
    _, t = match_bumps(regression, bumps)
    return np.where([bool(bump.path) for bump in bumps], t * (sign or 1.0), np.abs(t))


def _grow(regression: Regression, band: Bump, t: float) -> tuple[Bump, float]:
    """Return a ridge, longer at its ends by pieces in any forward direction while the evidence grows, and its |t|."""
    step = regression.observations.standard.lengths.radii_m[SEARCH.usual]
    turns = [np.array(((np.cos(a), -np.sin(a)), (np.sin(a), np.cos(a)))) for a in SEARCH.turns]
    grows = True
    while grows:
        grows = False
        for forward in (1, -1):
            corners = band.corners[::forward]
            along = (corners[-1] - corners[-2]) / np.linalg.norm(corners[-1] - corners[-2])
            longer = [ridge(np.vstack((corners, corners[-1] + step * turn @ along)), band.radius, band.edge) for turn in turns]
            longer = [one for one in longer if _is_possible(regression, one)]
            found = _strengths(regression, longer) if longer else np.zeros(1)
            if 0.5 * found.max() ** 2 > 0.5 * t**2 + SEARCH.gain:
                band, t, grows = longer[int(np.argmax(found))], float(found.max()), True
    return band, t


def _is_possible(regression: Regression, bump: Bump) -> bool:
    """Return True if a bump does not overlap those found before, and, without an anatomy, is not outside the samples."""
    o = regression.observations
    if (places := o.standard.places) is not None and not (
        places.encloses(bump.corners).all()
        and bump.radius <= SEARCH.narrow * o.width
        and places.encloses(bump.outline()).mean() >= SEARCH.surrounded
    ):
        return False
    return all(bump.apart(one) >= SEARCH.too_near for one in regression.lumps)


def find_rival(regression: Regression, disc: Bump) -> Bump | None:
    """Return the strongest ridge that may be there instead of a disc, under a regression without it."""
    (stiffer,) = np.sign(match_bumps(regression, [disc])[0])
    centres = np.array([(disc.x + x, disc.y + y) for x in SEARCH.rival_offsets_m for y in SEARCH.rival_offsets_m])
    return _best_ridge(regression, centres, SEARCH.rival_tries, stiffer)[0]


class Muscle(NamedTuple):
    """A muscle that is tensed [assumption]."""

    radius_m: float = 0.06
    edge_m: float = 0.025
    """SD of its edge."""
    relaxation_s: float = 2.0
    """Time constant of relaxation. A stroke takes five seconds."""
    fade_sd: float = 0.3
    """Prior of the logarithm that fades."""
    softest: float = 0.1
    """Part of the samples that is taken for the relaxed wall."""


class DetectionTuning(NamedTuple):
    """Limits for shapes that join the model, and for what is believed of them."""

    max_lumps: int = 4
    """Maximum number of lumps where there is probably no bone."""
    max_with_bone: int = 7
    bone: float = 0.6
    """Prior of bone from which a place counts as bone."""
    weakest_t: float = 3.0
    """Minimum t with which a lump is weighed."""
    alike: float = 1.5
    """Limit of t over t without the most influential stroke; two equal strokes: the root of 2."""
    min_gain: float = 0.0
    """Log Bayes factor, over all places, below which no more lumps are sought where no anatomy is assumed."""
    border_m: float = 0.02
    """Distance from the border over which bone becomes improbable."""
    midline_m: float = 0.009
    """Distance from the midline at which the linea alba and the umbilicus may be."""
    preferred: float = 3.0
    """Gain of the log evidence from which a ridge takes the place of a disc in the model."""
    crossed: float = 0.5
    """A stroke crosses a lump whose shape is at least this part of the highest value of any sample: its centre may be outside."""


MUSCLE, DETECTION = Muscle(), DetectionTuning()


class Signs(NamedTuple):
    """Signs of a muscle around a candidate, in logarithms of stiffness."""

    rise: float
    """Stiffness over a hand's breadth relative to the softest part of the region."""
    fade: float
    """Part of it that fades under contact."""


def signs(regression: Regression, lump: Bump) -> Signs:
    """Return the signs of a muscle around a lump of a regression."""
    o = regression.observations
    smooth = regression.smooth(np.vstack(((lump.x, lump.y), o.xy)))
    muscle = Bump(lump.x, lump.y, MUSCLE.radius_m, MUSCLE.edge_m)
    fading = regression.whiten(muscle(o.xy) * np.exp(-o.touched_for / MUSCLE.relaxation_s))
    fade = regression.whitened @ fading / (fading @ fading + MUSCLE.fade_sd**-2)
    return Signs(rise=float(smooth[0] - np.quantile(smooth[1:], MUSCLE.softest)), fade=float(fade))


FELT = 1.3
"""Felt contrast from which an area counts as a lump."""
FEATURES = ("strength", "beyond", "log-radius", "log-radius squared", "softer")
"""Features of a candidate's probability: strength, confidence that its contrast is FELT or more, size and its difference from
the usual one, and sign."""
SOFTER = FEATURES.index("softer")
STRUCTURES = 10
"""Number of the columns of `Candidate.structures`."""
SURE = 4.0
"""Standard deviations below FELT from which a candidate is rejected: 0 of 35 such candidates of tuning patients were lumps."""


MOST_GAIN = 10.0
"""Bound of the evidence of one shape against another: shapes are ideal."""


class Candidate(NamedTuple):
    """A lump that is weighed."""

    bump: Bump
    log_contrast: float
    """E, by generalised least squares; negative where it is softer than its surroundings."""
    t: float
    """E over its standard deviation, as far as more than one stroke says it (`limit_strength`)."""
    signs: Signs
    """Signs of a tensed muscle around it."""
    disc: Bump
    """Its shape if it is a lump of the abdomen."""
    ridge: Bump | None = None
    """The ridge that it may be instead."""
    ridge_gain: float = 0.0
    """Gain of the log evidence of the ridge over the disc, within MOST_GAIN."""
    inside_m: float = 0.0
    """Distance of its centre from the border of the samples, negative beyond it [m]."""
    steeper: float = 0.0
    """Exponent of the descents near it less the patient's median, the largest: bone yields less the deeper it is pressed."""
    evidence: float = 0.0
    """Log Bayes factor against the lumps found before it alone, where no anatomy is assumed."""

    @property
    def features(self) -> Array:
        """The FEATURES, shape (f,)."""
        size, softer = np.log(self.disc.radius / LENGTHS.radii_m[2]), float(self.log_contrast < 0)
        return np.array((abs(self.t), self.beyond, size, size**2, softer))

    def structures(self, marked: float = 0.0) -> Array:
        """Return the evidence for a ridge (3), bone (4) and a soft defect (3) instead of a lump, shape (10,).

        `marked`: overlap with skin that the user has marked as scarred (`marked_share`).
        """
        at = np.array([[self.disc.x, self.disc.y]])
        midline = float(np.exp(-0.5 * (self.disc.x / DETECTION.midline_m) ** 2))
        slim = float(np.log1p(self.ridge.length / (2 * self.ridge.radius))) if self.ridge else 0.0
        inside = float(np.clip(self.inside_m / DETECTION.border_m, -1.0, 3.0))
        bone = (inside, float(ABDOMEN.bone(at)[0]), self.steeper, abs(self.log_contrast))
        return np.array((self.ridge_gain, slim, marked, *bone, midline, self.ridge_gain, slim))

    @property
    def beyond(self) -> float:
        """Excess of the contrast over FELT in its standard deviations, limited to +-SURE."""
        contrast = abs(self.log_contrast)
        return float(np.clip((contrast - np.log(FELT)) * abs(self.t) / max(contrast, 1e-9), -SURE, SURE))


def detect(o: Observations) -> tuple[Regression, list[Candidate]]:
    """Return the regression with the detected lumps, and these lumps, each evaluated with the others in the model."""
    steps = [Regression(o, (), fit_log_amplitudes(o, ()))]
    shapes: list[tuple[Bump, Bump | None]] = []
    while len(steps) <= DETECTION.max_with_bone and _open_wall(steps[-1]) < DETECTION.max_lumps:
        last = steps[-1] if o.standard.anatomy else replace(steps[-1], log_amplitudes=unmask(steps[-1]))
        found = [find_disc(last), *([] if o.standard.anatomy else [find_ridge(last)])]
        bumps = [bump for bump, strength in found if bump is not None and strength >= DETECTION.weakest_t]
        if o.standard.anatomy and bumps:
            shapes.append((bumps[0], find_rival(last, bumps[0])))
            bumps = [prefer(last, *shapes[-1])]
        lumps = [(*last.lumps, bump) for bump in bumps]
        more = [Regression(o, some, fit_log_amplitudes(o, some, last.log_amplitudes)) for some in lumps]
        if not more:
            break
        best = more[0] if o.standard.anatomy else max(more, key=partial(measure_gain, steps[-1]))
        if o.standard.anatomy is None and measure_gain(steps[-1], best) < DETECTION.min_gain:
            break
        steps.append(best)
    both = shapes or [(lump, None) for lump in steps[-1].lumps]
    weighed = [weigh(steps[-1], lump, *shape) for lump, shape in zip(steps[-1].lumps, both, strict=False)]
    if o.standard.anatomy is None:
        weighed = [c._replace(evidence=measure_gain(*both)) for c, both in zip(weighed, pairwise(steps), strict=True)]
    return steps[-1], weighed


def _open_wall(regression: Regression) -> int:
    """Return the number of lumps where there is probably no bone."""
    anatomy, centres = regression.observations.standard.anatomy, np.array([(b.x, b.y) for b in regression.lumps]).reshape(-1, 2)
    return len(centres) if anatomy is None else int((anatomy.bone(centres) < DETECTION.bone).sum())


def unmask(regression: Regression) -> Array:
    """Return log-amplitudes of a regression, those of natural variation at most their medians: a lump that is not in it yet
    counts as natural variation, and would hide itself.
    """
    fields = len(regression.log_amplitudes) - KINDS_OF_ERROR
    usual = prior_log_amplitudes(regression.observations)
    return np.concatenate((np.minimum(regression.log_amplitudes, usual)[:fields], regression.log_amplitudes[fields:]))


def weigh(regression: Regression, lump: Bump, disc: Bump, instead: Bump | None) -> Candidate:
    """Return a lump of a regression, tested under the regression without it, with the disc and the ridge that it may be."""
    without = replace(regression, lumps=tuple(other for other in regression.lumps if other is not lump))
    (log_contrast,), (t,) = match_bumps(without, [lump])
    o, at = regression.observations, np.array([[disc.x, disc.y]])
    candidate = Candidate(lump, float(log_contrast), limit_strength(without, lump, float(t)), signs(regression, disc), disc)
    if o.standard.anatomy is None:
        return candidate
    felt = o.exponent > 0
    steep = o.exponent[felt & (disc.distance(o.xy) < disc.radius + DETECTION.border_m)]
    return candidate._replace(
        ridge=instead,
        ridge_gain=ridge_gain(without, disc, instead),
        inside_m=float(-(at @ o.hull.equations[:, :2].T + o.hull.equations[:, 2]).max()),
        steeper=float(steep.max() - np.median(o.exponent[felt])) if len(steep) else 0.0,
    )


def ridge_gain(regression: Regression, disc: Bump, instead: Bump | None) -> float:
    """Return the gain of the log evidence of a ridge over a disc under a regression without them, within MOST_GAIN."""
    if instead is None:
        return -MOST_GAIN
    _, (t, other) = match_bumps(regression, [disc, instead])
    return float(np.clip(0.5 * (other**2 - t**2), -MOST_GAIN, MOST_GAIN))


def prefer(regression: Regression, disc: Bump, instead: Bump | None) -> Bump:
    """Return the shape that joins the model."""
    return instead if instead and ridge_gain(regression, disc, instead) > DETECTION.preferred else disc


def measure_gain(before: Regression, after: Regression) -> float:
    """Return the log Bayes factor of the last lump, of the ideal shape or free to differ from it, against those before alone.

    Each has its own amplitudes. What one stroke alone says is not believed (`limit_strength`). The lump may be at as many places
    as its area fits into the region, of as many sizes as are tried, and a ridge in as many directions.
    """
    lump, without = after.lumps[-1], replace(after, lumps=before.lumps)
    (log_contrast,), (t,) = match_bumps(without, [lump])
    believed = 0.5 * limit_strength(without, lump, float(t)) ** 2
    gain = 1.0 + (PRIOR.lump_sd * float(t) / float(log_contrast)) ** 2
    ideal = without.log_evidence - before.log_evidence + believed * (1.0 - 1.0 / gain) - 0.5 * np.log(gain)
    free = min(after.log_evidence - before.log_evidence, believed)
    o = after.observations
    places = max(float(o.hull.volume) / lump.area, 1.0) * len(o.standard.lengths.radii_m) * (SEARCH.angles if lump.path else 1)
    return float(np.logaddexp(ideal, free) - np.log(2.0 * places))


def limit_strength(regression: Regression, lump: Bump, t: float) -> float:
    """The strength `t` of a lump, at most `alike` times what is left of it without the stroke that says it most.

    A hiccup, or a breath that was followed too late, is a few millimetres for a second: three centimetres of one stroke. Such
    errors are rarer and greater than Gaussian ones, so that what one stroke alone says is not believed, unless there is no other.
    With the precision P of all samples, that of the others is P - P_k P_kk^-1 P_k' for the samples k of a stroke.
    """
    o = regression.observations
    if np.ptp(o.stroke) == 0:
        return t
    height = lump(o.xy)
    precision = cholesky_inverse(regression.cholesky_factor)
    y = o.y - regression.level
    pulls = precision @ np.column_stack((height, y))
    left = np.inf
    for stroke in np.unique(o.stroke[height > DETECTION.crossed * height.max()]):
        own = np.flatnonzero(o.stroke == stroke)
        if len(o.y) - len(own) < USABLE.min_samples:
            continue
        lost = np.linalg.solve(precision[np.ix_(own, own)], pulls[own])
        power = height @ pulls[:, 0] - pulls[own, 0] @ lost[:, 0]
        match = height @ pulls[:, 1] - pulls[own, 0] @ lost[:, 1]
        left = min(left, float(np.sign(t) * match / np.sqrt(max(power, 1e-9))))
    left = left if np.isfinite(left) else 0.0
    return float(np.sign(t)) * min(abs(t), DETECTION.alike * max(left, 0.0))
