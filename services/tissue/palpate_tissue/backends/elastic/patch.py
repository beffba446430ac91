"""The vertices near the sphere: where it holds them, what that takes, and how they move."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from palpate_models.numerics.frames import Array
from palpate_tissue.backends.elastic.contact import ContactSolver
from palpate_tissue.backends.elastic.springs import VertexSprings, resistance
from palpate_tissue.friction import Push
from palpate_tissue.near import RIM, Near

_NOWHERE_M = -1.0
"""Where a vertex is held that is not under the sphere."""


class ElasticPatch:
    """Vertices that the sphere might hold while its centre stays near a place; m of them."""

    def __init__(self, near: Near, breathing: Array, state: Array, compliance: Array) -> None:
        """`breathing` (m,) is their share of the excursion, `compliance` (m, m) displacement by force in a step [m/N]."""
        self.near = near
        self.state = state
        """u and y_k of these vertices [m], shape (branches + 1, m)."""
        self.impulse = np.zeros_like(state)
        """What the forces since the beginning left behind, shape (branches + 1, m) [N]: S times it is displacement."""
        self.force = np.zeros(len(near.vertex))
        """Contact forces f after the step, along the inward normals [N], shape (m,)."""
        self.vertex = near.vertex
        """Which vertices these are, shape (m,)."""
        self.within: NDArray[np.intp] = np.arange(len(near.vertex))
        """Where among them are those that the sphere might hold."""
        self.deepest = math.inf
        """Displacement [m] up to which the step is passive."""
        self.solver = ContactSolver(compliance)
        self._breathing = breathing
        self._height = (near.n * near.X).sum(axis=1)
        self._square = (near.X * near.X).sum(axis=1)
        self._q = self._s = self._c = np.empty(0)

    def hold(self, p: Array, excursion: float) -> Array:
        """Displacement w [m] at which the sphere with its centre at `p` holds each vertex, shape (m,).

        A vertex X of outward normal n moves along it; with d = p - X and s = -d.n it meets the sphere's lower side at
        w = s + c, c^2 = R^2 - |d|^2 + s^2. Breathing lifts the skin by its share of the `excursion` [m].
        """
        n, X, R = self.near.n, self.near.X, self.near.radius
        self._q = q = np.subtract(p, self.near.origin)  # so that d = q - X
        self._s = s = self._height - n @ q
        square = R * R - (q @ q - 2 * (X @ q) + self._square) + s * s
        rim = (RIM * R) ** 2
        self._c = c = np.sqrt(np.maximum(square, rim))
        w: Array = s + c + excursion * self._breathing
        w[square <= rim] = _NOWHERE_M
        return w

    def step(self, w: Array, advance: Array, feed: Array, activation: float) -> bool:
        """One step of the vertices, held out of the sphere: (u, y)+ = M (u, y) + b (S f). Whether the sphere touches any."""
        free = advance @ self.state
        self.force, moved = self.solver.solve(w - free[0])
        self._finish(advance, feed, free, moved, self.force)
        return bool(self.force.any())

    def _finish(self, advance: Array, feed: Array, free: Array, moved: Array, load: Array) -> None:
        """The state after `free` [m] (branches + 1, m), by what a `load` [N] has `moved` the vertices [m], each (m,)."""
        self.state = free + (feed / feed[0])[:, None] * moved
        self.impulse = advance @ self.impulse + feed[:, None] * load

    def spring_energy(self, activation: float) -> float:
        """What springs beside the solid store [J]: there are none."""
        return 0.0

    def push(self) -> Push:
        """What holding the vertices takes.

        The frictionless sphere pushes along its own normals, f (n + (d + s n) / c): f is the part along the skin's normal,
        and the tissue's guidance bears the rest. As f holds the vertex exactly on the sphere, tool and field exchange the
        same work.
        """
        f, n, X, q, s, c = self.force, self.near.n, self.near.X, self._q, self._s, self._c
        load, g = f.sum(), f / c
        normal = f @ n
        force = normal + (g.sum() * q - g @ X) + (g * s) @ n
        arm = (f @ X - (f * (s + c)) @ n) / load - q  # a vertex is at X - (s + c) n
        return Push(tuple(force.tolist()), tuple(normal.tolist()), tuple(arm.tolist()))


class SprungPatch(ElasticPatch):
    """The same with springs, on these k vertices and on those beside them; m in all.

    (u, y)+ = M (u, y) + b S (f - q),    q = q(u) + d (u+ - u),  d = max q': at the end of the step, as the solid is.
    """

    def __init__(
        self,
        near: Near,
        vertex: NDArray[np.intp],
        breathing: Array,
        state: Array,
        compliance: Array,
        springs: VertexSprings,
        deepest: float,
    ) -> None:
        """`breathing` is of the k, the others of all `vertex` (m,). `deepest` [m] is how far they may be displaced."""
        self._lag = lag = springs.steepest(deepest)
        softened = np.linalg.solve(np.eye(len(lag)) + compliance * lag, compliance)
        self._softened: Array = 0.5 * (softened + softened.T)
        within = np.searchsorted(vertex, near.vertex)
        self._columns = np.ascontiguousarray(self._softened[:, within])
        super().__init__(near, breathing, state, np.ascontiguousarray(self._columns[within]))
        self.vertex, self.within, self.deepest = vertex, within, deepest
        self._springs, self._table = springs, springs.table()

    def step(self, w: Array, advance: Array, feed: Array, activation: float) -> bool:
        """See `ElasticPatch`."""
        free = advance @ self.state
        u, d = self.state[0], self._lag
        opposing = resistance(self._table, u, activation) + d * (free[0] - u)  # q if nothing but M moved the vertices
        yielded = self._softened @ opposing
        self.force, _ = self.solver.solve(w - (free[0] - yielded)[self.within])
        moved = self._columns @ self.force - yielded
        load = -opposing - d * moved
        load[self.within] += self.force
        self._finish(advance, feed, free, moved, load)
        return bool(self.force.any())

    def spring_energy(self, activation: float) -> float:
        """See `ElasticPatch`."""
        return self._springs.energy(self.state[0], activation)
