"""Signs that distinguish a tensed muscle from a lump: stiff surroundings, and relaxation under contact.

A muscle is tensed over a hand's breadth, so that a candidate on it lies on a rise of the smooth fields. Voluntary guarding fades
during a slow slide, so that the same place becomes softer during a stroke: with w(x) a muscle's shape around the candidate and t
the time since contact, the strength of f = w(x) exp(-t / RELAXATION_S) with a prior of FADE_SD,
f' S^-1 y / (f' S^-1 f + FADE_SD^-2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import Bounds, minimize
from scipy.spatial import cKDTree

from palpate_assessment.calibration import Calibration
from palpate_assessment.model import EDGE_M, Bump, Regression, amplitudes, bone
from palpate_assessment.observations import FEWEST, Observations
from palpate_models.numerics.frames import Array

MUSCLE_M, MUSCLE_EDGE_M = 0.06, 0.025
"""Radius of a muscle that is tensed, and how soft its edge is [assumption]."""
RELAXATION_S = 2.0
"""Relaxation time of a muscle [s] [A]. A stroke takes five seconds."""
FADE_SD = 0.3
"""Prior of the logarithm that fades."""
SOFTEST = 0.1
"""Part of the samples that is taken for the relaxed wall."""


@dataclass(frozen=True)
class Signs:
    """Signs of a muscle around a candidate, in logarithms of stiffness."""

    rise: float
    """Stiffness over a hand's breadth relative to the softest part of the region."""
    fade: float
    """Part of it that fades under contact."""

    @property
    def features(self) -> Array:
        """Both, shape (2,)."""
        return np.array((self.rise, self.fade))


def signs(regression: Regression, lump: Bump) -> Signs:
    """Return the signs of a muscle around a lump of a regression."""
    o = regression.observations
    smooth = regression.smooth(np.vstack(((lump.x, lump.y), o.xy)))
    fading = regression.whiten(Bump(lump.x, lump.y, MUSCLE_M, MUSCLE_EDGE_M)(o.xy) * np.exp(-o.touched_for / RELAXATION_S))
    fade = regression.whitened @ fading / (fading @ fading + FADE_SD**-2)
    return Signs(rise=float(smooth[0] - np.quantile(smooth[1:], SOFTEST)), fade=float(fade))


RADII_M = (0.008, 0.012, 0.018, 0.026, 0.036)
PITCH_M = 0.01
"""Radii and distance of the bumps that are tried, before place, radius and edge of the strongest are found by TRIES more."""
TRIES = 120
EDGES_M = (EDGE_M, 0.016)
"""A lump is felt with the edge of the indenter's footprint, or with a wider one where tissue between spreads the pressure."""
MOST = 4
"""Largest number of lumps."""
WEAKEST = 3.0
"""Weakest t with which one is weighed."""
_TOO_NEAR = 0.7
"""Two lumps are at least this part of the sum of their radii apart."""
_BORDER_M = 0.010
"""Centres lie at most so far beyond the samples."""

FELT = 1.3
"""Felt contrast from which an area counts as a lump."""
FEATURES = ("strength", "beyond", "log-radius", "log-radius squared", "softer", "bone")
"""Features of a candidate's probability: strength, confidence that its contrast is FELT or more, size and its difference from
the usual one, sign, and the share of its strength that may be bone."""
SOFTER = FEATURES.index("softer")
ALIKE, HALF = 1.5, 0.5
"""Limit of t over t without the most influential stroke (two equal strokes: the root of 2); and the share of the highest bump
value of any sample above which a stroke crosses a lump, whose centre may be outside the samples."""
SURE = 4.0
"""Standard deviations below FELT from which a candidate is rejected: 0 of 35 such candidates of tuning patients were lumps."""


@dataclass(frozen=True)
class Candidate:
    """A lump that is weighed."""

    bump: Bump
    log_contrast: float
    """E, by generalised least squares; negative where it is softer than its surroundings."""
    t: float
    """E over its standard deviation, as far as more than one stroke says it (`agreed`)."""
    signs: Signs
    """Signs of a tensed muscle around it."""

    @property
    def features(self) -> Array:
        """The FEATURES, shape (f,)."""
        size = np.log(self.bump.radius / RADII_M[2])
        under = float(bone(np.array([[self.bump.x, self.bump.y]]))[0])
        return np.array((abs(self.t), self.beyond, size, size**2, float(self.log_contrast < 0), under**2 * abs(self.t)))

    @property
    def beyond(self) -> float:
        """By how many of its standard deviations the contrast exceeds FELT, within SURE."""
        contrast = abs(self.log_contrast)
        return float(np.clip((contrast - np.log(FELT)) * abs(self.t) / max(contrast, 1e-9), -SURE, SURE))


