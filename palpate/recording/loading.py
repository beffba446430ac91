"""Forces of presses at a depth from their loading: F = F_D (d / D)^n, with exponents n that scatter about the body's own.

Each press has its force F_D and exponent n_i by non-linear least squares, with the prior n_i ~ N(n, s^2). n and s are those of
the body: median and spread of the exponents that presses have of their own, less what noise adds to the spread (empirical Bayes).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from palpate_models.numerics.frames import Array

FROM: Final = 0.5
"""Readings from this share of the depth on count."""
USUAL: Final = (1.4, 1.0)
"""Mean and SD of the exponents of any body."""
_STEPS: Final = 8
_MAD: Final = 1.4826
"""SD of a normal distribution over its median absolute deviation."""


@dataclass(frozen=True)
class Loading:
    """Presses of one body; k of them."""

    force: Array
    """At the depth of each [N], shape (k,)."""
    noise: Array
    """SE of it [N], shape (k,)."""
    exponent: float
    """Median of n."""
    exponent_sd: float
    """Spread of n from press to press."""


def loading(depths: Sequence[Array], forces: Sequence[Array], ends: Sequence[float], noise_n: Sequence[float]) -> Loading:
    """Return the forces of presses at the depths `ends` [m], with the SD of the white noise of their readings [N]."""
    rows = []
    for depth, force, end, noise in zip(depths, forces, ends, noise_n, strict=True):
        near = (depth >= FROM * end) & (depth <= 1.1 * end)
        near = near if near.any() else np.abs(depth - end) == np.abs(depth - end).min()
        rows.append((np.log(np.maximum(depth[near], 1e-6) / end), force[near], noise))
    own = [_fit(*row, *USUAL) for row in rows if len(row[0]) > 2]
    mean, spread = USUAL
    if own:
        exponents, variances = np.array([(found[1], found[3]) for found in own]).T
        mean = float(np.median(exponents))
        scatter = _MAD * float(np.median(np.abs(exponents - mean)))
        spread = float(np.sqrt(max(scatter**2 - float(np.median(variances)), 1e-4)))
    found = np.array([_fit(*row, mean, spread) for row in rows]).reshape(-1, 4)
    return Loading(found[:, 0], found[:, 2], mean, spread)


def _fit(log_depth: Array, force: Array, noise: float, mean: float, spread: float) -> tuple[float, float, float, float]:
    """Return force at the depth [N] and exponent of a press, the SE of the force [N], and the exponent's variance."""
    level, exponent = float(force[np.argmax(log_depth)]), mean
    weight = 1.0 / max(noise, 1e-6) ** 2
    for _ in range(_STEPS):
        shape = np.exp(exponent * log_depth)
        slopes = np.column_stack((shape, level * shape * log_depth))
        information = weight * slopes.T @ slopes + np.diag((1e-12, 1.0 / spread**2))
        pull = weight * slopes.T @ (force - level * shape) + np.array((0.0, (mean - exponent) / spread**2))
        change = np.linalg.solve(information, pull)
        level, exponent = level + float(change[0]), exponent + float(np.clip(change[1], -0.5, 0.5))
    covariance = np.linalg.inv(information)
    return level, exponent, float(np.sqrt(covariance[0, 0])), float(covariance[1, 1])
