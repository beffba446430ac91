"""The step of the elastic tissue: implicit, with contact solved exactly.

State of every free vertex: displacement u along its inward rest normal [m] and a relaxed part y_k a Prony branch. With S the
instantaneous compliance,

    S (f - q(u)) = u - sum_k y_k + tau_d u',     y_k' = (g_k u - y_k) / tau_k,     f >= 0,  u >= w,  f (u - w) = 0

q is the resistance of springs that stiffen with depth and of contracted muscle, where the model has any (`Springs`).

The coefficients are the same at every vertex, so a step is a small matrix M and a vector b, the same everywhere:
(u, y_1, ..)+ = M (u, y_1, ..) + b S (f - q). So only the vertices near the sphere are stepped each millisecond, and the others
follow when they are asked for: by M^N for N steps, and by S times what the forces since then left behind, which the same M
accumulates.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from palpate_models.numerics.frames import Array
from palpate_models.patient.breathing import STILL, BreathingCurve
from palpate_models.patient.phantom import PhantomModel
from palpate_models.patient.schema import Stiffness
from palpate_tissue.backend import TissueBackend
from palpate_tissue.backends.elastic.compliance import YOUNG_OVER_K_W, Compliance
from palpate_tissue.backends.elastic.patch import MUSCLE, ElasticPatch, SprungPatch, VertexSprings
from palpate_tissue.contact import Sphere, VertexSearch, rub, skin

_MARGIN_M = 0.0025
"""The vertices near the sphere are searched anew when it has moved this far."""
_BESIDE_M = 0.005
"""Springs act on the vertices under the sphere and this far beside it: the stiffening of what lies further, where the skin
sinks in less and its wall is hardly stiffer than at rest, adds less than 1 % to the force."""
_BESIDE_MUSCLE_M = 0.025
"""The same where there is muscle, which resists however little it is pressed in."""
_DEEPER_M = 0.005
"""How much deeper than now the skin may be pressed before the vertices near the sphere are searched anew."""
PRESS_STEP_S = 0.02
"""Step of a standard press: with the service's 1 ms what it reads differs by less than 0.1 %."""


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


