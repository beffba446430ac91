"""Standard presses into the Winkler-Pasternak wall, compiled, with few long implicit steps.

Only the force at the end of a press counts (`scenario.press`). The sphere moves at one speed and is then held, so displacements
are nearly linear in time within a step. For a linear displacement the branches are exact,

    y = e y0 + g (1 - r) u + g (r - e) u0,    e = exp(-h / tau),    r = tau / h (1 - e),

and only the dashpot, which is at rest long before the reading, is integrated by backward Euler. The effect of a press on guarding
muscle depends only on its depth and speed, so it is the same for all presses.
"""

from collections.abc import Sequence
from math import exp
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array, Indices, Mask
from palpate_models.numerics.vectors import Vector, add, dot, row, scale, subtract
from palpate_models.patient.phantom import PhantomModel
from palpate_models.patient.schema import Stiffness
from palpate_models.patient.wall import Activation
from palpate_models.scenario import press
from palpate_tissue.backends.winkler.implicit import TUNING, ImplicitWall, Stride, implicit_wall, pull, sweep
from palpate_tissue.contact import meet

ENDS_S: Final = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.75, press.DURATION_S - 0.5 * press.READ_S)
"""Ends of the steps after the touch [s]: full depth, where the force is largest, and last the middle of the reading."""


class PressSweeps(NamedTuple):
    """Settings of the compiled solution of presses."""

    reach_lengths: float = 3.0
    """Reach of a press beyond the sphere in Pasternak lengths: displacement decays as K0(r / l) and acts back by its square."""
    over_relaxation: float = 1.5
    close_m: float = 2e-6
    """Convergence of sweeps: largest motion of a vertex."""
    max_sweeps: int = 200


SWEEPS = PressSweeps()
# Read by compiled functions.


class Course(NamedTuple):
    """Schedule of a press."""

    radius: float
    """Radius of the sphere [m]."""
    ends: Array
    """Ends of the steps from the touch [s], shape (n,)."""
    depths: Array
    """Depth at the ends of the steps [m], shape (n,)."""
    contracted: Array
    """Muscle contraction at the ends of the steps [1], shape (n,)."""
    prony: Array
    """g and tau [s] of each branch, shape (b, 2)."""


class Skin(NamedTuple):
    """The skin at rest, v vertices."""

    vertices: Array
    """[m], shape (v, 3)."""
    normals: Array
    """Outward unit normals, shape (v, 3)."""


def standard_presses(
    model: PhantomModel, stiffness: Stiffness, places: Array, normals: Array, radius: float
) -> tuple[Array, Mask]:
    """Return the result of `TissueBackend.press` at `places` [m] with `normals`, shapes (k, 3), for a sphere of `radius` [m]."""
    ends = np.array(ENDS_S)
    depths = press.depths(ends)
    course = Course(radius, ends, depths, contract(model.voluntary, ends, depths), prony_table(stiffness))
    forces = np.array(press_forces(model, stiffness, places, normals, [course] * len(places))).reshape(-1, len(ends))
    limited = forces.max(axis=1, initial=0.0) >= press.LIMIT_N
    return np.where(limited, press.LIMIT_N, forces[:, -1]), limited


def prony_table(stiffness: Stiffness) -> Array:
    """Return g and tau [s] of each branch, shape (b, 2)."""
    return np.column_stack((stiffness.prony_g, stiffness.prony_tau_s))


def press_forces(
    model: PhantomModel, stiffness: Stiffness, places: Array, normals: Array, courses: Sequence[Course]
) -> list[Array]:
    """Return the forces along the normal [N] of presses at `places` [m] with `normals`, shapes (k, 3), each into a wall at rest.

    Each press has its course of n steps; its forces, shape (n,), are those at their ends.
    """
    reach = SWEEPS.reach_lengths * stiffness.length_m + max((course.radius for course in courses), default=0.0)
    reached = cKDTree(model.vertices).query_ball_point(places, reach)
    wall = implicit_wall(model, stiffness, 1.0, 1)
    skin = Skin(model.vertices, model.normals)
    forces = [np.empty(len(course.ends)) for course in courses]
    for place, normal, vertices, course, felt in zip(places, normals, reached, courses, forces, strict=True):
        part = np.sort(np.array(vertices, dtype=np.intp))
        part = part[~model.fixed[part]]
        part = np.concatenate([part[k :: TUNING.interleave] for k in range(TUNING.interleave)])
        press_once(wall, skin, part, np.stack((place, normal)), course, felt)
    return forces


