"""The elastic tissue: implicit steps with contact solved exactly.

State of each free vertex: displacement u along its inward rest normal [m] and a relaxed part y_k per Prony branch. With S the
instantaneous compliance,

    S (f - q(u)) = u - sum_k y_k + tau_d u',     y_k' = (g_k u - y_k) / tau_k,     f >= 0,  u >= w,  f (u - w) = 0

q is the resistance of stiffening springs and of contracted muscle, if the model has any (`VertexSprings`).

The coefficients are equal at all vertices, so a step is one small matrix M and one vector b: (u, y_1, ..)+ = M (u, y_1, ..) + b S
(f - q). Therefore only the vertices near the sphere are stepped each millisecond. The others are updated on demand: by M^N for N
steps, and by S times the accumulated effect of the forces since then, which the same M propagates.
"""

from typing import NamedTuple

import numpy as np

from palpate_models.numerics.frames import Array, Indices, Mask
from palpate_models.patient.motion import STILL, BreathingCurve
from palpate_models.patient.phantom import PhantomModel
from palpate_models.patient.schema import Stiffness
from palpate_tissue.backend import SkinBody, TissueBackend
from palpate_tissue.backends.elastic.compliance import YOUNG_OVER_K_W, Compliance
from palpate_tissue.backends.elastic.patch import MUSCLE, ElasticPatch, SprungPatch, VertexSprings
from palpate_tissue.contact import Sphere, add_friction


class ElasticTuning(NamedTuple):
    """Extent of the stepped vertices, and the step of a standard press."""

    margin_m: float = 0.0025
    """Motion of the sphere after which the vertices near it are searched again."""
    deeper_m: float = 0.005
    """Additional depth after which the vertices near it are searched again."""
    springs_beyond_m: float = 0.005
    """Springs act this far beyond the sphere. Further away the wall is hardly stiffer than at rest: less than 1 % of the
    force."""
    muscle_beyond_m: float = 0.025
    """Springs act this far beyond the sphere on muscle, which resists any displacement."""
    press_step_s: float = 0.02
    """Step of a standard press; its reading differs by less than 0.1 % from that with 1 ms."""


TUNING = ElasticTuning()