class ElasticTissue(TissueBackend):
    """A soft solid that a sphere presses."""

    substeps = 1
    """The step is stable for any mesh."""

    def __init__(
        self,
        model: PhantomModel,
        compliance: Compliance,
        stiffness: Stiffness | None = None,
        breathing: BreathingCurve = STILL,
        dt: float = 1e-3,
    ) -> None:
        stiffness = stiffness or Stiffness()
        super().__init__(model, breathing, dt)
        self.compliance = compliance
        self.friction = skin(stiffness.friction, model.background)
        self.disturbed = False
        """Whether anything has ever moved."""
        self._prony_g, self._stiffness = stiffness.prony_g, stiffness
        self._advance, self._feed = update_rule(stiffness, dt)
        self._excursion = 0.0
        free = compliance.free
        self._breathing = model.breathing[free]
        self._springs = VertexSprings(
            compliance.young / YOUNG_OVER_K_W * model.areas[free], model.stiffening[free], MUSCLE * model.tension[free]
        )
        self._resists = bool(model.stiffening.any() or model.tension.any())
        self._beside = _BESIDE_MUSCLE_M if model.tension.any() else _BESIDE_M
        self._search = VertexSearch(model.vertices[free], model.normals[free], breathing.largest_m, _MARGIN_M)
        self._state = np.zeros((len(self._feed), len(free)))
        """u and y_k of the free vertices as they were `_behind` steps ago."""
        self._behind = 0
        self._patch: ElasticPatch | None = None

    def step(self, t_s: float, p_A: Array, v_A: Array, radius: float, w_A: Array | None = None) -> tuple[Array, Array]:
        """See `TissueBackend`."""
        p = p_A.tolist()
        if not math.isfinite(sum(p)):
            raise ValueError(f"tissue: the indenter's position is not finite: {p}")
        self._excursion = self.excursion(t_s)
        patch = self._patch
        if patch is None or not patch.near.holds(p, radius):
            patch = self._gather(p, radius)
        w = patch.hold(p_A, self._excursion)
        if w.max(initial=0.0) > patch.deepest:
            patch = self._gather(p, radius)
            w = patch.hold(p_A, self._excursion)
        self._behind += 1
        wrench = np.zeros(6)
        if len(patch.vertex) and patch.step(w, self._advance, self._feed, self.activation):
            self.touching = self.disturbed = True
            sphere = Sphere(tuple(p), tuple(v_A.tolist()), (0.0, 0.0, 0.0) if w_A is None else tuple(w_A.tolist()), radius)
            rub(self.friction, sphere, patch.push(), self.dt, wrench)
            self.guard(v_A)
        else:
            self._release()
        return wrench[:3], wrench[3:]

    def idle(self, t_s: float) -> None:
        """See `TissueBackend`."""
        self._excursion = self.excursion(t_s)
        self._catch_up()
        self._patch = None
        self._behind += 1
        self._release()

    def settle(self) -> None:
        """See `TissueBackend`."""
        self._state[:] = 0.0
        self._behind, self._excursion, self._patch = 0, 0.0, None
        self.friction.release()
        self.disturbed = self.touching = False
        self.activation = 1.0

    def in_steps_of(self, dt: float) -> TissueBackend:
        """See `TissueBackend`. Its steps are implicit already."""
        return ElasticTissue(self.model, self.compliance, self._stiffness, self.breathing, dt)

    def press(self, places: Array, normals: Array, radius: float) -> tuple[Array, NDArray[np.bool_]]:
        """See `TissueBackend`. In steps of PRESS_STEP_S: the step is implicit, and what is read is the end of the hold."""
        if self.dt >= PRESS_STEP_S:
            return super().press(places, normals, radius)
        coarse = ElasticTissue(self.model, self.compliance, self._stiffness, dt=PRESS_STEP_S)
        return coarse.press(places, normals, radius)

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
        patch = self._patch
        if patch is None:
            return
        pushed = patch.impulse[0] != 0
        if pushed.any():
            rows = self.compliance.matrix[patch.vertex[pushed]]
            self._state += patch.impulse[:, pushed].astype(np.float32) @ rows
        self._state[:, patch.vertex] = patch.state  # the same but for rounding
        patch.impulse[:] = 0.0

    def _gather(self, p: list[float], radius: float) -> ElasticPatch:
        """The vertices that a sphere near `p` [m] might hold."""
        self._catch_up()
        old = self._patch
        deepest = float(old.state[0].max(initial=0.0)) if old is not None else 0.0
        near = self._search.around(p, radius, deepest)
        index = self._search.around(p, radius + self._beside, deepest).vertex if self._resists else near.vertex
        state = self._state[:, index].copy()
        local = self._feed[0] * self.compliance.matrix[np.ix_(index, index)].astype(np.float64)
        breathing = self._breathing[near.vertex]
        if self._resists:
            lowest = radius + float((near.n * near.X).sum(axis=1).max(initial=-radius)) + max(self._excursion, 0.0)
            deepest = max(deepest, lowest) + _DEEPER_M
            patch: ElasticPatch = SprungPatch(near, index, breathing, state, local, self._springs.at(index), deepest)
        else:
            patch = ElasticPatch(near, breathing, state, local)
        self._patch = patch
        if old is not None and self.touching:
            patch.solver.begin_with(np.isin(near.vertex, old.near.vertex[old.solver.active]))
        return patch

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
        patch = self._patch
        if patch is None or not self.touching:
            return np.empty(0, dtype=np.intp)
        return np.asarray(self.compliance.free[patch.near.vertex[patch.force > 0]])

    @property
    def contact_forces(self) -> Array:
        """Their contact forces f > 0 along their inward normals [N], shape (k,)."""
        patch = self._patch
        if patch is None or not self.touching:
            return np.empty(0)
        return patch.force[patch.force > 0]

    @property
    def deepest(self) -> tuple[int, float]:
        """See `TissueBackend`."""
        patch = self._patch
        assert patch is not None
        displaced = patch.state[0].take(patch.within) * (patch.force > 0)
        k = int(displaced.argmax())
        return int(self.compliance.free[patch.near.vertex[k]]), float(displaced[k])

    @property
    def inward(self) -> Array:
        """How far each vertex is from its place at rest [m] along its inward normal, breathing included, shape (n,)."""
        u = self.displacement
        return u - self._excursion * self.model.breathing if self._excursion else u

    def energy(self) -> float:
        """Elastic energy [J] stored in the solid, the Maxwell branches' included, and in the springs near the sphere.

        Factorises S: not for every step.
        """
        self._catch_up()
        u, *branches = self._state
        fields = [np.sqrt(1 - sum(self._prony_g)) * u]
        fields += [np.sqrt(g) * (u - y / g) for g, y in zip(self._prony_g, branches, strict=True) if g > 0]
        stack = np.stack(fields, axis=1)
        stored = 0.5 * float((stack * np.linalg.solve(self.compliance.matrix.astype(np.float64), stack)).sum())
        springs = 0.0 if self._patch is None else self._patch.spring_energy(self.activation)
        return stored + springs + self.friction.energy()
