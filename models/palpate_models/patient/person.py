"""Random persons: body, wall, anatomy, breathing, lumps and guarding, drawn from statistics of living people.

Marks of certainty: [V] read in the source, [C] computed from measurements, [M] from memory of the literature, [A] assumed.
"""

from functools import cache
from math import dist
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_models.numerics.frames import Array
from palpate_models.numerics.seeds import generator
from palpate_models.patient import schema
from palpate_models.patient.motion import Breathing
from palpate_models.patient.remus2024 import fitted
from palpate_models.patient.wall import Guarding


class PersonTuning(NamedTuple):
    """Distributions of a person, besides the body and the wall."""

    gap_m: tuple[float, float] = (0.002, 0.020)
    """Range of the gap between the outlines of a pair of lumps, uniform."""
    tries: int = 50
    measured_fat_m: float = 0.015
    """Fat thickness included in the measurements: young men with a body mass index of 19.5 to 24.6 [A]."""
    fat_young_pa: float = 3000.0
    """Young's modulus of fat [M: 1.6 to 3.3 kPa excised]."""
    build_shares: tuple[float, float, float] = (0.2, 0.5, 0.3)
    """Share of each build [A]."""
    breaths_per_min: tuple[float, float, float] = (12.0, 14.0, 20.0)
    """Minimum, mode and maximum of a person's mean quiet breathing rate. Mode: Ragnarsdottir 2006 [V]; ends [A]."""
    breath_m: tuple[float, float] = (0.005, 0.012)
    """Range of a person's mean quiet breathing depth at the umbilicus, uniform [A]."""


PEOPLE: Final = PersonTuning()


def drawn_lumps(draw: schema.Draw, rng: np.random.Generator) -> tuple[schema.Lesion, ...]:
    """Return the lumps of one person, without overlap as far as the region has room."""
    count = int(rng.integers(draw.lumps[0], draw.lumps[1] + 1))
    lumps: list[schema.Lesion] = []
    while len(lumps) < count:
        first = _separate_lump(draw, rng, lumps)
        lumps.append(first)
        if len(lumps) < count and rng.random() < draw.pairs:
            lumps.append(_move_beside(first, _lump(draw, rng, first.centre_m), rng))
    return tuple(lumps)


def _place(draw: schema.Draw, rng: np.random.Generator) -> tuple[float, float]:
    """Return a centre [m] in the region or on its border."""
    at = rng.uniform(-1, 1, 2)
    if draw.place == "edge":
        at[rng.integers(2)] = rng.choice((-1.0, 1.0))
    x, y = (at * np.array(draw.region_m) / 2).tolist()
    return x, y


def _lump(draw: schema.Draw, rng: np.random.Generator, centre_m: tuple[float, float]) -> schema.Lesion:
    small = _log_uniform(draw.radius_m, rng)
    radii = (small, small * float(rng.uniform(*draw.elongation)))
    return schema.Lesion(
        centre_m=centre_m,
        radii_m=radii if rng.random() < 0.5 else radii[::-1],
        contrast=_log_uniform(draw.contrast, rng),
        depth_m=float(rng.uniform(*draw.depth_m)),
    )


def _log_uniform(limits: tuple[float, float], rng: np.random.Generator) -> float:
    """Return a number from the log-uniform distribution between `limits`."""
    return float(np.clip(np.exp(rng.uniform(*np.log(limits))), *limits))


def _separate_lump(draw: schema.Draw, rng: np.random.Generator, others: list[schema.Lesion]) -> schema.Lesion:
    """Return a lump that overlaps no other; if no try succeeds, the one farthest from the others."""
    best, best_gap = _lump(draw, rng, _place(draw, rng)), -np.inf
    for _ in range(PEOPLE.tries):
        lump = best.model_copy(update={"centre_m": _place(draw, rng)})
        gaps = (dist(lump.centre_m, other.centre_m) - max(lump.radii_m) - max(other.radii_m) for other in others)
        gap = min(gaps, default=np.inf)
        if gap > best_gap:
            best, best_gap = lump, gap
        if gap > 0:
            break
    return best


def _move_beside(first: schema.Lesion, second: schema.Lesion, rng: np.random.Generator) -> schema.Lesion:
    """Return the second lump of a pair, moved in a random direction from the first to a random gap between the outlines."""
    angle = rng.uniform(0, 2 * np.pi)
    away = np.array((np.cos(angle), np.sin(angle)))
    reach = sum(1 / np.hypot(*(away / np.array(lump.radii_m))) for lump in (first, second)) + rng.uniform(*PEOPLE.gap_m)
    x, y = (np.array(first.centre_m) + reach * away).tolist()
    return second.model_copy(update={"centre_m": (x, y)})