def matched(regression: Regression, bumps: Sequence[Bump]) -> tuple[Array, Array]:
    """Log-contrast e and strength t of bumps under a regression that does not have them, shape (k,) each."""
    seen = regression.whiten(np.array([bump(regression.observations.xy) for bump in bumps]).T)
    power = np.maximum((seen**2).sum(axis=0), 1e-9)
    return regression.whitened @ seen / power, regression.whitened @ seen / np.sqrt(power)


def detect(o: Observations, calibration: Calibration) -> tuple[Regression, list[Candidate]]:
    """Return the regression with the detected lumps, and these lumps, each evaluated with the others in the model."""
    lumps: tuple[Bump, ...] = ()
    regression = Regression(o, calibration, lumps, amplitudes(o, calibration, lumps))
    for _ in range(MOST):
        bump, strength = strongest(regression)
        if bump is None or strength < WEAKEST:
            break
        lumps = (*lumps, bump)
        found = amplitudes(o, calibration, lumps, regression.log_amplitudes)
        regression = Regression(o, calibration, lumps, found)
    return regression, [weigh(regression, lump) for lump in lumps]


def weigh(regression: Regression, lump: Bump) -> Candidate:
    """Return a lump of a regression, tested under the regression without it."""
    others = tuple(other for other in regression.lumps if other is not lump)
    without = replace(regression, lumps=others)
    (log_contrast,), (t,) = matched(without, [lump])
    return Candidate(lump, float(log_contrast), agreed(without, lump, float(t)), signs(regression, lump))


def agreed(regression: Regression, lump: Bump, t: float) -> float:
    """The strength `t` of a lump, at most ALIKE times what is left of it without the stroke that says it most.

    A hiccup, or a breath that was followed too late, is a few millimetres for a second: three centimetres of one stroke. Such
    errors are rarer and greater than Gaussian ones, so that what one stroke alone says is not believed, unless there is no other.
    """
    o = regression.observations
    if np.ptp(o.stroke) == 0:
        return t
    height = lump(o.xy)
    crossing = np.unique(o.stroke[height > HALF * height.max()])
    others = [np.flatnonzero(o.stroke != stroke) for stroke in crossing]
    rests = [matched(replace(regression, observations=o.part(rest)), [lump])[1] for rest in others if len(rest) >= FEWEST]
    left = min((float(np.sign(t) * rest[0]) for rest in rests), default=0.0)
    return float(np.sign(t)) * min(abs(t), ALIKE * max(left, 0.0))


def strongest(regression: Regression) -> tuple[Bump | None, float]:
    """Return the bump that stands out most from what the regression explains, and how much (|t|)."""
    xy = regression.observations.xy
    low, high = xy.min(axis=0) - _BORDER_M, xy.max(axis=0) + _BORDER_M
    x, y = (np.arange(a, b + 1e-9, PITCH_M) for a, b in zip(low, high, strict=True))
    centres = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    near = cKDTree(xy).query(centres)[0] <= _BORDER_M
    bumps = [Bump(float(px), float(py), radius) for px, py in centres[near] for radius in RADII_M]
    bumps = [bump for bump in bumps if _free(bump, regression.lumps)]
    if not bumps:
        return None, 0.0
    _, t = matched(regression, bumps)
    first = bumps[int(np.argmax(np.abs(t)))]

    def loss(p: Array) -> float:
        bump = Bump(p[0], p[1], *np.exp(p[2:]))
        return -abs(float(matched(regression, [bump])[1][0])) if _free(bump, regression.lumps) else 0.0

    start = np.array((first.x, first.y, np.log(first.radius), np.log(first.edge)))
    simplex = start + np.vstack((np.zeros(4), np.diag((0.004, 0.004, 0.25, 0.3))))
    narrowest, widest = np.log((RADII_M[0], EDGES_M[0])), np.log((RADII_M[-1] * 1.3, EDGES_M[1]))
    limits = Bounds((*low, *narrowest), (*high, *widest))
    best = minimize(
        loss,
        start,
        method="Nelder-Mead",
        bounds=limits,
        options={"initial_simplex": simplex, "maxfev": TRIES, "xatol": 1e-4, "fatol": 1e-2},
    )
    bump = Bump(float(best.x[0]), float(best.x[1]), *map(float, np.exp(best.x[2:])))
    return bump, -float(best.fun)


def _free(bump: Bump, lumps: Sequence[Bump]) -> bool:
    """Return True if a bump does not overlap those found before."""
    apart = [np.hypot(bump.x - one.x, bump.y - one.y) / (bump.radius + one.radius) for one in lumps]
    return all(a >= _TOO_NEAR for a in apart)
