"""One step of the Winkler-Pasternak tissue, compiled: the equations of the README, vertex by vertex.

    u* = u - h C^-1 [K (u - sum_k y_k) + k_w A (sigma(u) + tension a max(u, 0))]     `move_freely`, `stiffen`
    u  = max(u*, w),  f = C (u - u*) / h                                             `hold`: w is where the sphere holds a vertex
    y_k = e_k y_k + (1 - e_k) g_k u                                                  `relax`

The FMU's C source has the same equations; sigma is `palpate_models.patient.wall.stress`.
"""

from __future__ import annotations

import math
from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array
from palpate_models.numerics.vectors import add, divide, dot, row, scale, subtract
from palpate_models.patient import wall
from palpate_models.patient.breathing import STILL, BreathingCurve
from palpate_models.patient.phantom import PhantomModel
from palpate_models.patient.schema import Stiffness
from palpate_tissue.backend import TissueBackend
from palpate_tissue.backends.winkler.implicit import ImplicitTissue
from palpate_tissue.backends.winkler.mechanics import assemble
from palpate_tissue.backends.winkler.presses import press_in_turn
from palpate_tissue.contact import RIM, Bristle, Near, Push, Sphere, VertexSearch, rub, skin

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


_NONE: NDArray[np.intp] = np.empty(0, dtype=np.intp)
_MARGIN_M = 0.005
"""The vertices near the sphere are searched anew when it has moved this far."""


