"""One implicit step of the Winkler-Pasternak tissue, compiled: the equations of the README by backward Euler.

    C (u - u0) / h + K (u - sum_k y_k) + k_w A (sigma(u) + tension a max(u, 0)) = f,    f >= 0,  u >= w,  f (u - w) = 0

is solved by projected successive over-relaxation, vertex by vertex, with the springs made straight about where a vertex is.
Far from the sphere nothing moves fast: there the wall goes on by long steps.
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

OVER_RELAXATION = 1.35
"""Near the best for a footprint of the wall: 2 / (1 + sqrt(1 - rho^2)) with rho = 0.87, that of Jacobi's sweeps at 10 ms."""

STILL_M = 1e-7
"""Far from the sphere, sweeps end when no vertex goes further."""


class ImplicitWall(NamedTuple):
    """The wall: n vertices and b Prony branches. Compiled code takes time to open arrays at every step: so there are few."""

    u: Array
    """Displacement along the inward normals [m], shape (n,). Changed in place, as are the next three."""
    s: Array
    """Strain u - sum_k y_k [m], shape (n,)."""
    y: Array
    """What of the displacement has relaxed [m], shape (n, b)."""
    clock: NDArray[np.int64]
    """To which step each vertex has come, shape (n,); those near the sphere are at the newest."""
    table: Array
    """The columns `DRAG` to `TENSION` of each vertex, shape (n, 6)."""
    indptr: NDArray[np.uint32]
    indices: NDArray[np.uint32]
    K: Array
    """Instantaneous stiffness [N/m], a matrix of shape (n, n) in CSR form; rows of fixed vertices are empty."""
    decay: Array
    """g_k, then exp(-m h / tau_k) for m = 1 .. the longest step, shape (1 + m, b)."""


DRAG, DIAGONAL, FOUNDATION, BETA2, STRAIGHT_FROM, TENSION = range(6)
"""Columns of a wall: dashpot over step C / h [N/m], diagonal of K, k_w A [N/m], beta^2 [1/m^2], the displacement from which the
stiffening spring is straight [m], and a contracted muscle's tension [1]."""


class ImplicitPatch(NamedTuple):
    """What moves while the sphere's centre stays about where it is: p vertices, of which m might be held."""

    near: NDArray[np.intp]
    """Vertices that are stepped, ascending, shape (p,)."""
    within: NDArray[np.intp]
    """Where in `near` those stand that might be held, shape (m,)."""
    table: Array
    """Their outward normal (three), place at rest [m] (three), and share of the breathing excursion, shape (m, 7)."""
    f: Array
    """Their contact forces along the inward normals after the step [N], shape (m,). Changed in place."""
    room: Array
    """Displacement before the step and the least that the sphere allows [m] of the stepped, shape (p, 2). Changed in place."""


class Stride(NamedTuple):
    """One step of vertices."""

    length: float
    """How many of the wall's own steps it has [1]."""
    kept: float
    """Which part of a displacement is strain at the end of the step; what is missing has relaxed meanwhile [1]."""
    over: float
    """How far a sweep goes beyond the balance [1]."""


OWN = Stride(1.0, 1.0, OVER_RELAXATION)
"""One of the wall's own steps, in which branches follow afterwards."""


@compiled
def press(
    wall: ImplicitWall,
    patch: ImplicitPatch,
    bristle: Bristle,
    motion: Array,
    numbers: tuple[float, float, float, float],
    sweeps: int,
) -> tuple[bool, Array]:
    """Steps the vertices near a sphere. Whether it touches, and force [N] and torque about its centre [N m] on it, shape (6,).

    `motion` (3, 3) has position [m], velocity [m/s] and angular velocity [rad/s] of the sphere as rows. `numbers`: its radius
    [m], the breathing excursion [m], how far muscles are contracted [1], the step [s].
    """
    radius, excursion, activation, h = numbers
    sphere = Sphere(row(motion, 0), row(motion, 1), row(motion, 2), radius)
    u, near, room, table = wall.u, patch.near, patch.room, patch.table
    for k in range(len(near)):
        room[k, 0], room[k, 1] = u[near[k]], -np.inf
    for k in range(len(table)):
        d = subtract(sphere.p, row(table, k, 3))
        along = -dot(row(table, k, 0), d)
        square = radius * radius - dot(d, d) + along * along
        if square > radius * radius * RIM * RIM:
            room[patch.within[k], 1] = along + sqrt(square) + excursion * table[k, 6]
    for _ in range(sweeps):
        sweep(wall, near, room, activation, OWN)
    load = 0.0
    force = normal = moment = (0.0, 0.0, 0.0)
    for k in range(len(table)):
        at = patch.within[k]
        patch.f[k] = 0.0
        if u[near[at]] > room[at, 1]:
            continue
        f = -unbalanced(wall, near[at], room[at, 0], activation, 1.0)
        if f <= 0.0:
            continue
        n, d = row(table, k, 0), subtract(sphere.p, row(table, k, 3))
        along = -dot(n, d)
        w = room[at, 1] - excursion * table[k, 6]
        patch.f[k] = f
        load += f
        normal = add(normal, scale(f, n))
        force = add(force, add(scale(f, n), scale(f / (w - along), add(d, scale(along, n)))))
        moment = subtract(moment, scale(f, add(d, scale(w, n))))  # as `kernel.hold` has it
    relax(wall, near)
    wrench = np.zeros(6)
    if load <= 0.0:
        return False, wrench
    rub(bristle, sphere, Push(force, normal, divide(moment, load)), h, wrench)
    return True, wrench