def update_rule(stiffness: Stiffness, dt: float) -> tuple[Array, Array]:
    """Return M, shape (b + 1, b + 1), and b, shape (b + 1,), of a step `dt` [s].

    The dashpot is integrated by backward Euler, the branches exactly for a constant displacement over the step.
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


class ElasticTissue(SkinBody):
    """A soft solid pressed by a sphere. The step is stable for any mesh."""

    substeps = 1

    def __init__(
        self,
        model: PhantomModel,
        compliance: Compliance,
        stiffness: Stiffness | None = None,
        breathing: BreathingCurve = STILL,
        dt: float = 1e-3,
    ) -> None:
        super().__init__(model, stiffness, breathing, dt, TUNING.margin_m)
        self.compliance = compliance
        self._prony_g = self._stiffness.prony_g
        self._advance, self._feed = update_rule(self._stiffness, dt)
        free = compliance.free
        self._breathing = model.breathing[free]
        self._springs = VertexSprings(
            compliance.young / YOUNG_OVER_K_W * model.areas[free], model.stiffening[free], MUSCLE * model.tension[free]
        )
        self._resists = bool(model.stiffening.any() or model.tension.any())
        self._beyond = TUNING.muscle_beyond_m if model.tension.any() else TUNING.springs_beyond_m
        self._state = np.zeros((len(self._feed), len(free)))
        """u and y_k of the free vertices `_behind` steps ago."""
        self._behind = 0
        self._patch: ElasticPatch | None = None

    def _press(self, t_s: float, p: list[float], radius: float) -> Array:
        """See `SkinBody`."""
        p_A, velocity, spin = self._motion
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
            self.disturbed = True
            self._set_touching(True)
            sphere = Sphere(tuple(p_A.tolist()), tuple(velocity.tolist()), tuple(spin.tolist()), radius)
            add_friction(self.friction, sphere, patch.push(), self.dt, wrench)
        else:
            self._set_touching(False)
        return wrench

    def idle(self, t_s: float) -> None:
        """See `TissueBackend`."""
        self._excursion = self.excursion(t_s)
        self._catch_up()
        self._patch = None
        self._behind += 1
        self._set_touching(False)

    def settle(self) -> None:
        """See `TissueBackend`."""
        super().settle()
        self._state[:] = 0.0
        self._behind, self._patch = 0, None

    def in_steps_of(self, dt: float) -> TissueBackend:
        """See `TissueBackend`."""
        return ElasticTissue(self.model, self.compliance, self._stiffness, self.breathing, dt)

    def press(self, places: Array, normals: Array, radius: float) -> tuple[Array, Mask]:
        """See `TissueBackend`. Uses long steps: the step is implicit, and the reading is at the end of the hold."""
        if self.dt >= TUNING.press_step_s:
            return super().press(places, normals, radius)
        coarse = ElasticTissue(self.model, self.compliance, self._stiffness, dt=TUNING.press_step_s)
        return coarse.press(places, normals, radius)

    def _catch_up(self) -> None:
        """Advance all vertices to the present."""
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
        self._state[:, patch.vertex] = patch.state  # equal except for rounding
        patch.impulse[:] = 0.0

    def _gather(self, p: list[float], radius: float) -> ElasticPatch:
        """Return the patch of vertices that a sphere near `p` [m] can hold."""
        self._catch_up()
        old = self._patch
        deepest = float(old.state[0].max(initial=0.0)) if old is not None else 0.0
        near = self._search.around(p, radius, deepest)
        index = self._search.around(p, radius + self._beyond, deepest).vertex if self._resists else near.vertex
        state = self._state[:, index].copy()
        local = self._feed[0] * self.compliance.matrix[np.ix_(index, index)].astype(np.float64)
        breathing = self._breathing[near.vertex]
        if self._resists:
            lowest = radius + float((near.n * near.X).sum(axis=1).max(initial=-radius)) + max(self._excursion, 0.0)
            deepest = max(deepest, lowest) + TUNING.deeper_m
            patch: ElasticPatch = SprungPatch(near, index, breathing, state, local, self._springs.at(index), deepest)
        else:
            patch = ElasticPatch(near, breathing, state, local)
        self._patch = patch
        if old is not None and self.touching:
            patch.solver.begin_with(np.isin(near.vertex, old.near.vertex[old.solver.active]))
        return patch

    @property
    def displacement(self) -> Array:
        """Return the displacement of each vertex along its inward rest normal [m], shape (n,)."""
        self._catch_up()
        u = np.zeros(len(self.model.vertices))
        u[self.compliance.free] = self._state[0]
        return u

    @property
    def contacts(self) -> Indices:
        """Return the vertices in contact after the step, shape (k,)."""
        patch = self._patch
        if patch is None or not self.touching:
            return np.empty(0, dtype=np.intp)
        return np.asarray(self.compliance.free[patch.near.vertex[patch.force > 0]])

    @property
    def contact_forces(self) -> Array:
        """Return the contact forces f > 0 along the inward normals [N], shape (k,)."""
        patch = self._patch
        return np.empty(0) if patch is None or not self.touching else patch.force[patch.force > 0]

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
        """See `TissueBackend`."""
        u = self.displacement
        return u - self._excursion * self.model.breathing if self._excursion else u

    def energy(self) -> float:
        """Return the elastic energy [J] of the solid with its Maxwell branches, and of the springs near the sphere.

        Expensive: factorises S.
        """
        self._catch_up()
        u, *branches = self._state
        fields = [np.sqrt(1 - sum(self._prony_g)) * u]
        fields += [np.sqrt(g) * (u - y / g) for g, y in zip(self._prony_g, branches, strict=True) if g > 0]
        stack = np.stack(fields, axis=1)
        stored = 0.5 * float((stack * np.linalg.solve(self.compliance.matrix.astype(np.float64), stack)).sum())
        springs = 0.0 if self._patch is None else self._patch.spring_energy(self.activation)
        return stored + springs + self.friction.energy()
