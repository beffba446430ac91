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
from scipy.linalg.blas import daxpy, dscal
from scipy.sparse import _sparsetools
from scipy.spatial import cKDTree

from palpate_models.phantom import PhantomModel
from palpate_models.scenario import Breathing, Stiffness
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
    """Vertices that the sphere might touch while its centre stays near `origin`; m of them."""

    origin: Array  # [m], shape (3,)
    reach: float  # [m] how far the centre may go from origin
    index: NDArray[np.intp]  # vertices, shape (m,)
    normal_position: Array  # outward normal and position relative to origin [m], shape (m, 6)
    project: Array  # stacked normals and doubled positions, shape (2 m, 3)
    height: Array  # position along the own normal [m], shape (m,)
    square: Array  # squared distance from origin [m^2], shape (m,)
    breathing: Array  # share of the breathing excursion, shape (m,)
    gain: Array  # C / h [N/m], shape (m,)


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
        self.branches: list[Array] = [np.zeros(n) for _ in stiffness.prony_g]
        """y_k = g_k z_k [m]: what has relaxed, an array (n,) a Prony branch."""
        self._decay = [math.exp(-self._h / tau) for tau in stiffness.prony_tau_s]
        self._feed = [g * (1 - decay) for g, decay in zip(stiffness.prony_g, self._decay, strict=True)]
        self._prony_g = stiffness.prony_g
        self._strain = np.zeros(n)
        advance = -self._h * self.mechanics.stiffness
        advance.data /= np.repeat(self.mechanics.damping, np.diff(advance.indptr))
        self._advance = (n, n, advance.indptr, advance.indices, advance.data)
        self._gain = self.mechanics.damping / self._h
        free = np.flatnonzero(~model.fixed)
        self._free = free
        self._tree = cKDTree(model.vertices[free])
        self._candidates: _Candidates | None = None
        self._radius = 0.0
        self._deepest = 0.0
        self._at: list[float] | None = None
        self._moved = False
        self.contacts: NDArray[np.intp] = np.empty(0, dtype=np.intp)
        """Vertices in contact after the step, shape (k,)."""
        self.pressures: Array = np.empty(0)
        """Their contact forces f >= 0 along their inward normals [N], shape (k,)."""

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
        start = self._at or end
        if math.dist(start, end) > _SKIN_M:
            start = end
        self._at = end
        velocity = v_A.tolist()
        spin = w_A.tolist() if w_A is not None else None
        if self.substeps == 1:
            wrench = self._substep(self.excursion(t_s), end, velocity, spin, radius)
            return np.array(wrench[:3]), np.array(wrench[3:])
        total = np.zeros(6)
        for k in range(1, self.substeps + 1):
            share = k / self.substeps
            at = [a + share * (b - a) for a, b in zip(start, end, strict=True)]
            total += self._substep(self.excursion(t_s - self.dt * (1 - share)), at, velocity, spin, radius)
        total /= self.substeps
        return total[:3], total[3:]

    def idle(self, t_s: float) -> None:
        """Advances by one period to time `t_s` [s] with no sphere anywhere."""
        for k in range(1, self.substeps + 1):
            self._excursion = self.excursion(t_s - self.dt * (1 - k / self.substeps))
            self._relax()
            self._no_contact()
            self._remember()

    def _substep(
        self, excursion: float, p: list[float], velocity: list[float], spin: list[float] | None, radius: float
    ) -> tuple[float, float, float, float, float, float]:
        """One explicit step; returns force and torque on the sphere."""
        self._excursion = excursion
        near = self._candidates
        if near is None or radius != self._radius or math.dist(p, near.origin) > near.reach:
            near = self._gather(p, radius)
        self._relax()
        wrench = self._contact(near, p, velocity, spin, radius) if len(near.index) else self._no_contact()
        self._remember()
        return wrench

    def _relax(self) -> None:
        """The field as it moves by itself: u += -h C^-1 K (u - sum y). A surface never touched is at rest exactly."""
        if not self._moved:
            return
        u, strain = self.displacement, self._strain
        strain[:] = u
        for branch in self.branches:
            strain -= branch
        _sparsetools.csr_matvec(*self._advance, strain, u)

    def _remember(self) -> None:
        """The Prony branches: exact for a displacement that is held over the step."""
        if not self._moved:
            return
        for branch, decay, feed in zip(self.branches, self._decay, self._feed, strict=True):
            dscal(decay, branch)
            daxpy(self.displacement, branch, a=feed)

    def _contact(
        self,
        near: _Candidates,
        p: list[float],
        velocity: list[float],
        spin: list[float] | None,
        radius: float,
    ) -> tuple[float, float, float, float, float, float]:
        """Holds the vertices under the sphere on it, and returns what that takes."""
        q = np.array(p)
        q -= near.origin
        m = len(near.index)
        projected = near.project @ q
        below = near.height - projected[:m]  # how far the centre is below each vertex at rest, along the inward normal
        root = projected[m:] - near.square
        root += below * below
        root += radius * radius - q @ q  # R^2 - lateral distance^2
        under = (root > (_RIM * radius) ** 2).nonzero()[0]
        if not len(under):
            return self._no_contact()
        below = below[under]
        half = np.sqrt(root[under])
        rest_hold = below + half
        hold = rest_hold + self._excursion * near.breathing[under] if self._excursion else rest_hold
        u = self.displacement
        gap = hold - u[near.index[under]]
        held = (gap > 0).nonzero()[0]
        if not len(held):
            return self._no_contact()
        chosen = under[held]
        vertices = near.index[chosen]
        f = near.gain[chosen] * gap[held]
        u[vertices] = hold = hold[held]
        self.contacts, self.pressures = vertices, f
        self._moved = True
        self._deepest = float(hold.max())
        # Force on the sphere f (n + lateral / half), and f-weighted contact point and normal, as weighted sums of n and x.
        below, half = below[held], half[held]
        weights = np.empty((4, len(held)))
        steep = np.divide(f, half, out=weights[1])
        np.multiply(steep, below, out=weights[0])
        weights[0] += f
        weights[2] = f
        np.multiply(f, rest_hold[held], out=weights[3])
        sums = (weights @ near.normal_position[chosen]).tolist()
        g = float(steep.sum())
        load = float(f.sum())
        qx, qy, qz = q.tolist()
        a, b, c, d = sums
        fx, fy, fz = a[0] + g * qx - b[3], a[1] + g * qy - b[4], a[2] + g * qz - b[5]
        rx, ry, rz = (c[3] - d[0]) / load - qx, (c[4] - d[1]) / load - qy, (c[5] - d[2]) / load - qz
        nx, ny, nz = c[:3]
        length = math.sqrt(nx * nx + ny * ny + nz * nz)
        vx, vy, vz = velocity
        if spin is not None:
            wx, wy, wz = spin
            vx, vy, vz = vx + wy * rz - wz * ry, vy + wz * rx - wx * rz, vz + wx * ry - wy * rx
        tx, ty, tz = self.friction.step(self._h, (vx, vy, vz), (nx / length, ny / length, nz / length), length)
        return (fx + tx, fy + ty, fz + tz, ry * tz - rz * ty, rz * tx - rx * tz, rx * ty - ry * tx)

    def _no_contact(self) -> tuple[float, float, float, float, float, float]:
        if len(self.contacts):
            self.contacts, self.pressures = self.contacts[:0], self.pressures[:0]
            self.friction.release()
        self._deepest = 0.0
        return (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def _gather(self, p: list[float], radius: float) -> _Candidates:
        """The vertices that a sphere near `p` might touch, found by the tree."""
        model = self.model
        ball = math.hypot(radius, max(_REACH_M, self._deepest + 0.01)) + self._amplitude + _SKIN_M
        distance, nearest = self._tree.query(p)
        reach = max(_SKIN_M, float(distance) - ball)
        index = self._free[np.sort(np.asarray(self._tree.query_ball_point(p, ball), dtype=np.intp))]
        index = index[
            model.normals[index] @ model.normals[self._free[nearest]] > 0
        ]  # not the far side of something thin
        origin = np.array(p)
        normals = model.normals[index]
        positions = model.vertices[index] - origin
        self._radius = radius
        self._candidates = _Candidates(
            origin=origin,
            reach=reach,
            index=index,
            normal_position=np.hstack((normals, positions)),
            project=np.vstack((normals, 2 * positions)),
            height=(normals * positions).sum(axis=1),
            square=(positions * positions).sum(axis=1),
            breathing=model.breathing[index],
            gain=self._gain[index],
        )
        return self._candidates

    @property
    def rest_vertices(self) -> Array:
        """Surface without load [m], breathing included, shape (n, 3), in A."""
        return self.model.vertices + (self._excursion * self.model.breathing)[:, None] * self.model.normals

    @property
    def deformed_vertices(self) -> Array:
        """Surface as it is now [m], shape (n, 3), in A."""
        return (
            self.model.vertices
            + (self._excursion * self.model.breathing - self.displacement)[:, None] * self.model.normals
        )

    def energy(self) -> float:
        """Elastic energy [J] stored in the springs, the Maxwell branches' included."""
        u, matrix = self.displacement, self.mechanics.stiffness
        stored = 0.5 * (1 - sum(self._prony_g)) * (u @ (matrix @ u))
        for g, branch in zip(self._prony_g, self.branches, strict=True):
            if g > 0:
                stretch = u - branch / g
                stored += 0.5 * g * (stretch @ (matrix @ stretch))
        return float(stored + 0.5 * self.friction.stiffness * sum(s * s for s in self.friction.stretch))