class WallStatistics(NamedTuple):
    """Moments of ln k_w [N/m^3], ln length [m] and stiffening [1/m] of a place, in this order.

    Some fitted places do not stiffen, so the stiffening is not a logarithm.
    """

    mean: Array
    """Mean over people, shape (3,)."""
    between: Array
    """Covariance between people of their means over places, shape (3, 3)."""
    places: Array
    """Covariance of k_w and stiffening between places of one person, at equal length, shape (2, 2)."""


@cache
def wall_statistics() -> WallStatistics:
    """Return the statistics of the measured places, `fitted.csv`."""
    walls = [fit.wall for fit in fitted().values()]
    values = np.array([(np.log(wall.k_w_n_per_m3), np.log(wall.length_m), wall.stiffening_per_m) for wall in walls])
    return moments(values, np.array([person for _, person in fitted()]))


def moments(values: Array, person: NDArray[np.str_]) -> WallStatistics:
    """Return the moments of `values` (n, 3), each a place of a `person` (n,), by analysis of variance.

    The covariance of the persons' means contains a share of the covariance between places, which is subtracted. A person's wall
    has one length, so the covariance of the other two is conditional on the length.
    """
    people = [values[person == number] for number in np.unique(person)]
    means = np.array([rows.mean(axis=0) for rows in people])
    scatter = [(rows - mean).T @ (rows - mean) for rows, mean in zip(people, means, strict=True)]
    within = np.sum(scatter, axis=0) / (len(values) - len(people))
    repeats = float(np.mean([1 / len(rows) for rows in people]))
    variances, axes = np.linalg.eigh(np.cov(means.T) - repeats * within)
    between = (axes * np.maximum(variances, 0)) @ axes.T
    rest, length = [0, 2], 1
    places = within[np.ix_(rest, rest)] - np.outer(within[rest, length], within[rest, length]) / within[length, length]
    return WallStatistics(means.mean(axis=0), between, places)


Interval = tuple[float, float]

BUILDS = (schema.Build.SLIM, schema.Build.MEDIAN, schema.Build.OBESE)


class Figure(NamedTuple):
    """Ranges of the body of a build, uniform [A]."""

    width_m: Interval
    length_m: Interval
    height_m: Interval
    dome_m: Interval
    exponent: Interval
    fat_m: Interval


FIGURES = {
    schema.Build.SLIM: Figure((0.28, 0.32), (0.42, 0.46), (0.16, 0.19), (-0.012, 0.004), (2.4, 2.8), (0.004, 0.009)),
    schema.Build.MEDIAN: Figure((0.33, 0.38), (0.44, 0.48), (0.18, 0.22), (0.008, 0.018), (2.3, 2.6), (0.009, 0.015)),
    schema.Build.OBESE: Figure((0.42, 0.48), (0.46, 0.52), (0.25, 0.31), (0.025, 0.045), (2.0, 2.3), (0.030, 0.060)),
}


def draw_person(phantom: schema.Phantom, seed: int) -> schema.Phantom:
    """Return the phantom with all random parts of `kind: person` drawn; other phantoms and drawn persons are unchanged.

    Equal settings and seeds give equal persons. `draw` and `build` affect only their own parts.
    """
    if phantom.kind != "person" or phantom.anatomy is not None:
        return phantom
    rng = generator(seed, "person")
    build = phantom.build
    chosen = BUILDS[int(rng.choice(len(BUILDS), p=PEOPLE.build_shares))]
    figure = FIGURES[chosen if build is schema.Build.DRAWN else build]
    width, length, height, dome, exponent, fat = rng.uniform(*np.transpose(figure)).tolist()
    statistics = wall_statistics()
    people = rng.multivariate_normal(statistics.mean, statistics.between)
    wall = under_fat(_stiffness(people, rng), fat)
    anatomy = schema.Anatomy(
        fat_m=fat,
        dome_m=dome,
        exponent=exponent,
        skeleton=_skeleton(rng, length),
        muscles=schema.Muscles(  # at rest 0.9 to 1.4 times as stiff as the sides [A, within the measured variation]
            linea_alba_m=rng.uniform(0.012, 0.022),
            rectus_m=rng.uniform(0.055, 0.075),
            linea_alba=rng.uniform(0.9, 1.4),
            rectus=rng.uniform(1.0, 1.4),
        ),
        variation=_variation(statistics),
    )
    lumps = drawn_lumps(phantom.draw, generator(seed, "lumps"))
    return phantom.model_copy(
        update={
            "size_m": (width, length, height),
            "stiffness": wall,
            "background": schema.Background(cv=0, margins=1),
            "anatomy": anatomy,
            "breathing": _breathing(phantom.breathing, generator(seed, "breath")),
            "lesions": phantom.lesions + lumps,
            "guarding": phantom.guarding + _guarding(phantom.draw, generator(seed, "guarding")),
        }
    )


