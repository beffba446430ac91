"""One step of the Winkler-Pasternak tissue, compiled: the equations of the README, vertex by vertex.

    u* = u - h C^-1 [K (u - sum_k y_k) + k_w A (sigma(u) + tension a max(u, 0))]     `move_freely`, `stiffen`
    u  = max(u*, w),  f = C (u - u*) / h                                             `hold`: w is where the sphere holds a vertex
    y_k = e_k y_k + (1 - e_k) g_k u                                                  `relax`

The FMU's C source has the same equations; sigma is `palpate_models.patient.wall.stress`.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array
from palpate_models.numerics.vectors import add, divide, dot, row, scale, subtract
from palpate_tissue.friction import Bristle, Push, Sphere, rub
from palpate_tissue.near import RIM

Index = NDArray[np.uint16] | NDArray[np.uint32]
"""Unsigned: a signed index may be negative to numba, and looking each time doubles the cost of the field's step."""
_USUAL = 7
"""Entries of most rows of the field's matrix: a vertex and its six neighbours."""


class Membrane(NamedTuple):
    """The wall: n vertices and b Prony branches, with its matrices for steps of h."""

    u: Array
    """Displacement along the inward normals [m], shape (n,). Changed in place."""
    y: Array
    """What of it has relaxed [m], shape (b, n). Changed in place."""
    indptr: Index
    indices: Index
    rate: Array
    """A = -h C^-1 K, a matrix of shape (n, n) in CSR form."""
    prony: Array
    """e_k = exp(-h / tau_k), and (1 - e_k) g_k, shape (b, 2)."""
    h: float
    """[s]"""
    spring: Array
    """The springs beside the linear wall: rows `_BETA2`, `_BENT` and `_TENSION`, shape (3, n); (3, 0) where there are none."""
    share: float
    """h k_w A / C = h / dashpot_s: how far such a spring's pressure over k_w moves a vertex in a step, the same everywhere."""
    activation: Array
    """a, how far muscles are contracted, 0 to 1; shape (1,). Changed in place."""


class Patch(NamedTuple):
    """Vertices that the sphere might hold while its centre stays where it is; m of them.

    Compiled code takes a tenth of a microsecond to open an array at every step, so what never changes is one table.
    """

    vertex: NDArray[np.uint32]
    """Which vertices, shape (m,)."""
    table: Array
    """Their columns `_N`, `_X`, `_BETA` and `_GAIN`, shape (m, 8)."""
    f: Array
    """Their contact forces along the inward normals after the step [N], shape (m,). Changed in place."""


_N, _X, _BETA, _GAIN = 0, 3, 6, 7
"""Columns of a patch: outward normal (three), position (three) [m], share of the breathing excursion, and C / h [N/m]."""
_BETA2, _BENT, _TENSION = 0, 1, 2
"""Rows of the springs: beta^2 [1/m^2], the displacement from which they are straight [m], a contracted muscle's tension [1]."""


@compiled
def step(
    wall: Membrane,
    patch: Patch,
    bristle: Bristle,
    motion: Array,
    radius: float,
    excursion: float,
    disturbed: bool,
    wrench: Array,
) -> bool:
    """One step at a breathing `excursion` [m]. Whether the sphere touches: then `wrench` (6,) gets force and torque on it.

    `motion` (3, 3) has the position [m], the velocity [m/s] and the angular velocity [rad/s] of the sphere of `radius` [m] as
    rows; `wrench` force [N] and torque about the centre [N m], and is left alone out of contact. A wall that was never
    `disturbed` is at rest exactly, and stays so until it is touched.
    """
    sphere = Sphere(row(motion, 0), row(motion, 1), row(motion, 2), radius)
    if disturbed:
        move_freely(wall)
    touching, push = hold(wall, patch, sphere, excursion)
    if touching:
        rub(bristle, sphere, push, wall.h, wrench)
    if disturbed or touching:
        relax(wall)
    return touching


@compiled
def move_freely(wall: Membrane) -> None:
    """The wall as it moves by itself: u += A (u - sum_k y_k) - h k_w A / C (sigma(u) + tension a max(u, 0))."""
    u, rate, indices = wall.u, wall.rate, wall.indices
    strain = u.copy()
    for k in range(len(wall.y)):
        strain -= wall.y[k]
    if wall.spring.shape[1]:
        stiffen(wall)
    begin = wall.indptr[0]
    for i in range(len(u)):
        end = wall.indptr[i + 1]
        total = u[i]
        if end - begin == _USUAL:  # the compiler unrolls it: a quarter faster
            for j in range(_USUAL):
                total += rate[begin + j] * strain[indices[begin + j]]
        else:
            for j in range(begin, end):
                total += rate[j] * strain[indices[j]]
        u[i] = total
        begin = end


@compiled
def stiffen(wall: Membrane) -> None:
    """What the springs beside the linear wall do to a displacement in a step. The law is in `palpate_models.patient.wall`."""
    u, beta2, straight_from, tension = wall.u, wall.spring[_BETA2], wall.spring[_BENT], wall.spring[_TENSION]
    share, activation = wall.share, wall.activation[0]
    for i in range(len(u)):
        pressed = max(u[i], 0.0)
        bent = min(pressed, straight_from[i])
        stress = beta2[i] * bent * bent * (pressed - 2.0 / 3.0 * bent)
        u[i] -= share * (stress + tension[i] * activation * pressed)


@compiled
def hold(wall: Membrane, patch: Patch, sphere: Sphere, excursion: float) -> tuple[bool, Push]:
    """Holds the vertices under the sphere on its surface, at a breathing `excursion` [m]. Whether there are any, and the push.

    A vertex X of outward normal n moves along it; with d = p - X and s = -d.n it meets the sphere's lower side at
    w = s + c, c^2 = R^2 - |d|^2 + s^2. The frictionless sphere pushes along its own normal there, f (n + (d + s n) / c):
    f is the part along n, and the rest is borne by the tissue's guidance. As f holds the vertex exactly on the sphere, tool and
    field exchange the same work.
    """
    u, R, table = wall.u, sphere.radius, patch.table
    load = 0.0
    force = normal = moment = (0.0, 0.0, 0.0)
    for k in range(len(patch.vertex)):
        patch.f[k] = 0.0
        i, n = patch.vertex[k], row(table, k, _N)
        d = subtract(sphere.p, row(table, k, _X))
        s = -dot(n, d)
        square = R * R - dot(d, d) + s * s
        if square <= R * R * RIM * RIM:
            continue
        c = sqrt(square)
        w = s + c
        gap = w + excursion * table[k, _BETA] - u[i]
        if gap <= 0.0:
            continue
        u[i] += gap
        f = table[k, _GAIN] * gap
        patch.f[k] = f
        load += f
        normal = add(normal, scale(f, n))
        force = add(force, add(scale(f, n), scale(f / c, add(d, scale(s, n)))))
        moment = subtract(moment, scale(f, add(d, scale(w, n))))  # the vertex is at X - w n
    if load <= 0.0:
        return False, Push(force, normal, moment)
    return True, Push(force, normal, divide(moment, load))


@compiled
def relax(wall: Membrane) -> None:
    """The Prony branches, exact for a displacement held over the step: y_k = e_k y_k + (1 - e_k) g_k u."""
    for k in range(len(wall.y)):
        y, e, feed = wall.y[k], wall.prony[k, 0], wall.prony[k, 1]
        for i in range(len(y)):
            y[i] = y[i] * e + feed * wall.u[i]
