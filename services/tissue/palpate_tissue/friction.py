"""Coulomb friction between indenter and skin, with the skin's own shear compliance before it slips."""

from __future__ import annotations

import math

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
        self.stretch: Vector = (0.0, 0.0, 0.0)

    def release(self) -> None:
        """Contact is lost: the skin springs back."""
        self.stretch = (0.0, 0.0, 0.0)

    def step(self, dt: float, velocity: Vector, normal: Vector, load: float) -> Vector:
        """Friction force on the indenter [N] after `dt` [s].

        `velocity` [m/s] is of the indenter's surface against the tissue, `normal` of unit length, `load` the normal
        force [N]; all in one frame.
        """
        limit = self.coefficient * load
        if limit <= 0:
            self.release()
            return self.stretch
        nx, ny, nz = normal
        x, y, z = (s + v * dt for s, v in zip(self.stretch, velocity, strict=True))
        along = x * nx + y * ny + z * nz
        x, y, z = x - along * nx, y - along * ny, z - along * nz
        pull = self.stiffness * math.sqrt(x * x + y * y + z * z)
        if pull > limit:
            share = limit / pull
            x, y, z = x * share, y * share, z * share
        self.stretch = (x, y, z)
        k = -self.stiffness
        return (k * x, k * y, k * z)