def _stiffness(people: Array, rng: np.random.Generator) -> schema.Stiffness:
    """Return a person's wall from ln k_w, ln length and stiffening; relaxation and friction are drawn [A]."""
    usual = schema.Stiffness()
    k_w, length = np.exp(people[:2]).tolist()
    relaxing = np.array(usual.prony_g) * np.exp(0.2 * rng.standard_normal(len(usual.prony_g)))
    relaxing *= min(1.0, 0.8 / relaxing.sum())
    times = np.array(usual.prony_tau_s) * np.exp(0.3 * rng.standard_normal(len(usual.prony_tau_s)))
    return schema.Stiffness(
        k_w_n_per_m3=k_w,
        length_m=length,
        stiffening_per_m=max(float(people[2]), 0.0),
        prony_g=tuple(relaxing.tolist()),
        prony_tau_s=tuple(times.tolist()),
        dashpot_s=usual.dashpot_s,
        friction=float(rng.uniform(0.2, 0.5)),
    )


def under_fat(wall: schema.Stiffness, fat_m: float) -> schema.Stiffness:
    """Return the wall under more fat than in the measurements: k_w and the fat's k_f = E / t in series [C, assumed model].

    Both carry the pressure p, so with the shares phi = k_s / k of the displacement and p = k (u + beta^2 u^3 / 3) of each,
    to third order  1 / k_s = 1 / k_w + 1 / k_f,  beta_s^2 = beta_w^2 phi_w^3 + beta_f^2 phi_f^3:  a softer start. The fat itself
    stiffens as it is flattened, beta_f = 1 / t. The wall's shear G = k_w l^2 stays, so the length grows to l (k_w / k_s)^(1/2).
    """
    extra = fat_m - PEOPLE.measured_fat_m
    if extra <= 0:
        return wall
    k_f = PEOPLE.fat_young_pa / extra
    of_wall = k_f / (wall.k_w_n_per_m3 + k_f)
    stiffening = np.sqrt(wall.stiffening_per_m**2 * of_wall**3 + (1 / extra) ** 2 * (1 - of_wall) ** 3)
    return wall.model_copy(
        update={
            "k_w_n_per_m3": wall.k_w_n_per_m3 * of_wall,
            "length_m": min(wall.length_m / float(np.sqrt(of_wall)), 0.1),
            "stiffening_per_m": float(stiffening),
        }
    )


def _breathing(breathing: Breathing, rng: np.random.Generator) -> Breathing:
    """Draw mean rate and depth of breathing where the scenario gives none. Deep breathing keeps its own values."""
    own = {"rate_per_min": rng.triangular(*PEOPLE.breaths_per_min), "peak_to_peak_m": rng.uniform(*PEOPLE.breath_m)}
    return breathing.model_copy(update={name: value for name, value in own.items() if name not in breathing.model_fields_set})


def _skeleton(rng: np.random.Generator, length: float) -> schema.Skeleton:
    """Draw ribs and iliac crests of a body of this length [m]: the lowest ribs are just above the umbilicus [M, ranges A]."""
    scale = length / 0.46
    return schema.Skeleton(
        costal_arch_m=scale * rng.uniform(0.16, 0.20),
        costal_slope=rng.uniform(0.5, 0.9),
        iliac_crest_m=(scale * rng.uniform(0.125, 0.145), -scale * rng.uniform(0.10, 0.14)),
    )


def _guarding(draw: schema.Draw, rng: np.random.Generator) -> tuple[Guarding, ...]:
    """Draw a contracted area. Its force ratio is that of a measured place [C]; position and size [A]."""
    if draw.guarding == "none":
        return ()
    ratios = [fit.activated_ratio for fit in fitted().values()]
    x, y = (rng.uniform(-0.3, 0.3, 2) * np.array(draw.region_m)).tolist()
    a, b = rng.uniform(0.045, 0.08, 2).tolist()
    ratio = float(np.quantile(ratios, rng.random()))
    return (Guarding(centre_m=(x, y), radii_m=(a, b), ratio=ratio, kind=draw.guarding),)


def _variation(statistics: WallStatistics) -> schema.Variation:
    stiffness, stiffening = np.sqrt(np.diag(statistics.places)).tolist()
    correlation = statistics.places[0, 1] / (stiffness * stiffening)
    return schema.Variation(stiffness=stiffness, stiffening_per_m=stiffening, correlation=float(np.clip(correlation, -1, 1)))
