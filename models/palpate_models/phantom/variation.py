"""The natural variation of a person's wall: fields of families that no prior of the assessment has.

A field is a weighted sum of a few components. Each has a family, a length, an anisotropy and a direction of its own, and none is
Gaussian: ridges have crests, patches have borders, hills are log-normal, and waves have heavy-tailed frequencies and weights.
Fields are functions of position, made from random Fourier features (Rahimi and Recht 2007), and do not depend on the mesh.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from palpate_models.frames import Array

_FEATURES = 96
_COMPONENTS = 3
_MOST_ANISOTROPIC = 3.0
"""Largest ratio of the lengths along and across a component's direction [A]."""
_MOST = 3.0
"""A field comes no further from its mean than this many standard deviations: one healthy place is not another tissue."""


@dataclass(frozen=True)
class _Waves:
    """sum_k weight_k cos(frequency_k . p + phase_k)."""

    frequency: Array
    phase: Array
    weight: Array

    def __call__(self, points: Array) -> Array:
        return np.asarray(np.cos(points @ self.frequency + self.phase) @ self.weight)


def _waves(rng: np.random.Generator, lengths: Array, heavy: bool) -> _Waves:
    """Waves of unit variance whose correlation falls over `lengths` [m] along three axes, turned about z by a random angle.

    `heavy`: Student frequencies, so the correlation is Matern's of smoothness 3/2, and Student weights: a few waves stand out.
    """
    frequency = rng.standard_normal((3, _FEATURES))
    weight = np.ones(_FEATURES)
    if heavy:
        frequency /= np.sqrt(rng.chisquare(3, _FEATURES) / 3)
        weight = rng.standard_t(3, _FEATURES)
    angle = rng.uniform(0, np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    phase = rng.uniform(0, 2 * np.pi, _FEATURES)
    return _Waves(turn @ (frequency / lengths[:, None]), phase, weight * np.sqrt(2 / (weight**2).sum()))


def _ridges(g: Array) -> Array:
    return np.asarray(-np.sqrt(g**2 + 0.01))


def _patches(g: Array) -> Array:
    return np.tanh(3 * g)


def _hills(g: Array) -> Array:
    return np.exp(0.8 * g)


_FAMILIES: tuple[Callable[[Array], Array] | None, ...] = (_ridges, _patches, _hills, None)
"""What is made of waves; None: heavy-tailed waves as they are."""


class NaturalField:
    """A random field over a body, of mean 0 and standard deviation 1 over reference points on it."""

    def __init__(self, rng: np.random.Generator, length_m: tuple[float, float], reference: Array) -> None:
        """`length_m`: the shortest and the longest length of a component [m]; `reference` (m, 3) in A [m]."""
        self._parts: list[tuple[float, _Waves, Callable[[Array], Array] | None, float, float]] = []
        shares = rng.dirichlet(np.full(_COMPONENTS, 2.0))
        for share in shares:
            family = _FAMILIES[rng.integers(len(_FAMILIES))]
            length = np.exp(rng.uniform(*np.log(length_m)))
            longer = np.exp(rng.uniform(0, np.log(_MOST_ANISOTROPIC)))
            lengths = np.array((min(length * longer, length_m[1]), length, length))
            waves = _waves(rng, lengths, heavy=family is None)
            values = family(waves(reference)) if family else waves(reference)
            self._parts.append((float(np.sqrt(share)), waves, family, float(values.mean()), float(values.std())))
        total = self._sum(reference)
        self._mean, self._sd = float(total.mean()), float(total.std())

    def _sum(self, points: Array) -> Array:
        total = np.zeros(len(points))
        for weight, waves, family, mean, sd in self._parts:
            values = waves(points)
            total += weight * ((family(values) if family else values) - mean) / sd
        return total

    def __call__(self, points: Array) -> Array:
        """At points (n, 3) of A [m], shape (n,)."""
        return _MOST * np.tanh((self._sum(points) - self._mean) / (_MOST * self._sd))
