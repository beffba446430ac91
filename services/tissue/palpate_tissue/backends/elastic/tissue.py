"""The step of the elastic tissue: implicit, with contact solved exactly.

State of every free vertex: displacement u along its inward rest normal [m] and a relaxed part y_k a Prony branch. With S the
instantaneous compliance,

    S f = u - sum_k y_k + tau_d u',     y_k' = (g_k u - y_k) / tau_k,     f >= 0,  u >= w,  f (u - w) = 0

The coefficients are the same at every vertex, so a step is a small matrix M and a vector b, the same everywhere:
(u, y_1, ..)+ = M (u, y_1, ..) + b (S f). So only the vertices near the sphere are stepped each millisecond, and the others follow
when they are asked for: by M^N for N steps, and by S times what the forces since then left behind, which the same M accumulates.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate_models.phantom import PhantomModel
from palpate_models.scenario import Breathing, Stiffness
from palpate_tissue.backends.elastic.compliance import Compliance
from palpate_tissue.backends.elastic.near import Near, moment, surface_velocity, unit
from palpate_tissue.friction import Friction, shear_stiffness

Array = NDArray[np.float64]

_SKIN_M = 0.0025
"""The vertices near the sphere are gathered anew when it has moved this far."""
_REACH_M = 0.030
"""Least depth of the sphere's centre below the rest surface at which they are still complete."""


def update_rule(stiffness: Stiffness, dt: float) -> tuple[Array, Array]:
    """M, shape (b + 1, b + 1), and b, shape (b + 1,), of a step `dt` [s].

    The dashpot by backward Euler, the branches exactly for a displacement that is held over the step.
    """
    drag = stiffness.dashpot_s / dt
    decay = np.exp(-dt / np.array(stiffness.prony_tau_s))
    intake = np.array(stiffness.prony_g) * (1 - decay)
    share = 1 / (1 + drag)
    advance = np.zeros((1 + len(decay), 1 + len(decay)))
    advance[0] = share
    advance[0, 0] = share * drag
    advance[1:] = intake[:, None] * advance[0]
    advance[1:, 1:] += np.diag(decay)
    return advance, share * np.concatenate(([1.0], intake))


