"""The vertices near the sphere: unilateral contact, nonlinear springs, and their step."""

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from palpate_errors import RunError
from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array, Indices, Mask
from palpate_models.patient import wall
from palpate_tissue.contact import RIM, Near, Push

_GUESSES = 25
"""Rounds of the fast rule before the rule that always terminates."""
_MOST = 20_000


class ContactSolver:
    """Solves  A f - b >= 0,  f >= 0,  f (A f - b) = 0  for a positive definite A, starting from the last contact set.

    The forces of a guessed contact set are solved for, and the set is corrected where a force pulls or a gap is violated
    (primal-dual active set; Hintermueller, Ito and Kunisch 2002). If that does not converge, vertices are corrected one at a
    time, lowest index first, which terminates for every positive definite A (Murty 1974).
    """

    def __init__(self, matrix: Array) -> None:
        self.matrix = matrix
        """A, shape (m, m), symmetric and positive definite."""
        self.active: Mask = np.zeros(len(matrix), dtype=np.bool_)
        """The contact set of the last solution, shape (m,)."""
        self._index = np.empty(0, dtype=np.intp)
        self._inverse = np.empty((0, 0))
        self._columns = np.empty((len(matrix), 0))

    def begin_with(self, active: Mask) -> None:
        """Set the initial contact set, shape (m,)."""
        if not np.array_equal(active, self.active):
            self._choose(active)

    def solve(self, b: Array) -> tuple[Array, Array]:
        """Return forces f and A f for a right-hand side, shapes (m,). Raises RunError if A is not positive definite."""
        force = np.zeros(len(b))
        if not self.active.any() and (b <= 0).all():
            return force, np.zeros(len(b))
        noise = 1e-12 * float(np.abs(b).max())
        for attempt in range(_MOST):
            if len(self._index):
                pressed = self._inverse.dot(b.take(self._index))
                moved = self._columns.dot(pressed)
            else:
                pressed, moved = np.empty(0), np.zeros(len(b))
            wrong = moved < b - noise
            wrong[self._index] = pressed < 0
            if not wrong.any():
                force[self._index] = pressed
                return force, moved
            if attempt < _GUESSES:
                self._choose(self.active ^ wrong)
            else:
                one = np.zeros_like(wrong)
                one[int(wrong.argmax())] = True
                self._choose(self.active ^ one)
        raise RunError(f"elastic tissue: no contact set in {_MOST} rounds on {len(b)} vertices")

    def _choose(self, active: Mask) -> None:
        self.active = active
        self._index = np.flatnonzero(active)
        if len(self._index):
            self._columns = self.matrix.take(self._index, axis=1)
            try:
                factor = cho_factor(self._columns.take(self._index, axis=0), lower=True, check_finite=False)
            except LinAlgError as error:
                raise RunError(
                    "elastic tissue: the compliance is not positive definite because mesh vertices are much closer together than "
                    "their triangles are wide: remesh it evenly, or use services.tissue = winkler"
                ) from error
            self._inverse = cho_solve(factor, np.eye(len(self._index)), check_finite=False)


MUSCLE = 1.06
"""Factor on muscle tension relative to the foundation (`palpate_models.patient.healthy`): the solid spreads the load wider, so
the press that defines the guarding ratio would measure 3 % less. With it the ratio is met within 2 %."""


class VertexSprings(NamedTuple):
    """Elastic springs in parallel with the solid, one per vertex, m of them.

    q(u) = k_w A [sigma(u) + tension a max(u, 0)]
    """

    gain: Array
    """k_w A [N/m], shape (m,), with k_w from the solid's modulus at the skin."""
    stiffening: Array
    """[1/m], shape (m,)."""
    tension: Array
    """[1], shape (m,)."""

    def at(self, index: Indices) -> "VertexSprings":
        """Return the springs of some of the vertices."""
        return VertexSprings(self.gain[index], self.stiffening[index], self.tension[index])

    def table(self) -> Array:
        """Return the table used by `resistance`, shape (m, 3)."""
        bent = wall.straight_from(self.stiffening)
        return np.column_stack((self.gain * self.stiffening**2, bent, self.gain * self.tension))

    def steepest(self, deepest: float) -> Array:
        """Return the largest q' [N/m] at any displacement up to `deepest` [m] and any activation, shape (m,)."""
        return self.gain * (wall.slope(np.full(len(self.gain), deepest), self.stiffening) + self.tension)

    def energy(self, u: Array, activation: float) -> float:
        """Return the stored energy [J]."""
        pressed = np.maximum(u, 0.0)
        return float(self.gain @ (wall.stored_energy(u, self.stiffening) + 0.5 * activation * self.tension * pressed**2))


