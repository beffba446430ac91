"""Search for the disc or ridge that stands out most from what a regression explains."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import Bounds, minimize
from scipy.spatial import cKDTree

from palpate_assessment.model import Regression
from palpate_assessment.shapes import Bump, ridge
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
    """Maximum radius over the largest one of the bumps that are tried first."""
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
    widest = np.log((lengths.radii_m[-1] * SEARCH.widest, lengths.wide_edge_m))
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
