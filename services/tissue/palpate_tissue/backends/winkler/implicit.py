"""The Winkler-Pasternak tissue in long implicit steps, for fast evaluation without a 1 kHz loop; its matrices, and the stability
bound of its explicit step.

The equations of `tissue.py` by backward Euler,

    C (u - u0) / h + K (u - sum_k y_k) + k_w A (sigma(u) + tension a max(u, 0)) = f,    f >= 0,  u >= w,  f (u - w) = 0

are solved by projected successive over-relaxation, vertex by vertex, with the springs linearised at the present displacement.
Only the vertices near the sphere are stepped; those that were near it before follow every `far_s`, or when it returns. Vertices
that it never came near stay at rest. Against steps of all vertices, displacements are up to 0.12 to 0.30 mm too small and the
mean force is 0.14 to 0.53 % too large, more for longer Pasternak lengths (persons of seeds 1000 to 1009, three slides of 120 mm
at 10 mm depth on each). `docs/scoring.md` compares forces with those of the explicit steps.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import ArpackNoConvergence, eigsh
from scipy.spatial import cKDTree

from palpate_errors import UserError
from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array, Indices, Ints, Unsigned
from palpate_models.numerics.vectors import divide, row
from palpate_models.patient import wall, wall as wall_law
from palpate_models.patient.motion import STILL, BreathingCurve
from palpate_models.patient.phantom import PhantomModel
from palpate_models.patient.schema import Stiffness
from palpate_tissue.backend import SkinBody
from palpate_tissue.contact import NO_PUSH, Bristle, Near, Push, Sphere, add_friction, add_vertex, meet

STEP_LIMIT = 1.8
"""Maximum dt * rate of a step. Energy cannot grow below 2; above 1.8 the finest waves would ring for ten steps or more."""
MOST_SUBSTEPS = 64


class Mechanics(NamedTuple):
    """Matrices of `C u' + K (u - sum_k y_k) + k_w A (sigma(u) + tension a max(u, 0)) = f` on the free vertices."""

    stiffness: sparse.csr_array
    """K = diag(k_w A) + L[G], instantaneous [N/m], shape (n, n); rows and columns of fixed vertices are empty."""
    damping: Array
    """Diagonal of C [N s/m], shape (n,)."""
    rate: float
    """Maximum eigenvalue of C^-1 K [1/s], with the nonlinear springs at their largest stiffness."""

    def substeps(self, dt: float) -> int:
        """Return the number of equal explicit steps per period `dt` [s] for which each is stable and passive.

        Raises UserError if it exceeds `MOST_SUBSTEPS`.
        """
        count = max(1, math.ceil(dt * self.rate / STEP_LIMIT))
        if count > MOST_SUBSTEPS:
            raise UserError(
                f"tissue: {count} sub-steps per period of {dt * 1e3:g} ms needed (dt * rate = {dt * self.rate:.3g}, "
                f"limit {STEP_LIMIT}), at most {MOST_SUBSTEPS} allowed: use a coarser mesh (phantom.edge_m), a shorter "
                "phantom.stiffness.length_m or a larger phantom.stiffness.dashpot_s"
            )
        return count


def stiffness_matrix(model: PhantomModel, stiffness: Stiffness) -> sparse.csr_array:
    """Return K of a phantom.

    Pasternak's G = k_w l^2 varies with k_w. An edge between two vertices carries the harmonic mean of their G, as between cells
    of a finite-volume scheme: both halves carry the same shear. It also keeps the bound low at sharp contrasts. Fixed vertices
    keep u = 0.
    """
    free = ~model.fixed
    edges = sparse.coo_array(model.laplacian)
    i, j, weight = edges.coords[0], edges.coords[1], -edges.data
    keep = (i != j) & (free[i] | free[j])
    i, j, weight = i[keep], j[keep], weight[keep]
    shear = model.stiffness * stiffness.length_m**2
    carried = weight * 2 * shear[i] * shear[j] / (shear[i] + shear[j])
    n = len(model.vertices)
    diagonal = model.stiffness * model.areas + np.bincount(i, carried, n)
    inner = free[i] & free[j]
    index = np.flatnonzero(free)
    values, rows, columns = np.append(diagonal[index], -carried[inner]), np.append(index, i[inner]), np.append(index, j[inner])
    matrix = sparse.csr_array((values, (rows, columns)), shape=(n, n))
    matrix.sort_indices()
    return matrix


def assemble(model: PhantomModel, stiffness: Stiffness) -> Mechanics:
    """Return the matrices of a phantom."""
    matrix = stiffness_matrix(model, stiffness)
    damping = stiffness.dashpot_s * model.stiffness * model.areas
    adjacent = wall.largest_slope(model.stiffening, model.tension)
    hardest = matrix + sparse.diags_array(np.where(~model.fixed, model.stiffness * model.areas * adjacent, 0.0))
    return Mechanics(matrix, damping, _largest_rate(hardest, damping))


def _largest_rate(matrix: sparse.csr_array, damping: Array) -> float:
    """Return the largest eigenvalue of C^-1 K by Lanczos with a 1 % margin; Gershgorin's bound if it does not converge."""
    bound = float((abs(matrix).sum(axis=1) / damping).max())
    scale = sparse.diags_array(1 / np.sqrt(damping))
    try:
        start = 1 + np.arange(len(damping)) % 7 / 7.0  # fixed start: runs repeat
        largest = eigsh(scale @ matrix @ scale, k=1, which="LA", v0=start, tol=1e-3, return_eigenvectors=False)[0]
    except ArpackNoConvergence:
        return bound
    return float(min(1.01 * largest, bound))