class WinklerTissue(TissueBackend):
    """A soft surface that a sphere presses. Raises StabilityError if the mesh is too fine for the period."""

    def __init__(
        self,
        model: PhantomModel,
        stiffness: Stiffness | None = None,
        breathing: BreathingCurve = STILL,
        dt: float = 1e-3,
    ) -> None:
        stiffness = stiffness or Stiffness()
        super().__init__(model, breathing, dt)
        self.mechanics = assemble(model, stiffness)
        self.substeps = self.mechanics.substeps(dt)
        self.friction = skin(stiffness.friction, model.background)
        n, h = len(model.vertices), dt / self.substeps
        self.displacement: Array = np.zeros(n)
        """u [m] along the inward rest normal, shape (n,)."""
        self.branches: Array = np.zeros((len(stiffness.prony_g), n))
        """y_k = g_k z_k [m]: what has relaxed, a row (n,) for each Prony branch."""
        self.disturbed = False
        """Whether anything has ever moved; until then the field is left at its exact rest."""
        self._stiffness = stiffness
        self._prony_g = stiffness.prony_g
        self._wall = self._wall_of(stiffness, h)
        self._gain = self.mechanics.damping / h
        self._excursion = 0.0
        self._free = np.flatnonzero(~model.fixed)
        self._search = VertexSearch(model.vertices[self._free], model.normals[self._free], breathing.largest_m, _MARGIN_M)
        self._near: Near | None = None
        self._patch = self._nothing = self._patch_of(_NONE)
        self._motion: Array = np.zeros((3, 3))
        """The sphere's centre [m], velocity [m/s] and angular velocity [rad/s], as rows."""
        self._last: list[float] | None = None
        self._press(self._nothing, 0.0, np.zeros(6))  # compiles it before contact

    def step(self, t_s: float, p_A: Array, v_A: Array, radius: float, w_A: Array | None = None) -> tuple[Array, Array]:
        """See `TissueBackend`. The period is cut into equal sub-steps, in which the sphere moves on a straight line."""
        end = p_A.tolist()
        if not math.isfinite(sum(end)):
            raise ValueError(f"tissue: the indenter's position is not finite: {end}")
        start = self._last or end  # where the sphere was a period ago
        self._last = end
        motion = self._motion
        motion[0], motion[1], motion[2] = p_A, v_A, 0.0 if w_A is None else w_A
        wrench = np.zeros(6)
        if self.substeps == 1:
            self._substep(self.excursion(t_s), end, radius, wrench)
            self.guard(v_A)
            return wrench[:3], wrench[3:]
        part = np.zeros(6)
        for k in range(1, self.substeps + 1):
            share = k / self.substeps
            motion[0] = at = [a + share * (b - a) for a, b in zip(start, end, strict=True)]
            part[:] = 0.0
            self._substep(self.excursion(t_s - self.dt * (1 - share)), at, radius, part)
            wrench += part / self.substeps
        self.guard(v_A)
        return wrench[:3], wrench[3:]

    def idle(self, t_s: float) -> None:
        """See `TissueBackend`."""
        for k in range(1, self.substeps + 1):
            self._excursion = self.excursion(t_s - self.dt * (1 - k / self.substeps))
            self._press(self._nothing, 0.0, np.zeros(6))

    def settle(self) -> None:
        """See `TissueBackend`."""
        self.displacement[:] = self.branches[:] = 0.0
        self.friction.release()
        self._excursion, self._last = 0.0, None
        self._near, self._patch = None, self._nothing
        self.disturbed = self.touching = False
        self.activation = 1.0

    def in_steps_of(self, dt: float) -> TissueBackend:
        """See `TissueBackend`. Implicit steps."""
        return ImplicitTissue(self.model, self._stiffness, self.breathing, dt)

    def press(self, places: Array, normals: Array, radius: float) -> tuple[Array, NDArray[np.bool_]]:
        """See `TissueBackend`. In a few long steps, each press into the part of the wall that it reaches."""
        return press_in_turn(self.model, self._stiffness, (places, normals, radius))

    def _substep(self, excursion: float, p: list[float], radius: float, wrench: Array) -> None:
        self._excursion = excursion
        if self._near is None or not self._near.holds(p, radius):
            self._gather(p, radius)
        self._press(self._patch, radius, wrench)

    def _press(self, patch: Patch, radius: float, wrench: Array) -> None:
        """One explicit step; `wrench` (6,) gets force [N] and torque [N m] on the sphere, and is left alone out of contact."""
        self._wall.activation[0] = self.activation
        touching = step(self._wall, patch, self.friction, self._motion, radius, self._excursion, self.disturbed, wrench)
        if touching:
            self.disturbed = True
        elif self.touching:
            self.friction.release()
        self.touching = touching

    def _gather(self, p: list[float], radius: float) -> None:
        """Finds what a sphere near `p` [m] might touch."""
        deepest = float(self.displacement[self._patch.vertex].max(initial=0.0))
        self._near = self._search.around(p, radius, deepest)
        self._patch = self._patch_of(self._free[self._near.vertex])

    def _patch_of(self, index: NDArray[np.intp]) -> Patch:
        model = self.model
        table = np.column_stack((model.normals[index], model.vertices[index], model.breathing[index], self._gain[index]))
        return Patch(index.astype(np.uint32), table, np.zeros(len(index)))

    def _wall_of(self, stiffness: Stiffness, h: float) -> Membrane:
        """The wall with its matrices for steps of `h` [s]."""
        A = -h * self.mechanics.stiffness
        A.data /= np.repeat(self.mechanics.damping, np.diff(A.indptr))  # row i by C_i
        indptr, columns = A.indptr.astype(np.uint32), A.indices.astype(np.uint32)
        if A.shape[0] <= np.iinfo(np.uint16).max:  # the whole field goes through the cache at each step: the less the better
            columns = columns.astype(np.uint16)
        decay: Array = np.exp(-h / np.array(stiffness.prony_tau_s))
        feed: Array = np.array(stiffness.prony_g) * (1 - decay)
        prony, share = np.column_stack((decay, feed)), h / stiffness.dashpot_s
        return Membrane(
            self.displacement,
            self.branches,
            indptr,
            columns,
            A.data,
            prony,
            h,
            self._springs(),
            share,
            np.array([self.activation]),
        )

    def _springs(self) -> Array:
        """The rows of `Wall.spring`: none where no vertex stiffens or has a muscle."""
        model = self.model
        if not (model.stiffening.any() or model.tension.any()):
            return np.empty((3, 0))
        springs = np.array((model.stiffening**2, wall.straight_from(model.stiffening), model.tension))
        springs[:, model.fixed] = 0.0
        return springs

    @property
    def contacts(self) -> NDArray[np.intp]:
        """Vertices in contact after the step, shape (k,)."""
        return self._patch.vertex[self._patch.f > 0].astype(np.intp) if self.touching else _NONE

    @property
    def contact_forces(self) -> Array:
        """Their contact forces f > 0 along their inward normals [N], shape (k,)."""
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
        """How far each vertex is from its place at rest [m] along its inward normal, breathing included, shape (n,)."""
        if self._excursion:
            return self.displacement - self._excursion * self.model.breathing
        return self.displacement

    def energy(self) -> float:
        """Elastic energy [J] stored in all springs, those of the Maxwell branches too, and in the sheared skin."""
        u, K = self.displacement, self.mechanics.stiffness
        stored = 0.5 * (1 - sum(self._prony_g)) * (u @ (K @ u))
        for g, y in zip(self._prony_g, self.branches, strict=True):
            if g > 0:
                stretch = u - y / g
                stored += 0.5 * g * (stretch @ (K @ stretch))
        model = self.model
        muscle = self.activation * model.tension * np.maximum(u, 0.0) ** 2 / 2
        stored += (model.stiffness * model.areas) @ (wall.stored(u, model.stiffening) + muscle)
        return float(stored + self.friction.energy())
