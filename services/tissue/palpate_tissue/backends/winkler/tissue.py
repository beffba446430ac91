"""The Winkler-Pasternak tissue: an explicit field with contact solved exactly, vertex by vertex.

State: displacement u of each vertex along its inward rest normal [m], and one internal variable y_k per Prony branch and vertex.

    C u' + K (u - sum_k y_k) + k_w A (sigma(u) + tension a max(u, 0)) = f,     y_k' = (g_k u - y_k) / tau_k
    f >= 0,  u >= w,  f (u - w) = 0

sigma is the stiffening of `patient.wall`, a the muscle contraction, w(p) the displacement at which the sphere holds a vertex. A
step is

    u* = u - h C^-1 [K (u - sum_k y_k) + k_w A (sigma(u) + tension a max(u, 0))]     `move_freely`, `stiffen`
    u  = max(u*, w),  f = C (u - u*) / h                                             `hold`
    y_k = e_k y_k + (1 - e_k) g_k u                                                  `relax`

The README has the derivation. The FMU's C source has the same equations.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array, Indices, Mask
from palpate_models.numerics.vectors import divide, row
from palpate_models.patient import wall as wall_law
from palpate_models.patient.motion import STILL, BreathingCurve
from palpate_models.patient.phantom import PhantomModel
from palpate_models.patient.schema import Stiffness
from palpate_tissue.backend import SkinBody, TissueBackend
from palpate_tissue.backends.winkler.implicit import ImplicitTissue, assemble
from palpate_tissue.backends.winkler.presses import standard_presses
from palpate_tissue.contact import NO_PUSH, Bristle, Near, Push, Sphere, add_friction, add_vertex, meet

Index = NDArray[np.uint16] | NDArray[np.uint32]
"""Unsigned: numba checks signed indices for negative values, which doubles the cost of the step."""
_USUAL_ENTRIES = 7
"""Entries of most matrix rows: a vertex and its six neighbours."""


class Membrane(NamedTuple):
    """State and matrices of the wall for the compiled step: n vertices and b Prony branches, steps of h."""

    u: Array
    """Displacement along the inward normals [m], shape (n,). Changed in place."""
    y: Array
    """Relaxed displacement y_k [m], shape (b, n). Changed in place."""
    indptr: Index
    indices: Index
    rate: Array
    """A = -h C^-1 K, a matrix of shape (n, n) in CSR form."""
    prony: Array
    """e_k = exp(-h / tau_k), and (1 - e_k) g_k, shape (b, 2)."""
    h: float
    """[s]"""
    spring: Array
    """Nonlinear springs: rows `_BETA2`, `_BENT` and `_TENSION`, shape (3, n); (3, 0) if there are none."""
    share: float
    """h k_w A / C = h / dashpot_s: displacement in a step per spring pressure over k_w, equal at all vertices."""
    activation: Array
    """Muscle contraction a, 0 to 1; shape (1,). Changed in place."""


class Patch(NamedTuple):
    """The m vertices that the sphere can hold near its present position.

    Constants are one table, because each array argument costs 0.1 us per step.
    """

    vertex: NDArray[np.uint32]
    """Vertex indices, shape (m,)."""
    table: Array
    """Columns `_N`, `_X`, `_BETA` and `_GAIN`, shape (m, 8)."""
    f: Array
    """Contact forces along the inward normals after the step [N], shape (m,). Changed in place."""


_N, _X, _BETA, _GAIN = 0, 3, 6, 7
"""Columns of a patch: outward normal (3), position (3) [m], fraction of the breathing excursion, C / h [N/m]."""
_BETA2, _BENT, _TENSION = 0, 1, 2
"""Rows of the springs: beta^2 [1/m^2], displacement above which they are linear [m], tension of a contracted muscle [1]."""


@compiled
def step(
    wall: Membrane, patch: Patch, bristle: Bristle, motion: Array, radius: float, excursion: float, disturbed: bool, wrench: Array
) -> bool:
    """Advance the wall by one step at a breathing `excursion` [m]; return True if the sphere touches.

    Rows of `motion` (3, 3): position [m], velocity [m/s] and angular velocity [rad/s] of the sphere of `radius` [m]. In contact
    `wrench` (6,) is set to the force [N] and the torque about the centre [N m] on the sphere. A wall that was never `disturbed`
    stays exactly at rest until it is touched.
    """
    sphere = Sphere(row(motion, 0), row(motion, 1), row(motion, 2), radius)
    if disturbed:
        move_freely(wall)
    touching, push = hold(wall, patch, sphere, excursion)
    if touching:
        add_friction(bristle, sphere, push, wall.h, wrench)
    if disturbed or touching:
        relax(wall)
    return touching


@compiled
def move_freely(wall: Membrane) -> None:
    """Advance the wall without contact: u += A (u - sum_k y_k) - h k_w A / C (sigma(u) + tension a max(u, 0))."""
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
        if end - begin == _USUAL_ENTRIES:  # unrolled by the compiler: 25 % faster
            for j in range(_USUAL_ENTRIES):
                total += rate[begin + j] * strain[indices[begin + j]]
        else:
            for j in range(begin, end):
                total += rate[j] * strain[indices[j]]
        u[i] = total
        begin = end


@compiled
def stiffen(wall: Membrane) -> None:
    """Apply the nonlinear springs of `palpate_models.patient.wall` for one step."""
    u, beta2, straight_from, tension = wall.u, wall.spring[_BETA2], wall.spring[_BENT], wall.spring[_TENSION]
    share, activation = wall.share, wall.activation[0]
    for i in range(len(u)):
        pressed = max(u[i], 0.0)
        bent = min(pressed, straight_from[i])
        stress = beta2[i] * bent * bent * (pressed - 2.0 / 3.0 * bent)
        u[i] -= share * (stress + tension[i] * activation * pressed)


@compiled
def hold(wall: Membrane, patch: Patch, sphere: Sphere, excursion: float) -> tuple[bool, Push]:
    """Move the vertices under the sphere onto its surface at a breathing `excursion` [m]; return True if any, and the push.

    See `contact.meet` and `contact.add_vertex`.
    """
    u, table = wall.u, patch.table
    load, push = 0.0, NO_PUSH
    for k in range(len(patch.vertex)):
        patch.f[k] = 0.0
        i, n = patch.vertex[k], row(table, k, _N)
        d, s, c = meet(sphere.p, sphere.radius, row(table, k, _X), n)
        w = s + c
        gap = w + excursion * table[k, _BETA] - u[i]
        if c == 0.0 or gap <= 0.0:
            continue
        u[i] += gap
        f = table[k, _GAIN] * gap
        patch.f[k] = f
        load += f
        push = add_vertex(push, f, n, d, s, c, w)
    if load <= 0.0:
        return False, push
    return True, Push(push.force, push.normal, divide(push.arm, load))


@compiled
def relax(wall: Membrane) -> None:
    """Update the Prony branches, exact for a constant displacement over the step: y_k = e_k y_k + (1 - e_k) g_k u."""
    for k in range(len(wall.y)):
        y, e, feed = wall.y[k], wall.prony[k, 0], wall.prony[k, 1]
        for i in range(len(y)):
            y[i] = y[i] * e + feed * wall.u[i]


_NONE: Indices = np.empty(0, dtype=np.intp)
_MARGIN_M = 0.005
"""Motion of the sphere after which the vertices near it are searched again."""


class WinklerTissue(SkinBody):
    """A soft surface pressed by a sphere. Raises UserError if the mesh is too fine for the period."""

    def __init__(
        self, model: PhantomModel, stiffness: Stiffness | None = None, breathing: BreathingCurve = STILL, dt: float = 1e-3
    ) -> None:
        super().__init__(model, stiffness, breathing, dt, _MARGIN_M)
        stiffness = self._stiffness
        self.mechanics = assemble(model, stiffness)
        self.substeps = self.mechanics.substeps(dt)
        n, h = len(model.vertices), dt / self.substeps
        self.displacement: Array = np.zeros(n)
        """u [m] along the inward rest normal, shape (n,)."""
        self.branches: Array = np.zeros((len(stiffness.prony_g), n))
        """y_k [m]: relaxed displacement, shape (b, n)."""
        self._prony_g = stiffness.prony_g
        self._wall = self._wall_of(stiffness, h)
        self._gain = self.mechanics.damping / h
        self._near: Near | None = None
        self._patch = self._no_patch = self._patch_of(_NONE)
        self._previous_centre: list[float] | None = None
        """The sphere's centre one period ago [m]."""
        self._advance(self._no_patch, 0.0, np.zeros(6))  # compiles it before the first contact

    def _press(self, t_s: float, p: list[float], radius: float) -> Array:
        """See `SkinBody`. The period has equal sub-steps, in which the sphere moves on a straight line."""
        start = self._previous_centre or p
        self._previous_centre = p
        wrench = np.zeros(6)
        if self.substeps == 1:
            self._substep(self.excursion(t_s), p, radius, wrench)
            return wrench
        part = np.zeros(6)
        for k in range(1, self.substeps + 1):
            share = k / self.substeps
            self._motion[0] = at = [a + share * (b - a) for a, b in zip(start, p, strict=True)]
            part[:] = 0.0
            self._substep(self.excursion(t_s - self.dt * (1 - share)), at, radius, part)
            wrench += part / self.substeps
        return wrench

    def idle(self, t_s: float) -> None:
        """See `TissueBackend`."""
        self._previous_centre = None
        for k in range(1, self.substeps + 1):
            self._excursion = self.excursion(t_s - self.dt * (1 - k / self.substeps))
            self._advance(self._no_patch, 0.0, np.zeros(6))

    def settle(self) -> None:
        """See `TissueBackend`."""
        super().settle()
        self.displacement[:] = self.branches[:] = 0.0
        self._near, self._patch, self._previous_centre = None, self._no_patch, None

    def in_steps_of(self, dt: float) -> TissueBackend:
        """See `TissueBackend`. Implicit steps."""
        return ImplicitTissue(self.model, self._stiffness, self.breathing, dt)

    def press(self, places: Array, normals: Array, radius: float) -> tuple[Array, Mask]:
        """See `TissueBackend`. Uses a few long steps on the part of the wall that each press reaches."""
        return standard_presses(self.model, self._stiffness, places, normals, radius)

    def _substep(self, excursion: float, p: list[float], radius: float, wrench: Array) -> None:
        self._excursion = excursion
        if self._near is None or not self._near.holds(p, radius):
            self._gather(p, radius)
        self._advance(self._patch, radius, wrench)

    def _advance(self, patch: Patch, radius: float, wrench: Array) -> None:
        """Run one explicit step; in contact sets `wrench` (6,) to force [N] and torque [N m] on the sphere."""
        self._wall.activation[0] = self.activation
        touching = step(self._wall, patch, self.friction, self._motion, radius, self._excursion, self.disturbed, wrench)
        self.disturbed = self.disturbed or touching
        self._set_touching(touching)

    def _gather(self, p: list[float], radius: float) -> None:
        """Find the vertices that a sphere near `p` [m] can touch."""
        deepest = float(self.displacement[self._patch.vertex].max(initial=0.0))
        self._near = self._search.around(p, radius, deepest)
        self._patch = self._patch_of(self._free[self._near.vertex])

    def _patch_of(self, index: Indices) -> Patch:
        model = self.model
        table = np.column_stack((model.normals[index], model.vertices[index], model.breathing[index], self._gain[index]))
        return Patch(index.astype(np.uint32), table, np.zeros(len(index)))

    def _wall_of(self, stiffness: Stiffness, h: float) -> Membrane:
        """Return the wall with its matrices for steps of `h` [s]."""
        A = -h * self.mechanics.stiffness
        A.data /= np.repeat(self.mechanics.damping, np.diff(A.indptr))  # row i by C_i
        indptr, columns = A.indptr.astype(np.uint32), A.indices.astype(np.uint32)
        if A.shape[0] <= np.iinfo(np.uint16).max:  # less memory traffic per step
            columns = columns.astype(np.uint16)
        decay: Array = np.exp(-h / np.array(stiffness.prony_tau_s))
        feed: Array = np.array(stiffness.prony_g) * (1 - decay)
        prony, share = np.column_stack((decay, feed)), h / stiffness.dashpot_s
        springs, activation = self._springs(), np.array([self.activation])
        return Membrane(self.displacement, self.branches, indptr, columns, A.data, prony, h, springs, share, activation)

    def _springs(self) -> Array:
        """Return the rows of `Membrane.spring`; no columns if no vertex stiffens or has a muscle."""
        model = self.model
        if not (model.stiffening.any() or model.tension.any()):
            return np.empty((3, 0))
        springs = np.array((model.stiffening**2, wall_law.straight_from(model.stiffening), model.tension))
        springs[:, model.fixed] = 0.0
        return springs

    @property
    def contacts(self) -> Indices:
        """Return the vertices in contact after the step, shape (k,)."""
        return self._patch.vertex[self._patch.f > 0].astype(np.intp) if self.touching else _NONE

    @property
    def contact_forces(self) -> Array:
        """Return the contact forces f > 0 along the inward normals [N], shape (k,)."""
        return self._patch.f[self._patch.f > 0] if self.touching else np.empty(0)

    @property
    def deepest(self) -> tuple[int, float]:
        """See `TissueBackend`."""
        vertex, held = self._patch.vertex, self._patch.f > 0
        displaced = self.displacement.take(vertex) * held
        k = int(displaced.argmax())
        return int(vertex[k]), float(displaced[k])

    @property
    def inward(self) -> Array:
        """See `TissueBackend`."""
        return self.displacement - self._excursion * self.model.breathing if self._excursion else self.displacement

    def energy(self) -> float:
        """Return the elastic energy [J] of all springs, including the Maxwell branches, and of the sheared skin."""
        u, K = self.displacement, self.mechanics.stiffness
        stored = 0.5 * (1 - sum(self._prony_g)) * (u @ (K @ u))
        for g, y in zip(self._prony_g, self.branches, strict=True):
            if g > 0:
                stretch = u - y / g
                stored += 0.5 * g * (stretch @ (K @ stretch))
        model = self.model
        muscle = self.activation * model.tension * np.maximum(u, 0.0) ** 2 / 2
        stored += (model.stiffness * model.areas) @ (wall_law.stored_energy(u, model.stiffening) + muscle)
        return float(stored + self.friction.energy())