SWEEPS = 3
"""Over-relaxation sweeps per step near the sphere."""
STILL_M = 1e-7
"""Convergence of sweeps far from the sphere: largest motion of a vertex."""


class ImplicitWall(NamedTuple):
    """The wall: n vertices and b Prony branches. Few arrays, because each costs time in every call of compiled code."""

    u: Array
    """Displacement along the inward normals [m], shape (n,). Changed in place, as are the next three."""
    s: Array
    """Strain u - sum_k y_k [m], shape (n,)."""
    y: Array
    """Relaxed displacement [m], shape (n, b)."""
    clock: Ints
    """Number of the last step of each vertex, shape (n,); vertices near the sphere are at the newest."""
    table: Array
    """Columns `DRAG` to `TENSION` of each vertex, shape (n, 6)."""
    indptr: Unsigned
    indices: Unsigned
    K: Array
    """Instantaneous stiffness [N/m], a matrix of shape (n, n) in CSR form; rows of fixed vertices are empty."""
    decay: Array
    """g_k, then exp(-m h / tau_k) for m = 1 .. the longest step, shape (1 + m, b)."""


DRAG, DIAGONAL, FOUNDATION, BETA2, STRAIGHT_FROM, TENSION = range(6)
"""Columns of a wall: C / h [N/m], diagonal of K, k_w A [N/m], beta^2 [1/m^2], displacement above which the stiffening spring is
linear
[m], tension of a contracted muscle [1]."""


class ImplicitPatch(NamedTuple):
    """The p vertices stepped near the sphere, of which m can be held; vectors in A."""

    near: Indices
    """Stepped vertices, shape (p,)."""
    within: Indices
    """Positions in `near` of the vertices that can be held, shape (m,)."""
    table: Array
    """Their outward normal (3), rest position [m] (3), and fraction of the breathing excursion, shape (m, 7)."""
    f: Array
    """Their contact forces along the inward normals after the step [N], shape (m,). Changed in place."""
    room: Array
    """Displacement before the step and least displacement allowed by the sphere [m], shape (p, 2). Changed in place."""


class Stride(NamedTuple):
    """Parameters of one step of vertices."""

    length: float
    """Length in steps of the wall [1]."""
    kept: float
    """Fraction of a displacement that is strain at the end of the step; the rest relaxes during the step [1]."""
    over: float
    """Over-relaxation of a sweep [1]."""


OWN = Stride(1.0, 1.0, over=1.35)
"""One step of the wall; branches are updated afterwards. The over-relaxation is near optimal: 2 / (1 + sqrt(1 - rho^2)) with
rho = 0.87, the spectral radius of Jacobi sweeps at 10 ms."""


@compiled
def press(
    wall: ImplicitWall,
    patch: ImplicitPatch,
    bristle: Bristle,
    motion: Array,
    radius: float,
    excursion: float,
    activation: float,
    h: float,
) -> tuple[bool, Array]:
    """Step the vertices near a sphere; return True if it touches, and force [N] and torque [N m] about its centre, shape (6,).

    Rows of `motion` (3, 3): position [m], velocity [m/s] and angular velocity [rad/s] of the sphere. All vectors are in A.
    `excursion` of breathing [m], outward positive; `activation` of muscle, in [0, 1]; step `h` [s].
    """
    sphere = Sphere(row(motion, 0), row(motion, 1), row(motion, 2), radius)
    u, near, room, table = wall.u, patch.near, patch.room, patch.table
    for k in range(len(near)):
        room[k, 0], room[k, 1] = u[near[k]], -np.inf
    for k in range(len(table)):
        _, s, c = meet(sphere.p, radius, row(table, k, 3), row(table, k, 0))
        if c > 0.0:
            room[patch.within[k], 1] = s + c + excursion * table[k, 6]
    for _ in range(SWEEPS):
        sweep(wall, near, room, activation, OWN)
    load, push = 0.0, NO_PUSH
    for k in range(len(table)):
        at = patch.within[k]
        patch.f[k] = 0.0
        if u[near[at]] > room[at, 1]:
            continue
        f = -pull(wall, near[at], room[at, 0], activation, 1.0, 1.0)[0]
        if f <= 0.0:
            continue
        n, w = row(table, k, 0), room[at, 1] - excursion * table[k, 6]
        d, s, _ = meet(sphere.p, radius, row(table, k, 3), n)
        patch.f[k] = f
        load += f
        push = add_vertex(push, f, n, d, s, w - s, w)
    relax(wall, near)
    wrench = np.zeros(6)
    if load <= 0.0:
        return False, wrench
    add_friction(bristle, sphere, Push(push.force, push.normal, divide(push.arm, load)), h, wrench)
    return True, wrench


