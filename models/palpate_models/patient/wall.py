"""The stiffening wall: pressure of a foundation spring in addition to its linear viscoelastic part.

The pressure on skin displaced inward by u, of which y_k has relaxed, is

    p = k_w [ u - sum_k y_k + sigma(u) + tension a max(u, 0) ]        sigma'(u) = min((beta u)^2, MOST_STIFFENING)  for u > 0

beta is `PhantomModel.stiffening` [1/m]: the modulus grows to k_w (1 + (beta u)^2), and no further than by MOST_STIFFENING k_w.
`PhantomModel.tension` is what a wholly contracted muscle adds, and a in [0, 1] how far it is contracted. Both are elastic springs
parallel to the linear wall: each element is passive, so their sum is (while a is constant: a muscle does work).

The power of the law is the one with which the pressed wall behaves as living people's (`remus2024`): sigma' as the
square of the depth reproduces all 48 places within 5 % and both exponents of their force, sigma' as the depth itself does not.

Each tier steps these equations in its own way: the surface tier in `palpate_tissue.backends.winkler.tissue`, the FMU in C.

Guarding is a wide area of contracted muscle, and its response to pressing.
"""

import math
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field

from palpate_models.numerics.frames import Array
from palpate_models.section import Length, Section, Vec2

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


def stored_energy(u: Array, stiffening: Array) -> Array:
    """Its energy over k_w and area [m^2]: the integral of `stress`."""
    pressed = np.maximum(u, 0.0)
    bent = np.minimum(pressed, straight_from(stiffening))
    return np.asarray(stiffening**2 * bent**2 * (pressed**2 / 2 - 2 / 3 * bent * pressed + bent**2 / 4))


def largest_slope(stiffening: Array, tension: Array) -> Array:
    """Return the maximum that both springs can add to the modulus, over k_w [1]: what a step must be stable for."""
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


GENTLE_DEPTH_M, DEEP_M = 0.012, 0.025
"""Depths of no and of full provocation [m] [assumption]: light palpation is described as 10 to 20 mm deep."""
GENTLE_SPEED_MPS, FAST_MPS = 0.010, 0.050
"""Speeds of no and of full provocation [m/s] [assumption]."""
CONTRACTION_S = 0.1
"""Time constant of contraction: 90 % within 0.23 s [assumption]."""
FADING_S = 3.0
"""Time constant of relaxation under gentle pressure [assumption]."""


class Guarding(Section):
    """An area of contracted muscle with a wide, smooth edge, elliptic in the abdomen's xy plane. It is not a lesion."""

    centre_m: Vec2
    """Centre, x to the patient's left and y to the head, from the umbilicus."""
    radii_m: tuple[Length, Length] = (0.06, 0.06)
    """Half axes of the outline, on which the tension is half of that at the centre."""
    ratio: Annotated[float, Field(gt=1, le=6.5)] = 2.6
    """Contracted over relaxed force on a sphere of 10 mm radius, pressed 10 mm deep at 5 mm/s. Measured: median 2.6, maximum 6.2
    (Remus 2024)."""
    kind: Literal["voluntary", "involuntary"] = "involuntary"
    """`voluntary` guarding fades under gentle pressure (`Activation`)."""
    edge_m: Annotated[float, Field(ge=0.02, le=0.3)] = 0.06
    """Width of the smooth edge, centred on the outline."""


class Activation:
    """Contraction a in [0, 1] of guarding muscle, of first order towards its provocation g.

        a' = (g - a) / tau,   tau = CONTRACTION_S where g > a, else FADING_S
        g = max(ramp(depth; GENTLE_DEPTH_M, DEEP_M), ramp(speed; GENTLE_SPEED_MPS, FAST_MPS))

    A ramp is 0 below the first of its limits and 1 above the second.
    Involuntary guarding stays at 1. Voluntary guarding does not change without touch. These rates were
    not measured, so all constants are assumptions.
    """

    def __init__(self, voluntary: bool, dt: float) -> None:
        """`dt`: period [s]."""
        self.voluntary = voluntary
        self._contracting, self._fading = (1 - math.exp(-dt / tau) for tau in (CONTRACTION_S, FADING_S))

    def after(self, level: float, depth_m: float, speed_mps: float) -> float:
        """Return a one period after `level`, under a touch `depth_m` deep [m] that moves inward at `speed_mps` [m/s]."""
        if not self.voluntary:
            return level
        provoked = max(_ramp(depth_m, GENTLE_DEPTH_M, DEEP_M), _ramp(speed_mps, GENTLE_SPEED_MPS, FAST_MPS))
        share = self._contracting if provoked > level else self._fading
        return level + share * (provoked - level)


def _ramp(value: float, begin: float, end: float) -> float:
    return min(max((value - begin) / (end - begin), 0.0), 1.0)