def contract(voluntary: bool, ends: Array, depths: Array) -> Array:
    """Return the contraction of guarding muscle at the `ends` [s] of steps with `depths` [m], shapes (n,).

    At rest it is fully contracted; the press sustains it or lets it fade (`palpate_models.patient.wall`).
    """
    levels = [1.0]
    for lasted, depth, deeper in zip(np.diff(ends, prepend=0.0), depths, np.diff(depths, prepend=0.0), strict=True):
        levels.append(Activation(voluntary, lasted).after(levels[-1], depth, deeper / lasted))
    return np.array(levels[1:])


@compiled
def press_once(wall: ImplicitWall, skin: Skin, part: Indices, at: Array, course: Course, forces: Array) -> None:
    """Perform one frictionless press into a wall at rest and reset it. Only the vertices of `part` move.

    The wall has steps of 1 s. Rows of `at` (2, 3): place [m] and outward normal. `forces` (n,) is set to the forces along the
    normal [N] at the ends of the steps.
    """
    normal, prony = row(at, 1), course.prony
    u, s, y = wall.u, wall.s, wall.y
    room = np.empty((len(part), 2))
    e, r = np.empty(len(prony)), np.empty(len(prony))
    begin = reached = 0.0
    for step in range(len(course.ends)):
        h, depth, activation = course.ends[step] - begin, course.depths[step], course.contracted[step]
        kept = 1.0
        for b in range(len(prony)):
            e[b] = exp(-h / prony[b, 1])
            r[b] = prony[b, 1] / h * (1.0 - e[b])
            kept -= prony[b, 0] * (1.0 - r[b])
        p = add(row(at, 0), scale(course.radius - depth, normal))
        deeper = depth / reached if reached > 0.0 else 1.0
        for k in range(len(part)):
            i = part[k]
            room[k, 0], room[k, 1] = u[i], floor(row(skin.vertices, i), row(skin.normals, i), p, course.radius, normal)
            relaxed = 0.0
            for b in range(len(prony)):
                relaxed += e[b] * y[i, b] + prony[b, 0] * (r[b] - e[b]) * u[i]
            u[i] *= deeper  # initial guess
            s[i] = kept * u[i] - relaxed
        stride = Stride(h, kept, SWEEPS.over_relaxation)
        for _ in range(SWEEPS.max_sweeps):
            if sweep(wall, part, room, activation, stride) < SWEEPS.close_m:
                break
        forces[step] = hold_force(wall, skin, part, room, activation, h, p, normal)
        for k in range(len(part)):
            i = part[k]
            for b in range(len(prony)):
                y[i, b] = e[b] * y[i, b] + prony[b, 0] * ((1.0 - r[b]) * u[i] + (r[b] - e[b]) * room[k, 0])
        begin, reached = course.ends[step], depth
    for i in part:
        u[i] = s[i] = 0.0
        y[i] = 0.0


@compiled
def floor(X: Vector, n: Vector, p: Vector, radius: float, normal: Vector) -> float:
    """Return the least displacement [m] that a sphere at p allows a vertex X with outward normal n."""
    _, s, c = meet(p, radius, X, n)
    return s + c if c > 0.0 and dot(n, normal) > 0.0 else -np.inf  # outside it, or on the far side of a thin body


@compiled
def hold_force(
    wall: ImplicitWall, skin: Skin, part: Indices, room: Array, activation: float, h: float, p: Vector, normal: Vector
) -> float:
    """Return the force along `normal` [N] on a sphere at p from all vertices that it holds, see `contact.add_vertex`."""
    total = 0.0
    for k in range(len(part)):
        i = part[k]
        if wall.u[i] > room[k, 1]:
            continue
        f = -pull(wall, i, room[k, 0], activation, h, 1.0)[0]
        if f <= 0.0:
            continue
        n, d = row(skin.normals, i), subtract(p, row(skin.vertices, i))
        along = -dot(n, d)
        total += f * (dot(n, normal) + dot(add(d, scale(along, n)), normal) / (room[k, 1] - along))
    return total
