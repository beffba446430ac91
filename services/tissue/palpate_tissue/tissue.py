"""The tissue's step: an explicit field with contact solved exactly, vertex by vertex.

State: displacement u of every vertex along its inward rest normal [m], and one internal variable a Prony branch and vertex.

    C u' + K (u - sum_k y_k) = f,     y_k' = (g_k u - y_k) / tau_k,     f >= 0,  u >= w,  f (u - w) = 0

w(p) is where the sphere holds a vertex on its inward normal. See the README for the derivation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate_models.phantom import PhantomModel
from palpate_models.scenario import Breathing, Stiffness
from palpate_tissue import kernel
from palpate_tissue.friction import Friction, shear_stiffness
from palpate_tissue.mechanics import assemble

Array = NDArray[np.float64]

_SKIN_M = 0.005
"""Contact candidates are gathered anew when the sphere has moved this far."""
_REACH_M = 0.030
"""Least depth of the sphere's centre below the rest surface at which its candidates are still complete."""
_RIM = 0.2
"""Vertices are held by the sphere where its surface makes less than 78 degrees with the tangent plane (cos > 0.2)."""


@dataclass
class _Candidates:
    """Vertices that the sphere might hold while its centre stays near `origin`; m of them."""

    origin: list[float]  # [m], in A
    zero: Array  # the same for compiled code, shape (3,)
    reach: float  # [m] how far the centre may go from origin
    radius: float  # [m] of the sphere
    index: NDArray[np.uint32]  # vertices, shape (m,)
    vertices: Array  # outward normal, position from origin [m], share of breathing, C / h [N/m], shape (m, 8)
    force: Array  # of each in the last step [N], shape (m,)