class ElasticTissue:
    """A soft solid that a sphere presses. Everything is in the abdomen frame A and SI units."""

    substeps = 1
    """The step is stable for any mesh."""

    def __init__(
        self,
        model: PhantomModel,
        compliance: Compliance,
        stiffness: Stiffness | None = None,
        breathing: Breathing | None = None,
        dt: float = 1e-3,
    ) -> None:
        stiffness = stiffness or Stiffness()
        breathing = breathing or Breathing()
        self.model = model
        self.compliance = compliance
        self.dt = dt
        self.friction = Friction(stiffness.friction, shear_stiffness(float(np.median(model.background))))
        self._prony_g = stiffness.prony_g
        self._advance, self._feed = update_rule(stiffness, dt)
        self._amplitude = breathing.amplitude_m
        self._pulse = 2 * math.pi * breathing.rate_per_min / 60
        self._excursion = 0.0
        free = compliance.free
        self._positions = model.vertices[free]
        self._normals = model.normals[free]
        self._breathing = model.breathing[free]
        self._tree = cKDTree(self._positions)
        self._state = np.zeros((len(self._feed), len(free)))
        """u and y_k of the free vertices as they were `_behind` steps ago."""
        self._behind = 0
        self._near: Near | None = None
        self.disturbed = False
        """Whether anything has ever moved."""
        self.touching = False
        """Whether the sphere holds a vertex after the step."""

    def excursion(self, t_s: float) -> float:
        """Breathing excursion [m] at time `t_s` [s], outward positive, where the profile is 1."""
        return self._amplitude * math.sin(self._pulse * t_s) if self._amplitude else 0.0

    def step(self, t_s: float, p_A: Array, v_A: Array, radius: float, w_A: Array | None = None) -> tuple[Array, Array]:
        """Advances by one period to time `t_s` [s] with the sphere's centre at `p_A` [m], and returns the wrench on it.

        `v_A` [m/s] and `w_A` [rad/s] are the sphere's velocities, `radius` [m]. The result is the force [N] that the tissue
        exerts on the sphere and its torque about the centre [N m], each of shape (3,). Raises ValueError for a position that is
        not finite.
        """
        p = p_A.tolist()
        if not math.isfinite(sum(p)):
            raise ValueError(f"tissue: the indenter's position is not finite: {p}")
        self._excursion = self.excursion(t_s)
        near = self._near
        if near is None or radius != near.radius or math.dist(p, near.origin) > near.reach:
            near = self._gather(p, radius)
        self._behind += 1
        if not len(near.index) or near.step(near.hold(p, self._excursion), self._advance, self._feed) <= 0:
            self._release()
            return np.zeros(3), np.zeros(3)
        self.touching = self.disturbed = True
        normal_part, push, arm = near.push(p)
        normal, load = unit(normal_part)
        velocity = v_A.tolist()
        if w_A is not None:
            velocity = surface_velocity(velocity, w_A.tolist(), arm)
        rub = self.friction.step(self.dt, velocity, normal, load)
        return np.array([a + b for a, b in zip(push, rub, strict=True)]), np.array(moment(arm, rub))

    def idle(self, t_s: float) -> None:
        """Advances by one period to time `t_s` [s] with no sphere anywhere."""
        self._excursion = self.excursion(t_s)
        self._catch_up()
        self._near = None
        self._behind += 1
        self._release()

    def _release(self) -> None:
        if self.touching:
            self.touching = False
            self.friction.release()

    def _catch_up(self) -> None:
        """Brings every vertex to the present."""
        if not self._behind or not self.disturbed:
            self._behind = 0
            return
        self._state = np.linalg.matrix_power(self._advance, self._behind) @ self._state
        self._behind = 0
        near = self._near
        if near is None:
            return
        pushed = near.impulse[0] != 0
        if pushed.any():
            rows = self.compliance.matrix[near.index[pushed]]
            self._state += near.impulse[:, pushed].astype(np.float32) @ rows
        self._state[:, near.index] = near.state  # the same but for rounding
        near.impulse[:] = 0.0

    def _gather(self, p: list[float], radius: float) -> Near:
        """The vertices that a sphere near `p` might hold, found by the tree."""
        self._catch_up()
        old = self._near
        deepest = float(old.state[0].max(initial=0.0)) if old is not None else 0.0
        ball = math.hypot(radius, max(_REACH_M, deepest + 0.01)) + self._amplitude + _SKIN_M
        distance, nearest = self._tree.query(p)
        index = np.sort(np.asarray(self._tree.query_ball_point(p, ball), dtype=np.intp))
        normals, positions = self._normals[index], self._positions[index] - p
        height = (normals * positions).sum(axis=1)
        lateral = np.linalg.norm(positions - height[:, None] * normals, axis=1)
        facing = normals @ self._normals[nearest] > 0  # not the far side of something thin
        keep = (lateral < radius + _SKIN_M) & facing
        index = index[keep]
        self._near = near = Near(
            origin=p,
            reach=max(_SKIN_M, float(distance) - ball),
            radius=radius,
            index=index,
            positions=positions[keep],
            normals=normals[keep],
            breathing=self._breathing[index],
            compliance=self.compliance.matrix[np.ix_(index, index)].astype(np.float64),
            feed=float(self._feed[0]),
            state=self._state[:, index].copy(),
        )
        if old is not None and self.touching:
            near.solver.begin_with(np.isin(index, old.index[old.solver.active]))
        return near

    @property
    def displacement(self) -> Array:
        """Displacement [m] along the inward rest normal of every vertex, shape (n,)."""
        self._catch_up()
        u = np.zeros(len(self.model.vertices))
        u[self.compliance.free] = self._state[0]
        return u

    @property
    def contacts(self) -> NDArray[np.intp]:
        """Vertices in contact after the step, shape (k,)."""
        near = self._near
        if near is None or not self.touching:
            return np.empty(0, dtype=np.intp)
        return np.asarray(self.compliance.free[near.index[near.force > 0]])

    @property
    def contact_forces(self) -> Array:
        """Their contact forces f > 0 along their inward normals [N], shape (k,)."""
        near = self._near
        if near is None or not self.touching:
            return np.empty(0)
        return near.force[near.force > 0]

    @property
    def inward(self) -> Array:
        """How far each vertex is from its place at rest [m] along its inward normal, breathing included, shape (n,)."""
        u = self.displacement
        return u - self._excursion * self.model.breathing if self._excursion else u

    @property
    def deformed_vertices(self) -> Array:
        """Surface as it is now [m], shape (n, 3), in A."""
        return self.model.vertices - self.inward[:, None] * self.model.normals

    def energy(self) -> float:
        """Elastic energy [J] stored in the solid, the Maxwell branches' included. Factorises S: not for every step."""
        self._catch_up()
        u, *branches = self._state
        fields = [np.sqrt(1 - sum(self._prony_g)) * u]
        fields += [np.sqrt(g) * (u - y / g) for g, y in zip(self._prony_g, branches, strict=True) if g > 0]
        stack = np.stack(fields, axis=1)
        stored = 0.5 * float((stack * np.linalg.solve(self.compliance.matrix.astype(np.float64), stack)).sum())
        return stored + 0.5 * self.friction.stiffness * sum(s * s for s in self.friction.stretch)
