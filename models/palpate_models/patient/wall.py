"""The stiffening wall: pressure of a foundation spring in addition to its linear viscoelastic part.

The pressure on skin displaced inward by u, of which y_k has relaxed, is

    p = k_w [ u - sum_k y_k + sigma(u) + tension a max(u, 0) ]        sigma'(u) = min((beta u)^2, MOST_STIFFENING)  for u > 0

beta is `PhantomModel.stiffening` [1/m]: the modulus grows to k_w (1 + (beta u)^2), and no further than by MOST_STIFFENING k_w.
`PhantomModel.tension` is what a wholly contracted muscle adds, and a in [0, 1] how far it is contracted. Both are elastic springs
parallel to the linear wall: each element is passive, so their sum is (while a is constant: a muscle does work).

The power of the law is the one with which the pressed wall behaves as living people's (`remus2024`): sigma' as the
square of the depth reproduces all 48 places within 5 % and both exponents of their force, sigma' as the depth itself does not.

Each tier steps these equations in its own way: the surface tier in `palpate_tissue.backends.winkler.tissue`, the FMU in C.
"""

import math
from typing import NamedTuple

import numpy as np

from palpate_models.numerics.frames import Array

MOST_STIFFENING = 15.0
"""The stiffening spring's modulus is at most this many times k_w: none measured is stiffer at 20 mm, and it bounds the step."""


def straight_from(stiffening: Array) -> Array:
    """Displacement [m] from which a stiffening spring of beta = `stiffening` [1/m] is straight; infinite where beta is 0."""
    with np.errstate(divide="ignore"):
        return np.asarray(math.sqrt(MOST_STIFFENING) / np.asarray(stiffening, dtype=np.float64))


def stress(u: Array, stiffening: Array) -> Array:
    """The stiffening spring's pressure over k_w, sigma(u) [m], at displacements `u` [m]: beta^2 u^3 / 3, then straight on."""
    pressed = np.maximum(u, 0.0)
    bent = np.minimum(pressed, straight_from(stiffening))
    return np.asarray(stiffening**2 * bent**2 * (pressed - 2 / 3 * bent))


def slope(u: Array, stiffening: Array) -> Array:
    """Its modulus over k_w, sigma'(u) [1]."""
    return np.minimum((stiffening * np.maximum(u, 0.0)) ** 2, MOST_STIFFENING)


def stored(u: Array, stiffening: Array) -> Array:
    """Its energy over k_w and area [m^2]: the integral of `stress`."""
    pressed = np.maximum(u, 0.0)
    bent = np.minimum(pressed, straight_from(stiffening))
    return np.asarray(stiffening**2 * bent**2 * (pressed**2 / 2 - 2 / 3 * bent * pressed + bent**2 / 4))


def largest_slope(stiffening: Array, tension: Array) -> Array:
    """Return the most that both springs can add to the modulus, over k_w [1]: what a step must be stable for."""
    return np.where(stiffening > 0, MOST_STIFFENING, 0.0) + tension


class WallParameters(NamedTuple):
    """Parameters of the wall at a healthy place, without relaxation."""

    k_w_n_per_m3: float
    """Instantaneous foundation modulus."""
    length_m: float
    """Pasternak length."""
    stiffening_per_m: float
    """beta."""


MEDIAN = WallParameters(k_w_n_per_m3=2.35e5, length_m=0.0157, stiffening_per_m=79.0)
"""The median person: fitted to the median force of the 48 relaxed places of `palpate_models.patient.remus2024`, and rounded."""
