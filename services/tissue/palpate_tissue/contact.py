"""Contact of the spherical indenter with the skin, shared by all backends: candidate vertices and friction.

Friction is Coulomb's with the skin's shear compliance before it slips, an elastic-plastic bristle: the skin sticks and shears by
s with a constant stiffness k, and slips at the Coulomb limit,

    s' = P v   while k |s| < mu N,     F = -k s

P removes the component along the normal. It is passive: k is constant, and slipping, turning and unloading only shorten s.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array, Indices
from palpate_models.numerics.vectors import Vector, add, cross, divide, dot, norm, scale, subtract, velocity_at

RIM = 0.2
"""The sphere holds vertices where its surface makes less than 78 degrees with the tangent plane (cos > 0.2)."""
_REACH_M = 0.030
"""Depth of the sphere's centre below the rest surface up to which the candidates found are complete."""


class Near(NamedTuple):
    """The m vertices that a sphere can touch while its centre stays near `origin`."""

    origin: list[float]
    """Search centre [m], shape (3,)."""
    reach: float
    """Distance from `origin` within which the candidates are complete [m]."""
    radius: float
    """Radius of the sphere [m]."""
    vertex: Indices
    """Indices among the searched vertices, ascending, shape (m,)."""
    n: Array
    """Their outward normals, shape (m, 3)."""
    X: Array
    """Their positions from `origin` [m], shape (m, 3)."""

    def holds(self, p: list[float], radius: float) -> bool:
        """Return True if the candidates are complete for a sphere of `radius` [m] at `p` [m]."""
        return radius == self.radius and math.dist(p, self.origin) <= self.reach


class VertexSearch:
    """Finds the vertices near a sphere. All quantities are in frame A."""

    def __init__(self, vertices: Array, normals: Array, excursion: float, margin: float) -> None:
        """Take rest `vertices` [m] and outward `normals`, shapes (n, 3), and the largest breathing `excursion` [m].

        The centre may move by `margin` [m] before the next search.
        """
        self._vertices, self._normals = vertices, normals
        self._tree = cKDTree(vertices)
        self._excursion, self._margin = excursion, margin

    def around(self, p: list[float], radius: float, deepest: float) -> Near:
        """Return the vertices that a sphere of `radius` [m] near `p` can touch if the skin is displaced by at most `deepest`."""
        ball = math.hypot(radius, max(_REACH_M, deepest + 0.01)) + self._excursion + self._margin
        distance, nearest = self._tree.query(p)
        index = np.sort(np.asarray(self._tree.query_ball_point(p, ball), dtype=np.intp))
        n, X = self._normals[index], self._vertices[index] - p
        height = (n * X).sum(axis=1)
        lateral = np.linalg.norm(X - height[:, None] * n, axis=1)
        facing = n @ self._normals[nearest] > 0  # excludes the far side of a thin body
        keep = (lateral < radius + self._margin) & facing
        return Near(p, max(self._margin, float(distance) - ball), radius, index[keep], n[keep], X[keep])


class ReferenceWall(NamedTuple):
    """A half-space, and the wall and contact that correspond to it."""

    k_w_n_per_m3: float = 1.7e5
    young_pa: float = 1.0e4
    """A half-space of 10 kPa corresponds to k_w = 1.7e5 N/m^3 (`palpate validate`: Hertz and the foundation agree at 10 mm)."""
    radius_m: float = 0.012
    """Contact radius at 10 mm depth, about sqrt(R d) for indenters of 15 mm."""
    poisson: float = 0.49


REFERENCE: Final = ReferenceWall()


def shear_stiffness(k_w: float) -> float:
    """Return the tangential contact stiffness [N/m] of tissue with foundation modulus `k_w` [N/m^3].

    8 a G / (2 - nu) of a sticking contact of radius a on a half-space (Mindlin 1949; Johnson, Contact Mechanics, section 7.2).
    """
    shear_modulus = REFERENCE.young_pa * k_w / REFERENCE.k_w_n_per_m3 / (2 * (1 + REFERENCE.poisson))
    return 8 * REFERENCE.radius_m * shear_modulus / (2 - REFERENCE.poisson)


