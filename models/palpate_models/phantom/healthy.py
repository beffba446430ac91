"""The healthy wall of a person: muscles, bones and natural variation, as factors of the wall's mean."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from palpate_models.anatomy import Anatomy, Muscles
from palpate_models.frames import Array
from palpate_models.phantom.bones import bone_share
from palpate_models.phantom.field import smoothstep
from palpate_models.phantom.parametric import parametric_surface
from palpate_models.phantom.variation import NaturalField
from palpate_models.seeds import generator

_MUSCLE_EDGE_M = 0.010
"""Width over which one band passes into the next [A]."""
_LEAST_RANDOM = 0.3
"""Least part of the variation that muscles do not account for."""
_COARSE_M = 0.02
_BELLY_HALF_M = 0.10


class HealthyWall(NamedTuple):
    """A person's wall over the wall's mean, at n points."""

    stiffness: Array
    """Factor on the foundation modulus [1], shape (n,)."""
    stiffening: Array
    """Stiffening [1/m], shape (n,)."""


def belly(size_m: tuple[float, float, float], anatomy: Anatomy) -> Array:
    """Places that stand for the belly of a body [m], shape (m, 3): its front within 0.1 m of the umbilicus, bones excepted."""
    shape = parametric_surface(size_m, _COARSE_M, anatomy)
    x, y, _ = shape.vertices.T
    near = (np.abs(x) <= _BELLY_HALF_M) & (np.abs(y) <= _BELLY_HALF_M) & (shape.normals[:, 2] > 0.5)
    return np.asarray(shape.vertices[near & (bone_share(x, y, anatomy.skeleton) < 0.01)])


def muscle_factor(x: Array, y: Array, muscles: Muscles) -> Array:
    """Stiffness over that at the sides, shape as the points' [m]; the linea alba narrows below the umbilicus."""
    middle = muscles.linea_alba_m / 2 * (0.75 + 0.25 * np.tanh(y / 0.03))
    away = np.abs(x)
    alba = smoothstep(0.5 - (away - middle) / _MUSCLE_EDGE_M)
    within = smoothstep(0.5 - (away - middle - muscles.rectus_m) / _MUSCLE_EDGE_M)
    return np.asarray(1 + (muscles.linea_alba - 1) * alba + (muscles.rectus - 1) * (within - alba))


def healthy_wall(
    points: Array, size_m: tuple[float, float, float], anatomy: Anatomy, stiffening: float, seed: int
) -> HealthyWall:
    """The wall of a person at points (n, 3) of A [m], whose mean `stiffening` [1/m] is given.

    Over the belly the logarithm of the first has the mean 0, and both have the deviations and the correlation that
    `anatomy.variation` says: what the muscles do not account for is a random field. The wall over bone comes on top.
    """
    variation = anatomy.variation
    reference = belly(size_m, anatomy)
    rng = generator(seed, "variation")
    level, other = (NaturalField(rng, variation.length_m, reference) for _ in range(2))
    at_belly = np.log(muscle_factor(reference[:, 0], reference[:, 1], anatomy.muscles))
    random = np.sqrt(max(variation.stiffness**2 - at_belly.var(), (_LEAST_RANDOM * variation.stiffness) ** 2))
    x, y = points[:, 0], points[:, 1]
    log_level = np.log(muscle_factor(x, y, anatomy.muscles)) - at_belly.mean() + random * level(points)
    total = np.sqrt(random**2 + at_belly.var())
    rho = variation.correlation
    shared = rho * log_level / total if total > 0 else 0.0
    local = np.maximum(stiffening + variation.stiffening_per_m * (shared + np.sqrt(1 - rho**2) * other(points)), 0.0)
    bone = bone_share(x, y, anatomy.skeleton)
    return HealthyWall(
        np.exp(log_level) * (1 + (anatomy.bone - 1) * bone),
        (1 - bone) * local + bone * anatomy.bone_stiffening_per_m,
    )
