"""Coulomb friction between indenter and skin, with the skin's own shear compliance before it slips."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from palpate_models.compiled import compiled

Array = NDArray[np.float64]
Vector = tuple[float, float, float]

REFERENCE_K_W = 1.7e5
REFERENCE_E = 1.0e4
"""A half-space of 10 kPa is the tissue of k_w = 1.7e5 N/m^3 (`palpate validate`: Hertz and this foundation agree at 10 mm)."""
REFERENCE_RADIUS_M = 0.012
"""Contact radius at 10 mm depth, about sqrt(R d) for indenters of 15 mm."""
POISSON = 0.49


def shear_stiffness(k_w: float) -> float:
    """Tangential contact stiffness [N/m] of tissue of foundation modulus `k_w` [N/m^3].

    8 a G / (2 - nu) of a sticking contact of radius a on a half-space (Mindlin 1949; Johnson, Contact Mechanics, section 7.2).
    """
    shear_modulus = REFERENCE_E * k_w / REFERENCE_K_W / (2 * (1 + POISSON))
    return 8 * REFERENCE_RADIUS_M * shear_modulus / (2 - POISSON)


class Friction:
    """An elastic-plastic bristle: skin sticks and shears with a constant stiffness, and slips at the Coulomb limit.

    Passive: the spring's stiffness is constant, and slipping, turning and unloading only ever shorten it.
    """

    def __init__(self, coefficient: float, stiffness: float) -> None:
        self.coefficient = coefficient
        self.stiffness = stiffness
        self.bristle: Array = np.zeros(3)
        """How far the skin is sheared [m], which `rub` carries on."""
        self.step(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.0)  # compiles it, so that the first contact need not wait

    @property
    def stretch(self) -> Vector:
        """How far the skin is sheared [m]."""
        x, y, z = self.bristle.tolist()
        return x, y, z

    def release(self) -> None:
        """Contact is lost: the skin springs back."""
        self.bristle[:] = 0.0

    def step(self, dt: float, velocity: Vector, normal: Vector, load: float) -> Vector:
        """Friction force on the indenter [N] after `dt` [s].

        `velocity` [m/s] is of the indenter's surface against the tissue, `normal` of unit length, `load` the normal
        force [N]; all in one frame.
        """
        return rub(self.bristle, self.coefficient, self.stiffness, dt, *velocity, *normal, load)


@compiled
def rub(
    bristle: Array,
    coefficient: float,
    stiffness: float,
    dt: float,
    vx: float,
    vy: float,
    vz: float,
    nx: float,
    ny: float,
    nz: float,
    load: float,
) -> Vector:
    """`Friction.step` for compiled code; `bristle` (3,) [m] is its state."""
    limit = coefficient * load
    if limit <= 0.0:
        bristle[:] = 0.0
        return 0.0, 0.0, 0.0
    x, y, z = bristle[0] + vx * dt, bristle[1] + vy * dt, bristle[2] + vz * dt
    along = x * nx + y * ny + z * nz
    x, y, z = x - along * nx, y - along * ny, z - along * nz
    pull = stiffness * sqrt(x * x + y * y + z * z)
    if pull > limit:
        share = limit / pull
        x, y, z = x * share, y * share, z * share
    bristle[0], bristle[1], bristle[2] = x, y, z
    return -stiffness * x, -stiffness * y, -stiffness * z
