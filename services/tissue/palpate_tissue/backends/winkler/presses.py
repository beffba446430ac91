"""Standard presses into the Winkler-Pasternak wall, one after another in compiled code, by few long implicit steps.

What counts of a press is the force at its end (`scenario.press`). The sphere goes at one speed and is then held, so that
between two instants every displacement is nearly a straight line: for such a line the branches are exact,

    y = e y0 + g (1 - r) u + g (r - e) u0,    e = exp(-h / tau),    r = tau / h (1 - e),

and the step is backward Euler's only in the dashpot, which is at rest long before the reading. What a press does to guarding
muscle is the same everywhere: its depth and speed are those of the press.
"""

from __future__ import annotations

from math import exp, sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array
from palpate_models.numerics.vectors import add, dot, row, scale, subtract
from palpate_models.patient.guarding import Activation
from palpate_models.patient.phantom import PhantomModel
from palpate_models.patient.schema import Stiffness
from palpate_models.scenario import press
from palpate_tissue.backends.winkler.implicit import ImplicitWall, Stride, implicit_wall, sweep, unbalanced
from palpate_tissue.contact import RIM

ENDS_S: Final = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.75, press.DURATION_S - 0.5 * press.READ_S)
"""Ends of the steps, from the touch [s]: at full depth, where the force is greatest, and last in the middle of the reading."""
REACHED: Final = 3.0
"""A press reaches so many Pasternak lengths beyond the sphere: the wall gives way as K0(r / l), and what is left there acts back
by its square."""
OVER_RELAXATION: Final = 1.5
CLOSE_M: Final = 2e-6
"""Sweeps end when no vertex goes further."""
MOST_SWEEPS: Final = 200
_APART: Final = 7
"""As in `implicit`."""


class Course(NamedTuple):
    """What every press does."""

    radius: float
    """Radius of the sphere [m]."""
    ends: Array
    """Lengths of the steps [s], shape (n,)."""
    depths: Array
    """How deep the sphere is then [m], shape (n,)."""
    contracted: Array
    """How far guarding muscle is contracted then [1], shape (n,)."""
    prony: Array
    """g and tau [s] of each branch, shape (b, 2)."""


class Skin(NamedTuple):
    """The skin at rest; v vertices."""

    vertices: Array
    """[m], shape (v, 3)."""
    normals: Array
    """Outward unit normals, shape (v, 3)."""


def press_in_turn(
    model: PhantomModel, stiffness: Stiffness, where: tuple[Array, Array, float]
) -> tuple[Array, NDArray[np.bool_]]:
    """What `TissueBackend.press` returns. `where`: places [m], normals, each of shape (k, 3), and the sphere's radius [m]."""
    places, normals, radius = where
    ends = np.array(ENDS_S)
    depths = press.depths(ends)
    prony = np.column_stack((stiffness.prony_g, stiffness.prony_tau_s))
    course = Course(radius, ends, depths, contracted(model.voluntary, ends, depths), prony)
    reached = cKDTree(model.vertices).query_ball_point(places, radius + REACHED * stiffness.length_m)
    wall = implicit_wall(model, stiffness, 1.0, 1)
    skin = Skin(model.vertices, model.normals)
    forces = np.empty((len(places), len(ends)))
    for place, normal, vertices, felt in zip(places, normals, reached, forces, strict=True):
        part = np.sort(np.array(vertices, dtype=np.intp))
        part = part[~model.fixed[part]]
        part = np.concatenate([part[first::_APART] for first in range(_APART)])
        press_once(wall, skin, part, np.stack((place, normal)), course, felt)
    limited = forces.max(axis=1, initial=0.0) >= press.LIMIT_N
    return np.where(limited, press.LIMIT_N, forces[:, -1]), limited


def contracted(voluntary: bool, ends: Array, depths: Array) -> Array:
    """How far muscle that guards is contracted at the `ends` [s] of a press's steps, where it is `depths` deep [m]; both (n,).

    At rest it is contracted wholly, and the press provokes it or lets it fade (`palpate_models.patient.guarding`).
    """
    levels = [1.0]
    for lasted, depth, deeper in zip(np.diff(ends, prepend=0.0), depths, np.diff(depths, prepend=0.0), strict=True):
        levels.append(Activation(voluntary, lasted).after(levels[-1], depth, deeper / lasted))
    return np.array(levels[1:])


@compiled
def press_once(wall: ImplicitWall, skin: Skin, part: NDArray[np.intp], at: Array, course: Course, forces: Array) -> None:
    """One frictionless press into a wall at rest, which is at rest afterwards. Only the vertices of `part` move.

    The wall's own step is 1 s. `at` (2, 3) has the place [m] and the outward normal there as rows; `forces` (n,) gets the forces
    along it [N] at the ends of the steps.
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
            u[i] *= deeper  # about where it will come to
            s[i] = kept * u[i] - relaxed
        stride = Stride(h, kept, OVER_RELAXATION)
        for _ in range(MOST_SWEEPS):
            if sweep(wall, part, room, activation, stride) < CLOSE_M:
                break
        forces[step] = held(wall, skin, part, room, activation, h, p, normal)
        for k in range(len(part)):
            i = part[k]
            for b in range(len(prony)):
                y[i, b] = e[b] * y[i, b] + prony[b, 0] * ((1.0 - r[b]) * u[i] + (r[b] - e[b]) * room[k, 0])
        begin, reached = course.ends[step], depth
    for i in part:
        u[i] = s[i] = 0.0
        y[i] = 0.0


@compiled
def floor(
    X: tuple[float, float, float],
    n: tuple[float, float, float],
    p: tuple[float, float, float],
    radius: float,
    normal: tuple[float, float, float],
) -> float:
    """The least displacement of a vertex X of outward normal n that a sphere about p allows [m]: w of `kernel.hold`."""
    d = subtract(p, X)
    along = -dot(n, d)
    square = radius * radius - dot(d, d) + along * along
    if square <= radius * radius * RIM * RIM or dot(n, normal) <= 0.0:  # beside it, or on the far side of something thin
        return -np.inf
    return along + sqrt(square)


@compiled
def held(
    wall: ImplicitWall,
    skin: Skin,
    part: NDArray[np.intp],
    room: Array,
    activation: float,
    h: float,
    p: tuple[float, float, float],
    normal: tuple[float, float, float],
) -> float:
    """The force on a sphere about p along `normal` [N], of all vertices that it holds: as in `kernel.hold`."""
    total = 0.0
    for k in range(len(part)):
        i = part[k]
        if wall.u[i] > room[k, 1]:
            continue
        f = -unbalanced(wall, i, room[k, 0], activation, h)
        if f <= 0.0:
            continue
        n, d = row(skin.normals, i), subtract(p, row(skin.vertices, i))
        along = -dot(n, d)
        total += f * (dot(n, normal) + dot(add(d, scale(along, n)), normal) / (room[k, 1] - along))
    return total