@compiled
def pull(wall: ImplicitWall, i: int, before: float, activation: float, length: float, kept: float) -> tuple[float, float]:
    """Return the residual force [N], inward, at a vertex, and how fast it falls as the vertex moves on [N/m].

    The vertex was at `before` [m] a step of `length` ago; `length` and `kept` as in `Stride`.
    """
    table, at, drag = wall.table, wall.u[i], wall.table[i, DRAG] / length
    force, slope = drag * (before - at), drag + kept * table[i, DIAGONAL]
    for j in range(wall.indptr[i], wall.indptr[i + 1]):
        force -= wall.K[j] * wall.s[wall.indices[j]]
    if at > 0.0:
        bent = min(at, table[i, STRAIGHT_FROM])
        stiffer, held = table[i, BETA2] * bent * bent, table[i, TENSION] * activation
        force -= table[i, FOUNDATION] * (stiffer * (at - 2.0 / 3.0 * bent) + held * at)
        slope += table[i, FOUNDATION] * (stiffer + held)
    return force, slope


@compiled
def sweep(wall: ImplicitWall, near: Indices, room: Array, activation: float, stride: Stride) -> float:
    """Sweep once over vertices with over-relaxation, bounded below by the sphere; return the largest motion [m]."""
    u, s, longest = wall.u, wall.s, 0.0
    for k in range(len(near)):
        i = near[k]
        at = u[i]
        force, slope = pull(wall, i, room[k, 0], activation, stride.length, stride.kept)
        moved = max(at + stride.over * force / slope, room[k, 1])
        s[i] += stride.kept * (moved - at)
        u[i] = moved
        longest = max(longest, abs(moved - at))
    return longest


@compiled
def relax(wall: ImplicitWall, near: Indices) -> None:
    """Update the Prony branches of stepped vertices, exact for a constant displacement over the step."""
    u, s, y, decay = wall.u, wall.s, wall.y, wall.decay
    for k in range(y.shape[1]):
        g, kept = decay[0, k], decay[1, k]
        for i in near:
            change = (1.0 - kept) * (g * u[i] - y[i, k])
            s[i] -= change
            y[i, k] += change


@compiled
def follow(wall: ImplicitWall, vertices: Indices, now: int, activation: float, sweeps: int) -> None:
    """Advance vertices without contact to step `now`, each by one step of its own length, at most that of `decay`.

    First each vertex relaxes with its branches as if in equilibrium; then up to `sweeps` sweeps restore equilibrium, which is far
    away where the sphere has just left.
    """
    u, s, y, clock, decay = wall.u, wall.s, wall.y, wall.clock, wall.decay
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
            force, slope = pull(wall, i, begin[k], activation, float(length[k]), 1.0)
            u[i] += force / slope
            s[i] += force / slope
            longest = max(longest, abs(force / slope))
        if longest < STILL_M:
            return


class ImplicitTuning(NamedTuple):
    """Accuracy of the implicit steps."""

    far_sweeps: int = 20
    """Maximum number of sweeps per step of the other vertices."""
    reach_lengths: float = 1.5
    """Vertices within this many Pasternak lengths of the sphere are stepped."""
    far_s: float = 0.15
    """Step of the other vertices."""
    recovery_s: float = 0.3
    """Time after the sphere has left in which all vertices take every step: the wall recovers within the dashpot's 0.05 s."""
    margin_m: float = 0.010
    """Motion of the sphere after which the vertices near it are searched again."""
    interleave: int = 7
    """A sweep visits every n-th vertex, then the next ones: independent neighbours let the processor work in parallel."""


TUNING: Final = ImplicitTuning()
_NONE: Indices = np.empty(0, dtype=np.intp)


