"""Lumps drawn for a person within the ranges of a population."""

from __future__ import annotations

from math import dist

import numpy as np

from palpate_models.patient.schema import Draw, Lesion, Range

GAP_M = (0.002, 0.020)
"""Between the outlines of a pair."""
_TRIES = 50


def drawn_lumps(draw: Draw, rng: np.random.Generator) -> tuple[Lesion, ...]:
    """The lumps of one person, beside each other as far as the region has room for them."""
    count = int(rng.integers(draw.lumps[0], draw.lumps[1] + 1))
    lumps: list[Lesion] = []
    while len(lumps) < count:
        first = _apart(draw, rng, lumps)
        lumps.append(first)
        if len(lumps) < count and rng.random() < draw.pairs:
            lumps.append(_beside(first, _lump(draw, rng, first.centre_m), rng))
    return tuple(lumps)


def _place(draw: Draw, rng: np.random.Generator) -> tuple[float, float]:
    """A centre [m] within the region, or on its border."""
    at = rng.uniform(-1, 1, 2)
    if draw.place == "edge":
        at[rng.integers(2)] = rng.choice((-1.0, 1.0))
    x, y = (at * np.array(draw.region_m) / 2).tolist()
    return x, y


def _lump(draw: Draw, rng: np.random.Generator, centre_m: tuple[float, float]) -> Lesion:
    small = _between(draw.radius_m, rng)
    radii = (small, small * float(rng.uniform(*draw.elongation)))
    return Lesion(
        centre_m=centre_m,
        radii_m=radii if rng.random() < 0.5 else radii[::-1],
        contrast=_between(draw.contrast, rng),
        depth_m=float(rng.uniform(*draw.depth_m)),
    )


def _between(limits: Range, rng: np.random.Generator) -> float:
    """A number whose logarithm is evenly drawn."""
    return float(np.clip(np.exp(rng.uniform(*np.log(limits))), *limits))


def _apart(draw: Draw, rng: np.random.Generator, others: list[Lesion]) -> Lesion:
    """A lump that overlaps none of the others; of some tries the one farthest from them, if none is free."""
    best, most = _lump(draw, rng, _place(draw, rng)), -np.inf
    for _ in range(_TRIES):
        lump = best.model_copy(update={"centre_m": _place(draw, rng)})
        gap = min((dist(lump.centre_m, one.centre_m) - max(lump.radii_m) - max(one.radii_m) for one in others), default=np.inf)
        if gap > most:
            best, most = lump, gap
        if gap > 0:
            break
    return best


def _beside(first: Lesion, second: Lesion, rng: np.random.Generator) -> Lesion:
    """The second lump of a pair, in a random direction from the first and a gap away from its outline."""
    angle = rng.uniform(0, 2 * np.pi)
    away = np.array((np.cos(angle), np.sin(angle)))
    reach = sum(1 / np.hypot(*(away / np.array(lump.radii_m))) for lump in (first, second)) + rng.uniform(*GAP_M)
    x, y = (np.array(first.centre_m) + reach * away).tolist()
    return second.model_copy(update={"centre_m": (x, y)})
