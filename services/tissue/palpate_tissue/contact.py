"""The vertices of the skin that a sphere might touch while it stays near a place."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array
from palpate_models.numerics.vectors import Vector, add, cross, divide, dot, norm, scale, subtract, velocity_at

RIM = 0.2
"""Vertices are held by the sphere where its surface makes less than 78 degrees with the tangent plane (cos > 0.2)."""
_REACH_M = 0.030
"""Least depth of the sphere's centre below the rest surface at which the vertices found are still all that it might touch."""


class Near(NamedTuple):
    """Vertices that a sphere might touch while its centre stays near `origin`; m of them."""

    origin: list[float]
    """[m], three of them."""
    reach: float
    """How far the centre may go from there [m]."""
    radius: float
    """Radius of the sphere [m]."""
    vertex: NDArray[np.intp]
    """Which of the vertices searched, ascending, shape (m,)."""
    n: Array
    """Their outward normals, shape (m, 3)."""
    X: Array
    """Their positions from `origin` [m], shape (m, 3)."""

    def holds(self, p: list[float], radius: float) -> bool:
        """Whether this is still all that a sphere of `radius` [m] at `p` [m] might touch."""
        return radius == self.radius and math.dist(p, self.origin) <= self.reach


class VertexSearch:
    """Finds the vertices near a sphere among some at rest. Everything is in A."""

    def __init__(self, vertices: Array, normals: Array, excursion: float, margin: float) -> None:
        """`vertices` [m] and outward `normals`, shape (n, 3); the largest breathing `excursion` [m].

        The centre may move by `margin` [m] before they have to be searched again.
        """
        self._vertices, self._normals = vertices, normals
        self._tree = cKDTree(vertices)
        self._excursion, self._margin = excursion, margin

    def around(self, p: list[float], radius: float, deepest: float) -> Near:
        """What a sphere of `radius` [m] near `p` [m] might touch, where the skin is displaced by at most `deepest` [m]."""
        ball = math.hypot(radius, max(_REACH_M, deepest + 0.01)) + self._excursion + self._margin
        distance, nearest = self._tree.query(p)
        index = np.sort(np.asarray(self._tree.query_ball_point(p, ball), dtype=np.intp))
        n, X = self._normals[index], self._vertices[index] - p
        height = (n * X).sum(axis=1)
        lateral = np.linalg.norm(X - height[:, None] * n, axis=1)
        facing = n @ self._normals[nearest] > 0  # not the far side of something thin
        keep = (lateral < radius + self._margin) & facing
        return Near(p, max(self._margin, float(distance) - ball), radius, index[keep], n[keep], X[keep])


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
