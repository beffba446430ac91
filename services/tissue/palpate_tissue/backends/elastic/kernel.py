"""What a normal force on the skin of a uniform layer does to the skin: the layer's surface Green's function."""

from __future__ import annotations

import math

import numpy as np
from scipy.integrate import simpson
from scipy.interpolate import CubicSpline
from scipy.special import j0

from palpate_models.numerics.frames import Array

SELF_WEIGHT = 3.92
"""Displacement that a vertex's own pressure adds, over its force / sqrt(area): what makes the sum of 1/r over a lattice equal the
integral (a corrected trapezoidal rule; Marin, Runborg and Tornberg 2014). Regularised lattice sums (Epstein zeta at 1/2) give
3.900 on a square lattice and 3.921 on a hexagonal one, so it hardly depends on the mesh."""

_FARTHEST = 12.0
"""Distance over thickness up to which the layer's function is tabulated; beyond, a layer's skin is at rest."""


def layer_factor(wave: Array, poisson: float) -> Array:
    """Compliance of a layer bonded to a rigid base over that of the half-space, for pressure of wave number k = wave / H.

    L(u) = (2 c sinh 2u - 4u) / (2 c cosh 2u + 4u^2 + 1 + c^2), c = 3 - 4 nu (Vorovich, Alexandrov and Babeshko 1974;
    Johnson, Contact Mechanics, section 5.8). 1 for short waves, u (1 - 2 nu) / (2 (1 - nu)^2), uniaxial strain, for long ones.
    """
    c = 3 - 4 * poisson
    fade = np.exp(-2 * wave)  # numerator and denominator are divided by exp(2 u) / 2, which overflows
    above = 2 * c * (1 - fade**2) - 8 * wave * fade
    below = 2 * c * (1 + fade**2) + 2 * (4 * wave**2 + 1 + c * c) * fade
    return np.asarray(above / below)


class LayerKernel:
    """Normal displacement of the skin by a normal force on it.

    u(r) = (1 - nu^2) / (pi E) F k(r),  k(r) = 1/r - g(r/H)/H,  g(s) = int_0^inf (1 - L(u)) J0(u s) du.

    The first term is Boussinesq's half-space, the second the base at depth H below; `thickness_m` = inf leaves it out.
    """

    def __init__(self, poisson: float = 0.49, thickness_m: float = math.inf) -> None:
        if not 0 <= poisson < 0.5:
            raise ValueError(f"poisson = {poisson}: want 0 <= poisson < 0.5")
        if not thickness_m > 0:
            raise ValueError(f"thickness_m = {thickness_m}: want more than 0")
        self.poisson = poisson
        self.thickness_m = thickness_m
        self._base = _base_term(poisson) if math.isfinite(thickness_m) else None

    def factor(self, young_pa: float) -> float:
        """(1 - nu^2) / (pi E) [1/Pa]."""
        return (1 - self.poisson**2) / (math.pi * young_pa)

    def __call__(self, distance: Array) -> Array:
        """k(r) [1/m] at distances r > 0 [m], any shape."""
        near = 1 / distance
        return near if self._base is None else near - self._by_base(distance)

    def at_own_place(self, area: Array) -> Array:
        """K at a vertex's own place [1/m], for vertices of `area` [m^2], same shape."""
        own = SELF_WEIGHT / np.sqrt(area)
        return own if self._base is None else own - self._by_base(np.zeros_like(area))

    def _by_base(self, distance: Array) -> Array:
        assert self._base is not None
        s = distance / self.thickness_m
        inside = s < _FARTHEST
        # Far out, the base takes away all of the half-space's displacement.
        return np.where(inside, self._base(np.minimum(s, _FARTHEST)), 1 / np.maximum(s, 1.0)) / self.thickness_m


def _base_term(poisson: float) -> CubicSpline:
    """g(s) for 0 <= s <= _FARTHEST."""
    wave = np.linspace(0, 20, 8001)
    short = 1 - layer_factor(wave, poisson)
    at = np.concatenate((np.linspace(0, 4, 161), np.linspace(4, _FARTHEST, 121)[1:]))
    return CubicSpline(at, simpson(short[None, :] * j0(at[:, None] * wave[None, :]), x=wave, axis=1))