class Tissue:
    """A soft surface that a sphere presses. Everything is in the abdomen frame A and SI units.

    Raises StabilityError if the mesh is too fine for the period.
    """

    def __init__(
        self,
        model: PhantomModel,
        stiffness: Stiffness | None = None,
        breathing: Breathing | None = None,
        dt: float = 1e-3,
    ) -> None:
        stiffness = stiffness or Stiffness()
        breathing = breathing or Breathing()
        n = len(model.vertices)
        self.model = model
        self.dt = dt
        self.mechanics = assemble(model, stiffness)
        self.substeps = self.mechanics.substeps(dt)
        self._h = dt / self.substeps
        self.friction = Friction(stiffness.friction, shear_stiffness(float(np.median(model.background))))
        self._amplitude = breathing.amplitude_m
        self._pulse = 2 * math.pi * breathing.rate_per_min / 60
        self._excursion = 0.0
        self.displacement: Array = np.zeros(n)
        """u [m] along the inward rest normal, shape (n,)."""
        self.branches: Array = np.zeros((len(stiffness.prony_g), n))
        """y_k = g_k z_k [m]: what has relaxed, a row (n,) for each Prony branch."""
        decay: Array = np.exp(-self._h / np.array(stiffness.prony_tau_s))
        feed: Array = np.array(stiffness.prony_g) * (1 - decay)
        self._prony_g = stiffness.prony_g
        advance = -self._h * self.mechanics.stiffness
        advance.data /= np.repeat(self.mechanics.damping, np.diff(advance.indptr))
        columns: kernel.Index = advance.indices.astype(np.uint32)
        if n <= np.iinfo(np.uint16).max:  # all of the field goes through the cache at each step: the less the better
            columns = columns.astype(np.uint16)
        matrix = (advance.indptr.astype(np.uint32), columns, advance.data)
        self._field = (*matrix, self.branches, decay, feed, np.zeros(n))
        self._gain = self.mechanics.damping / self._h
        free = np.flatnonzero(~model.fixed)
        self._free = free
        self._tree = cKDTree(model.vertices[free])
        self._candidates: _Candidates | None = None
        self._rub: Array = np.array((self.friction.coefficient, self.friction.stiffness, self._h))
        self._sphere: Array = np.zeros((3, 3))
        """The sphere's centre [m], velocity [m/s] and angular velocity [rad/s]."""
        self._at: list[float] | None = None
        self.disturbed = False
        """Whether anything has ever moved; until then the field is left at its exact rest."""
        self.touching = False
        """Whether the sphere holds a vertex after the step."""
        self._nobody = _Candidates([], np.zeros(3), 0.0, 0.0, np.zeros(0, np.uint32), np.zeros((0, 8)), np.zeros(0))
        self._press(self._nobody, np.zeros(6))  # compiles it: the first contact need not wait

    def excursion(self, t_s: float) -> float:
        """Breathing excursion [m] at time `t_s` [s], outward positive, where the profile is 1."""
        return self._amplitude * math.sin(self._pulse * t_s) if self._amplitude else 0.0

    def step(self, t_s: float, p_A: Array, v_A: Array, radius: float, w_A: Array | None = None) -> tuple[Array, Array]:
        """Advances by one period to time `t_s` [s] with the sphere's centre at `p_A` [m], and returns the wrench on it.

        `v_A` [m/s] and `w_A` [rad/s] are the sphere's velocities, `radius` [m]. The result is the force [N] that the tissue
        exerts on the sphere and its torque about the centre [N m], each of shape (3,), the mean over the period.
        """
        end = p_A.tolist()
        if not math.isfinite(sum(end)):
            raise ValueError(f"tissue: the indenter's position is not finite: {end}")
        start = self._at or end  # where the sphere was a period ago
        self._at = end
        sphere = self._sphere
        sphere[0] = p_A
        sphere[1] = v_A
        sphere[2] = 0.0 if w_A is None else w_A
        wrench = np.zeros(6)
        if self.substeps == 1:
            self._substep(self.excursion(t_s), end, radius, wrench)
            return wrench[:3], wrench[3:]
        part = np.zeros(6)
        for k in range(1, self.substeps + 1):
            share = k / self.substeps
            at = [a + share * (b - a) for a, b in zip(start, end, strict=True)]
            sphere[0] = at
            part[:] = 0.0
            self._substep(self.excursion(t_s - self.dt * (1 - share)), at, radius, part)
            wrench += part
        wrench /= self.substeps
        return wrench[:3], wrench[3:]

    def idle(self, t_s: float) -> None:
        """Advances by one period to time `t_s` [s] with no sphere anywhere."""
        for k in range(1, self.substeps + 1):
            self._excursion = self.excursion(t_s - self.dt * (1 - k / self.substeps))
            self._press(self._nobody, np.zeros(6))
            self._no_contact()

    def _substep(self, excursion: float, p: list[float], radius: float, wrench: Array) -> None:
        """One explicit step; `wrench` (6,) gets force [N] and torque [N m] on the sphere, and is left alone out of contact."""
        self._excursion = excursion
        near = self._candidates
        if near is None or radius != near.radius or math.dist(p, near.origin) > near.reach:
            near = self._gather(p, radius)
        if self._press(near, wrench):
            self.touching = self.disturbed = True
        else:
            self._no_contact()

    def _press(self, near: _Candidates, wrench: Array) -> bool:
        """The compiled step; `wrench` (6,) gets what holding the vertices under the sphere takes. False where none is touched."""
        return kernel.step(
            *self._field,
            self.displacement,
            self.disturbed,
            near.index,
            near.vertices,
            near.zero,
            self._sphere,
            near.radius,
            _RIM,
            self._excursion,
            near.force,
            self.friction.bristle,
            self._rub,
            wrench,
        )

    def _no_contact(self) -> None:
        if self.touching:
            self.touching = False
            self.friction.release()

    def _gather(self, p: list[float], radius: float) -> _Candidates:
        """The vertices that a sphere near `p` might hold, found by the tree."""
        model = self.model
        old = self._candidates
        deepest = float(self.displacement[old.index].max(initial=0.0)) if old is not None else 0.0
        ball = math.hypot(radius, max(_REACH_M, deepest + 0.01)) + self._amplitude + _SKIN_M
        distance, nearest = self._tree.query(p)
        reach = max(_SKIN_M, float(distance) - ball)
        index = self._free[np.sort(np.asarray(self._tree.query_ball_point(p, ball), dtype=np.intp))]
        normals, positions = model.normals[index], model.vertices[index] - p
        height = (normals * positions).sum(axis=1)
        lateral = np.linalg.norm(positions - height[:, None] * normals, axis=1)
        facing = normals @ model.normals[self._free[nearest]] > 0  # not the far side of something thin
        keep = (lateral < radius + _SKIN_M) & facing
        index, normals, positions = index[keep], normals[keep], positions[keep]
        self._candidates = _Candidates(
            origin=list(p),
            zero=np.array(p),
            reach=reach,
            radius=radius,
            index=index.astype(np.uint32),
            vertices=np.column_stack((normals, positions, model.breathing[index], self._gain[index])),
            force=np.zeros(len(index)),
        )
        return self._candidates

    @property
    def contacts(self) -> NDArray[np.intp]:
        """Vertices in contact after the step, shape (k,)."""
        near = self._candidates
        if near is None or not self.touching:
            return np.empty(0, dtype=np.intp)
        return np.asarray(near.index[near.force > 0])

    @property
    def contact_forces(self) -> Array:
        """Their contact forces f > 0 along their inward normals [N], shape (k,)."""
        near = self._candidates
        if near is None or not self.touching:
            return np.empty(0)
        return np.asarray(near.force[near.force > 0])

    @property
    def inward(self) -> Array:
        """How far each vertex is from its place at rest [m] along its inward normal, breathing included, shape (n,)."""
        if self._excursion:
            return self.displacement - self._excursion * self.model.breathing
        return self.displacement

    @property
    def deformed_vertices(self) -> Array:
        """Surface as it is now [m], shape (n, 3), in A."""
        return self.model.vertices - self.inward[:, None] * self.model.normals

    def energy(self) -> float:
        """Elastic energy [J] stored in the springs, the Maxwell branches' included."""
        u, matrix = self.displacement, self.mechanics.stiffness
        stored = 0.5 * (1 - sum(self._prony_g)) * (u @ (matrix @ u))
        for g, branch in zip(self._prony_g, self.branches, strict=True):
            if g > 0:
                stretch = u - branch / g
                stored += 0.5 * g * (stretch @ (matrix @ stretch))
        return float(stored + 0.5 * self.friction.stiffness * sum(s * s for s in self.friction.stretch))