@compiled
def resistance(table: Array, u: Array, activation: float) -> Array:
    """Return the spring force q [N], outward, at displacements `u` [m] and muscle contraction `activation`, shape (m,).

    `table` (m, 3) is `VertexSprings.table`; the stiffening part is `palpate_models.patient.wall.stress`.
    """
    q = np.zeros(len(u))
    for i in range(len(u)):
        pressed = u[i]
        if pressed > 0:
            bent = min(pressed, table[i, 1])
            q[i] = table[i, 0] * bent * bent * (pressed - 2 / 3 * bent) + activation * table[i, 2] * pressed
    return q


_NOWHERE_M = -1.0
"""Displacement bound of a vertex that is not under the sphere."""


class ElasticPatch:
    """The m vertices that the sphere can hold while its centre stays near a place."""

    def __init__(self, near: Near, breathing: Array, state: Array, compliance: Array) -> None:
        """`breathing` (m,): fraction of the excursion; `compliance` (m, m): displacement per force in a step [m/N]."""
        self.near = near
        self.state = state
        """u and y_k of these vertices [m], shape (branches + 1, m)."""
        self.impulse = np.zeros_like(state)
        """Accumulated effect of the forces so far [N], shape (branches + 1, m): S times it is displacement."""
        self.force = np.zeros(len(near.vertex))
        """Contact forces f after the step, along the inward normals [N], shape (m,)."""
        self.vertex = near.vertex
        self.within: Indices = np.arange(len(near.vertex))
        """Positions in `vertex` of those that the sphere can hold."""
        self.deepest = math.inf
        """Displacement [m] up to which the step is passive."""
        self.solver = ContactSolver(compliance)
        self._breathing = breathing
        self._height = (near.n * near.X).sum(axis=1)
        self._square = (near.X * near.X).sum(axis=1)
        self._q = self._s = self._c = np.empty(0)

    def hold(self, p: Array, excursion: float) -> Array:
        """Return the displacement w [m] at which the sphere with its centre at `p` holds each vertex, shape (m,).

        A vertex X with outward normal n moves along it. With d = p - X and s = -d.n it meets the sphere's lower side at w = s +
        c, c^2 = R^2 - |d|^2 + s^2. Breathing lifts the skin by its fraction of the `excursion` [m].
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
        """Step the vertices, (u, y)+ = M (u, y) + b (S f), held by the sphere; return True if it touches any."""
        free = advance @ self.state
        self.force, moved = self.solver.solve(w - free[0])
        self._finish(advance, feed, free, moved, self.force)
        return bool(self.force.any())

    def _finish(self, advance: Array, feed: Array, free: Array, moved: Array, load: Array) -> None:
        """Set the state from the `free` motion [m], shape (branches + 1, m), and the motion `moved` [m] by a `load` [N],
        (m,).
        """
        self.state = free + (feed / feed[0])[:, None] * moved
        self.impulse = advance @ self.impulse + feed[:, None] * load

    def spring_energy(self, activation: float) -> float:
        """Return the energy of nonlinear springs [J], 0 here."""
        return 0.0

    def push(self) -> Push:
        """Return the resultant of the contact forces.

        The frictionless sphere pushes along its own normals, f (n + (d + s n) / c): f is the component along the skin's normal,
        and the guidance of the vertex takes the rest. Since f holds the vertex exactly on the sphere, tool and field exchange
        equal work.
        """
        f, n, X, q, s, c = self.force, self.near.n, self.near.X, self._q, self._s, self._c
        load, g = f.sum(), f / c
        normal = f @ n
        force = normal + (g.sum() * q - g @ X) + (g * s) @ n
        arm = (f @ X - (f * (s + c)) @ n) / load - q  # a vertex is at X - (s + c) n
        return Push(tuple(force.tolist()), tuple(normal.tolist()), tuple(arm.tolist()))


class SprungPatch(ElasticPatch):
    """A patch with nonlinear springs on the k contact vertices and on those around them, m in all.

    (u, y)+ = M (u, y) + b S (f - q),    q = q(u) + d (u+ - u),  d = max q': at the end of the step, as the solid is.
    """

    def __init__(
        self,
        near: Near,
        vertex: Indices,
        breathing: Array,
        state: Array,
        compliance: Array,
        springs: VertexSprings,
        deepest: float,
    ) -> None:
        """`breathing` is of the k, the others of all `vertex` (m,); `deepest`: largest displacement [m]."""
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
        opposing = resistance(self._table, u, activation) + d * (free[0] - u)  # q for the free motion
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
