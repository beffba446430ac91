"""Reference solution of the surface tier's equations: axisymmetric finite elements that share no code with the tissue.

    k_w u - (1/r) (r G u')' = p,    p >= 0,  u >= w(r),  p (u - w) = 0,    w(r) = d - R + sqrt(R^2 - r^2)

A mesh of the tissue must converge to it for any k_w(r) and G(r), so it is a reference for lumps and for the flat surface.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from palpate_models.numerics.frames import Array

Profile = Callable[[Array], Array]

OUTER_M = 0.12
"""Radius at which the surface is fixed: eight Pasternak lengths."""
MOST_ITERATIONS = 200


def uniform(value: float) -> Profile:
    """Return a constant profile."""
    return lambda r: np.full_like(r, value)


def lump(value: float, radius: float, contrast: float, edge: float) -> Profile:
    """Return a profile of `value`, times `contrast` inside `radius` [m], with a cubic edge of width `edge` [m] centred there."""

    def profile(r: Array) -> Array:
        t = np.clip(0.5 - (r - radius) / edge, 0.0, 1.0)
        return value * (1 + (contrast - 1) * t * t * (3 - 2 * t))

    return profile


def static_force(depth: float, radius: float, k_w: Profile, shear: Profile, h: float = 2e-4) -> float:
    """Return the force [N] on a frictionless sphere of `radius` at `depth` [m]; `k_w` [N/m^3] and G = `shear` [N/m] over r [m].

    Linear elements of length `h` [m], lumped foundation, contact by the primal-dual active set method (Hintermueller, Ito
    and Kunisch 2002). Raises RuntimeError if the contact set does not settle.
    """
    r = np.arange(0, OUTER_M + h / 2, h)
    middle = (r[1:] + r[:-1]) / 2
    spring = shear(middle) * 2 * np.pi * middle / h
    area = 2 * np.pi * r * h
    area[0], area[-1] = np.pi * (h / 2) ** 2, np.pi * r[-1] * h
    diagonal = k_w(r) * area
    diagonal[:-1] += spring
    diagonal[1:] += spring
    hold = np.where(r < radius, depth - radius + np.sqrt(np.maximum(radius**2 - r**2, 0)), -1.0)
    active = hold > 0
    for _ in range(MOST_ITERATIONS):
        u = _solve(diagonal, spring, active, hold)
        f = diagonal * u
        f[:-1] -= spring * u[1:]
        f[1:] -= spring * u[:-1]
        new = np.where(active, f > 0, hold > u)
        new[-1] = False
        if (new == active).all():
            return float(f[active].sum())
        active = new
    raise RuntimeError(f"foundation: no contact set after {MOST_ITERATIONS} iterations at depth {depth} m")


def _solve(diagonal: Array, spring: Array, active: NDArray[np.bool_], hold: Array) -> Array:
    """Return the equilibrium with `u = hold` where `active` and u = 0 at the outer end."""
    prescribed = active.copy()
    prescribed[-1] = True
    value = np.where(active, hold, 0.0)
    right = np.where(prescribed, value, 0.0)
    right[:-1] += np.where(~prescribed[:-1] & prescribed[1:], spring * value[1:], 0.0)
    right[1:] += np.where(~prescribed[1:] & prescribed[:-1], spring * value[:-1], 0.0)
    band = np.zeros((2, len(diagonal)))
    band[1] = np.where(prescribed, 1.0, diagonal)
    band[0, 1:] = np.where(prescribed[:-1] | prescribed[1:], 0.0, -spring)
    return np.asarray(solveh_banded(band, right))