class Bristle(NamedTuple):
    """Friction state of the skin under the indenter."""

    coefficient: float
    """mu [1]."""
    stiffness: float
    """k [N/m]."""
    stretch: Array
    """s: shear of the skin [m], shape (3,). Changed in place."""

    def release(self) -> None:
        """Reset the shear after contact is lost."""
        self.stretch[:] = 0.0

    def energy(self) -> float:
        """Return the elastic energy of the shear [J]."""
        return 0.5 * self.stiffness * float(self.stretch @ self.stretch)


def skin(coefficient: float, background: Array) -> Bristle:
    """Return unsheared skin over a wall of foundation moduli `background` [N/m^3], shape (n,)."""
    return Bristle(float(coefficient), shear_stiffness(float(np.median(background))), np.zeros(3))


class Sphere(NamedTuple):
    """The indenter in the abdomen frame A."""

    p: Vector
    """Centre [m]."""
    v: Vector
    """Velocity of the centre [m/s]."""
    w: Vector
    """Angular velocity [rad/s]."""
    radius: float
    """Radius [m]."""


class Push(NamedTuple):
    """Resultant of the frictionless contact forces."""

    force: Vector
    """Contact force on the sphere [N]."""
    normal: Vector
    """Sum of contact forces times outward vertex normals [N]."""
    arm: Vector
    """Centre of the contact forces relative to the sphere's centre [m]."""


@compiled
def meet(p: Vector, radius: float, X: Vector, n: Vector) -> tuple[Vector, float, float]:
    """Return d, s and c of a sphere of `radius` [m] at `p` above a vertex X with outward normal n; c = 0 where it cannot hold it.

    The vertex moves along n. With d = p - X and s = -d.n it meets the sphere's lower side at a displacement w = s + c inward,
    c^2 = R^2 - |d|^2 + s^2.
    """
    d = subtract(p, X)
    s = -dot(n, d)
    square = radius * radius - dot(d, d) + s * s
    return d, s, math.sqrt(square) if square > radius * radius * RIM * RIM else 0.0


@compiled
def add_vertex(push: Push, f: float, n: Vector, d: Vector, s: float, c: float, w: float) -> Push:
    """Return a push, whose arm is not yet divided by the load, with the force `f` [N] along n of a vertex held at w = s + c.

    The frictionless sphere pushes along its own normal there, f (n + (d + s n) / c): f is the component along n, and the guidance
    of the vertex takes the rest. Since f holds the vertex exactly on the sphere, tool and field exchange equal work.
    """
    force = add(push.force, add(scale(f, n), scale(f / c, add(d, scale(s, n)))))
    return Push(force, add(push.normal, scale(f, n)), subtract(push.arm, scale(f, add(d, scale(w, n)))))  # it is at X - w n


NO_PUSH: Final = Push((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


@compiled
def shear(bristle: Bristle, velocity: Vector, normal: Vector, load: float, h: float) -> Vector:
    """Return the friction force on the indenter [N] after `h` [s].

    `velocity` [m/s] is that of the indenter's surface relative to the tissue, `normal` a unit vector, `load` [N] the normal
    force.
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
def add_friction(bristle: Bristle, sphere: Sphere, push: Push, h: float, wrench: Array) -> None:
    """Set `wrench` (6,) to force [N] and torque about the centre [N m] on the sphere after `h` [s]: push plus friction.

    Friction acts in the mean tangent plane at the centre of the contact forces, against the motion of the sphere's surface there.
    """
    load = norm(push.normal)
    friction = shear(bristle, velocity_at(sphere.v, sphere.w, push.arm), divide(push.normal, load), load, h)
    wrench[0], wrench[1], wrench[2] = add(push.force, friction)
    wrench[3], wrench[4], wrench[5] = cross(push.arm, friction)