class ImplicitTissue(SkinBody):
    """A soft surface pressed by a sphere, in unconditionally stable steps."""

    def __init__(
        self, model: PhantomModel, stiffness: Stiffness | None = None, breathing: BreathingCurve = STILL, dt: float = 0.01
    ) -> None:
        super().__init__(model, stiffness, breathing, dt, TUNING.margin_m)
        self._reach_m = TUNING.reach_lengths * self._stiffness.length_m
        self._every = max(1, round(TUNING.far_s / dt))
        self._wall = implicit_wall(model, self._stiffness, dt, self._every)
        self._tree = cKDTree(model.vertices[self._free])
        self._steps = self._sprung = 0
        self._near: Near | None = None
        self._patch: ImplicitPatch | None = None

    def _press(self, t_s: float, p: list[float], radius: float) -> Array:
        """See `SkinBody`; the wrench is that at the end of the step."""
        self._tick(t_s)
        if self._near is None or self._patch is None or not self._near.holds(p, radius):
            self._patch = self._gather(p, radius)
        touching, wrench = press(
            self._wall, self._patch, self.friction, self._motion, radius, self._excursion, self.activation, self.dt
        )
        self._set_touching(touching)
        return wrench

    def idle(self, t_s: float) -> None:
        """See `TissueBackend`."""
        self._leave()
        self._tick(t_s)
        self._set_touching(False)

    def settle(self) -> None:
        """See `TissueBackend`."""
        super().settle()
        for state in (self._wall.u, self._wall.s, self._wall.y, self._wall.clock):
            state[:] = 0
        self._steps = self._sprung = 0
        self._near = self._patch = None

    def _tick(self, t_s: float) -> None:
        """Count a step, and advance the vertices far from the sphere when due."""
        self._excursion = self.excursion(t_s)
        if self._steps % self._every == 0 or self._steps < self._sprung:
            if self._patch is not None:
                self._wall.clock[self._patch.near] = self._steps
            follow(self._wall, self._free, self._steps, self.activation, TUNING.far_sweeps)
        self._steps += 1

    def _leave(self) -> None:
        """End the stepping of the patch after the sphere has left."""
        if self._patch is not None:
            self._wall.clock[self._patch.near] = self._steps
            self._sprung = self._steps + round(TUNING.recovery_s / self.dt)
        self._near = self._patch = None

    def _gather(self, p: list[float], radius: float) -> ImplicitPatch:
        """Return the vertices to step while the sphere is near `p` [m]."""
        model, before = self.model, self._patch
        deepest = 0.0 if before is None else float(self._wall.u[before.near].max(initial=0.0))
        if before is not None:
            self._wall.clock[before.near] = self._steps - 1
        self._near = self._search.around(p, radius, deepest)
        vertex = self._free[self._near.vertex]
        stepped = np.zeros(len(model.vertices), dtype=bool)
        stepped[vertex] = stepped[self._free[self._tree.query_ball_point(p, 2 * radius + self._reach_m + TUNING.margin_m)]] = True
        near = np.concatenate([np.flatnonzero(stepped)[k :: TUNING.interleave] for k in range(TUNING.interleave)])
        follow(self._wall, near, self._steps - 1, self.activation, TUNING.far_sweeps)
        table = np.column_stack((model.normals[vertex], model.vertices[vertex], model.breathing[vertex]))
        place = np.empty(len(model.vertices), dtype=np.intp)
        place[near] = np.arange(len(near))
        return ImplicitPatch(near, place[vertex], table, np.zeros(len(vertex)), np.empty((len(near), 2)))

    @property
    def contacts(self) -> Indices:
        """Return the vertices in contact after the step, shape (k,)."""
        patch = self._patch
        return _NONE if patch is None or not self.touching else patch.near[patch.within[patch.f > 0]]

    @property
    def deepest(self) -> tuple[int, float]:
        """See `TissueBackend`."""
        held = self.contacts
        displaced = self._wall.u[held]
        k = int(displaced.argmax())
        return int(held[k]), float(displaced[k])

    @property
    def inward(self) -> Array:
        """See `TissueBackend`."""
        return np.asarray(self._wall.u - self._excursion * self.model.breathing)


def implicit_wall(model: PhantomModel, stiffness: Stiffness, dt: float, longest: int) -> ImplicitWall:
    """Return the wall of a model at rest for steps of `dt` [s], of which one step covers at most `longest`."""
    n, g, tau = len(model.vertices), np.array(stiffness.prony_g), np.array(stiffness.prony_tau_s)
    K = stiffness_matrix(model, stiffness)
    foundation = model.stiffness * model.areas
    drag, bent = stiffness.dashpot_s * foundation / dt, wall_law.straight_from(model.stiffening)
    table = np.column_stack((drag, K.diagonal(), foundation, model.stiffening**2, bent, model.tension))
    return ImplicitWall(
        u=np.zeros(n),
        s=np.zeros(n),
        y=np.zeros((n, len(g))),
        clock=np.zeros(n, dtype=np.int64),
        table=table,
        indptr=K.indptr.astype(np.uint32),
        indices=K.indices.astype(np.uint32),
        K=K.data,
        decay=np.vstack((g, np.exp(-dt * np.arange(1, longest + 1)[:, None] / tau))),
    )