@compiled
def sweep(wall: ImplicitWall, near: NDArray[np.intp], room: Array, activation: float, stride: Stride) -> float:
    """One sweep over vertices, each to where its forces balance and beyond, but not through its floor. The longest way [m]."""
    u, s, table, indptr, indices, K = wall.u, wall.s, wall.table, wall.indptr, wall.indices, wall.K
    longest = 0.0
    for k in range(len(near)):
        i = near[k]
        at, drag = u[i], table[i, DRAG] / stride.length
        force = drag * (room[k, 0] - at)
        slope = drag + stride.kept * table[i, DIAGONAL]
        for j in range(indptr[i], indptr[i + 1]):
            force -= K[j] * s[indices[j]]
        if at > 0.0:
            bent = min(at, table[i, STRAIGHT_FROM])
            stiffer, held = table[i, BETA2] * bent * bent, table[i, TENSION] * activation
            force -= table[i, FOUNDATION] * (stiffer * (at - 2.0 / 3.0 * bent) + held * at)
            slope += table[i, FOUNDATION] * (stiffer + held)
        moved = max(at + stride.over * force / slope, room[k, 1])
        s[i] += stride.kept * (moved - at)
        u[i] = moved
        longest = max(longest, abs(moved - at))
    return longest


@compiled
def unbalanced(wall: ImplicitWall, i: int, before: float, activation: float, length: float) -> float:
    """The force that nothing balances at a vertex that was at `before` [m] a step of `length` ago [N], inward."""
    at = wall.u[i]
    force: float = wall.table[i, DRAG] / length * (before - at)
    for j in range(wall.indptr[i], wall.indptr[i + 1]):
        force -= wall.K[j] * wall.s[wall.indices[j]]
    if at > 0.0:
        bent = min(at, wall.table[i, STRAIGHT_FROM])
        stress = wall.table[i, BETA2] * bent * bent * (at - 2.0 / 3.0 * bent) + wall.table[i, TENSION] * activation * at
        force -= wall.table[i, FOUNDATION] * stress
    return force


@compiled
def relax(wall: ImplicitWall, near: NDArray[np.intp]) -> None:
    """The Prony branches of vertices that were stepped, exact for a displacement held over the step."""
    u, s, y, decay = wall.u, wall.s, wall.y, wall.decay
    for k in range(y.shape[1]):
        g, kept = decay[0, k], decay[1, k]
        for i in near:
            change = (1.0 - kept) * (g * u[i] - y[i, k])
            s[i] -= change
            y[i, k] += change


@compiled
def follow(wall: ImplicitWall, vertices: NDArray[np.intp], now: int, activation: float, sweeps: int) -> None:
    """Brings vertices that nothing touches to step `now`, each by one step of its own length, at most that of `decay`.

    First each gives way as its branches do, as it would if it were in balance and stayed so; then all go to where their forces
    balance: where the sphere has just left, that is far, and takes up to `sweeps` sweeps.
    """
    u, s, y, clock, decay, table = wall.u, wall.s, wall.y, wall.clock, wall.decay, wall.table
    indptr, indices, K = wall.indptr, wall.indices, wall.K
    begin, length = np.zeros(len(vertices)), np.zeros(len(vertices), dtype=np.int64)
    for k in range(len(vertices)):
        i = vertices[k]
        steps = min(now - clock[i], len(decay) - 1)
        clock[i] = now
        if steps <= 0 or (u[i] == 0.0 and s[i] == 0.0):
            continue
        rest = u[i]
        for b in range(y.shape[1]):
            change = (1.0 - decay[steps, b]) * (decay[0, b] * rest - y[i, b])
            u[i] += change
            y[i, b] += change
        begin[k], length[k] = u[i], steps
    for _ in range(sweeps):
        longest = 0.0
        for k in range(len(vertices)):
            if length[k] == 0:
                continue
            i = vertices[k]
            drag = table[i, DRAG] / length[k]
            force, slope = drag * (begin[k] - u[i]), drag + table[i, DIAGONAL]
            for j in range(indptr[i], indptr[i + 1]):
                force -= K[j] * s[indices[j]]
            if u[i] > 0.0:
                bent = min(u[i], table[i, STRAIGHT_FROM])
                stiffer, held = table[i, BETA2] * bent * bent, table[i, TENSION] * activation
                force -= table[i, FOUNDATION] * (stiffer * (u[i] - 2.0 / 3.0 * bent) + held * u[i])
                slope += table[i, FOUNDATION] * (stiffer + held)
            u[i] += force / slope
            s[i] += force / slope
            longest = max(longest, abs(force / slope))
        if longest < STILL_M:
            return
