"""Detection of lumps: the shapes that join the model, and the evidence of what each is: lump, ridge, bone, tensed muscle.

A muscle is tensed over a hand's breadth, so that a candidate on it lies on a rise of the smooth fields. Voluntary guarding fades
during a slow slide, so that the same place becomes softer during a stroke: with w(x) a muscle's shape around the candidate and t
the time since contact, the strength of f = w(x) exp(-t / relaxation_s) with a prior of fade_sd,
f' S^-1 y / (f' S^-1 f + fade_sd^-2).
"""

from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from palpate_assessment.model import KINDS_OF_ERROR, PRIOR, Regression, cholesky_inverse, fit_log_amplitudes, prior_log_amplitudes
from palpate_assessment.observations import USABLE, Observations
from palpate_assessment.shape_search import SEARCH, find_disc, find_ridge, find_rival, match_bumps
from palpate_assessment.shapes import Bump
from palpate_assessment.standard import ABDOMEN, LENGTHS
from palpate_models.numerics.frames import Array


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
