"""The vertices near the sphere: where it holds them, what that takes, and how they move."""

from __future__ import annotations

import math

import numpy as np

from palpate_models.frames import Array
from palpate_tissue.backends.elastic.contact import ContactSolver
from palpate_tissue.backends.elastic.springs import Springs
from palpate_tissue.friction import Push
from palpate_tissue.near import RIM, Near

_NOWHERE_M = -1.0
"""Where a vertex is held that is not under the sphere."""


class ElasticPatch:
    """Vertices that the sphere might hold, or press aside, while its centre stays near a place; m of them."""

    def __init__(self, near: Near, breathing: Array, state: Array, compliance: Array) -> None:
        """`breathing` (m,) is their share of the excursion, `compliance` (m, m) displacement by force in a step [m/N]."""
        self.near = near
        self.state = state
        """u and y_k of these vertices [m], shape (branches + 1, m)."""
        self.impulse = np.zeros_like(state)
        """What the forces since the beginning left behind, shape (branches + 1, m) [N]: S times it is displacement."""
        self.force = np.zeros(len(near.vertex))
        """Contact forces f after the step, along the inward normals [N], shape (m,)."""
        self.deepest = math.inf
        """Displacement [m] up to which the step is passive."""
        self.solver = ContactSolver(compliance)
        self._springs: Springs | None = None
        self._lag: Array = np.empty(0)
        self._breathing = breathing
        self._height = (near.n * near.X).sum(axis=1)
        self._square = (near.X * near.X).sum(axis=1)
        self._q = self._s = self._c = np.empty(0)

    def resist(self, springs: Springs, deepest: float) -> None:
        """Puts `springs` on the vertices for displacements up to `deepest` [m]."""
        self.deepest = deepest
        self._springs = springs
        self._lag = lag = springs.steepest(deepest)
        compliance = self.solver.matrix
        softened = np.linalg.solve(np.eye(len(lag)) + compliance * lag, compliance)
        self.solver = ContactSolver(0.5 * (softened + softened.T))

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
        """One step of the vertices, held out of the sphere. Whether the sphere touches any.

        (u, y)+ = M (u, y) + b S (f - q),    q = q(u) + d (u+ - u),  d = max q': at the end of the step, as the solid is.
        """
        free = advance @ self.state
        if self._springs is None:
            self.force, moved = self.solver.solve(w - free[0])
            load = self.force
        else:
            u, d = self.state[0], self._lag
            opposing = self._springs.force(u, activation) + d * (free[0] - u)  # q if nothing but M moved the vertices
            yielded = self.solver.matrix @ opposing
            self.force, pushed = self.solver.solve(w - free[0] + yielded)
            moved = pushed - yielded
            load = self.force - opposing - d * moved
        self.state = free + (feed / feed[0])[:, None] * moved
        self.impulse = advance @ self.impulse + feed[:, None] * load
        return bool(self.force.any())

    def spring_energy(self, activation: float) -> float:
        """What the springs store [J]."""
        return 0.0 if self._springs is None else self._springs.energy(self.state[0], activation)

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
