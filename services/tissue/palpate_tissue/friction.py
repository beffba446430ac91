"""Coulomb friction between indenter and skin, with the skin's own shear compliance before it slips.

An elastic-plastic bristle: the skin sticks and shears by s with a constant stiffness k, and slips at the Coulomb limit,

    s' = P v   while k |s| < mu N,     F = -k s

P takes out what is along the normal. It is passive: k is constant, and slipping, turning and unloading only ever shorten s.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array
from palpate_models.numerics.vectors import Vector, add, cross, divide, dot, norm, scale, subtract, velocity_at

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


class Bristle(NamedTuple):
    """The skin under the indenter, as friction sees it."""

    coefficient: float
    """mu."""
    stiffness: float
    """k [N/m]."""
    stretch: Array
    """s [m], shape (3,): how far the skin is sheared. Changed in place."""

    def release(self) -> None:
        """Contact is lost: the skin springs back."""
        self.stretch[:] = 0.0

    def energy(self) -> float:
        """What the sheared skin stores [J]."""
        return 0.5 * self.stiffness * float(self.stretch @ self.stretch)


def skin(coefficient: float, background: Array) -> Bristle:
    """Unsheared skin over a wall of foundation moduli `background` [N/m^3], shape (n,)."""
    return Bristle(float(coefficient), shear_stiffness(float(np.median(background))), np.zeros(3))


class Sphere(NamedTuple):
    """The indenter, in the abdomen frame A."""

    p: Vector
    """Its centre [m]."""
    v: Vector
    """Velocity of the centre [m/s]."""
    w: Vector
    """Angular velocity [rad/s]."""
    radius: float
    """[m]"""


class Push(NamedTuple):
    """What holding the skin on the frictionless sphere takes."""

    force: Vector
    """On the sphere [N]."""
    normal: Vector
    """Sum of the vertices' contact forces times their outward normals [N]."""
    arm: Vector
    """Centre of the contact forces from the sphere's centre [m]."""


@compiled
def shear(bristle: Bristle, velocity: Vector, normal: Vector, load: float, h: float) -> Vector:
    """Friction force on the indenter [N] after `h` [s].

    `velocity` [m/s] is of the indenter's surface against the tissue, `normal` of unit length, `load` the normal force [N].
    """
    s = add((bristle.stretch[0], bristle.stretch[1], bristle.stretch[2]), scale(h, velocity))
    s = subtract(s, scale(dot(s, normal), normal))
    pull, limit = bristle.stiffness * norm(s), bristle.coefficient * load
    if limit <= 0.0:
        s = (0.0, 0.0, 0.0)
    elif pull > limit:
        s = scale(limit / pull, s)
    bristle.stretch[0], bristle.stretch[1], bristle.stretch[2] = s
    return scale(-bristle.stiffness, s)


@compiled
def rub(bristle: Bristle, sphere: Sphere, push: Push, h: float, wrench: Array) -> None:
    """Adds friction to a push: `wrench` (6,) gets force [N] and torque about the centre [N m] on the sphere after `h` [s].

    Friction acts in the mean tangent plane, at the centre of the contact forces, against the sphere's surface there.
    """
    load = norm(push.normal)
    friction = shear(bristle, velocity_at(sphere.v, sphere.w, push.arm), divide(push.normal, load), load, h)
    wrench[0], wrench[1], wrench[2] = add(push.force, friction)
    wrench[3], wrench[4], wrench[5] = cross(push.arm, friction)
