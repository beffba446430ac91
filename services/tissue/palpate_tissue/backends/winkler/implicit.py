"""The Winkler-Pasternak tissue in long steps: the wall of `tissue.py` by backward Euler, for who needs it fast and not each 1 ms.

Only the vertices near the sphere are stepped; the others follow every FAR_S, or when the sphere comes near. The README says how
near its forces are to those of the explicit steps.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate_models.numerics.frames import Array
from palpate_models.patient import wall
from palpate_models.patient.breathing import STILL, BreathingCurve
from palpate_models.patient.phantom import PhantomModel
from palpate_models.patient.schema import Stiffness
from palpate_tissue import friction
from palpate_tissue.backend import TissueBackend
from palpate_tissue.backends.winkler.implicit_kernel import ImplicitPatch, ImplicitWall, follow, press
from palpate_tissue.backends.winkler.mechanics import stiffness_matrix
from palpate_tissue.near import Near, VertexSearch

SWEEPS: Final = 3
"""Sweeps of over-relaxation in a step near the sphere."""
FAR_SWEEPS: Final = 20
"""The same in a step of the others, at most."""
REACHED: Final = 1.5
"""Vertices within so many Pasternak lengths of the sphere are stepped."""
FAR_S: Final = 0.15
"""The others follow so often,"""
SPRING_S: Final = 0.3
"""and at every step for so long after the sphere has left them: the wall springs back within the dashpot's 0.05 s."""
_MARGIN_M: Final = 0.010
"""The vertices near the sphere are searched anew when it has moved this far."""
_APART: Final = 7
"""A sweep takes every so many-th vertex, then those beside them: a processor has several in hand when none waits for the one
before it."""
_NONE: NDArray[np.intp] = np.empty(0, dtype=np.intp)


class ImplicitTissue(TissueBackend):
    """A soft surface that a sphere presses, in steps that no stability limits."""

    def __init__(
        self,
        model: PhantomModel,
        stiffness: Stiffness | None = None,
        breathing: BreathingCurve = STILL,
        dt: float = 0.01,
    ) -> None:
        stiffness = stiffness or Stiffness()
        super().__init__(model, breathing, dt)
        self.friction = friction.skin(stiffness.friction, model.background)
        self._reach_m = REACHED * stiffness.length_m
        self._every = max(1, round(FAR_S / dt))
        self._wall = implicit_wall(model, stiffness, dt, self._every)
        self._free = np.flatnonzero(~model.fixed)
        self._search = VertexSearch(model.vertices[self._free], model.normals[self._free], breathing.largest_m, _MARGIN_M)
        self._tree = cKDTree(model.vertices[self._free])
        self._steps = self._sprung = 0
        self._excursion = 0.0
        self._near: Near | None = None
        self._patch: ImplicitPatch | None = None
        self._motion: Array = np.zeros((3, 3))

    def step(self, t_s: float, p_A: Array, v_A: Array, radius: float, w_A: Array | None = None) -> tuple[Array, Array]:
        """See `TissueBackend`; the wrench is that of the step's end."""
        p = p_A.tolist()
        if not math.isfinite(sum(p)):
            raise ValueError(f"tissue: the indenter's position is not finite: {p}")
        self._tick(t_s)
        if self._near is None or self._patch is None or not self._near.holds(p, radius):
            self._patch = self._gather(p, radius)
        motion = self._motion
        motion[0], motion[1], motion[2] = p_A, v_A, 0.0 if w_A is None else w_A
        numbers = (radius, self._excursion, self.activation, self.dt)
        touching, wrench = press(self._wall, self._patch, self.friction, motion, numbers, SWEEPS)
        if self.touching and not touching:
            self.friction.release()
        self.touching = touching
        self.guard(v_A)
        return wrench[:3], wrench[3:]

    def idle(self, t_s: float) -> None:
        """See `TissueBackend`."""
        self._leave()
        self._tick(t_s)
        if self.touching:
            self.friction.release()
            self.touching = False

    def settle(self) -> None:
        """See `TissueBackend`."""
        state = self._wall
        state.u[:] = state.s[:] = 0.0
        state.y[:] = 0.0
        state.clock[:] = 0
        self._steps = self._sprung = 0
        self._excursion = 0.0
        self._near = self._patch = None
        self.friction.release()
        self.touching = False
        self.activation = 1.0

    def _tick(self, t_s: float) -> None:
        """One step on: now and then, all that is far from the sphere follows."""
        self._excursion = self.excursion(t_s)
        if self._steps % self._every == 0 or self._steps < self._sprung:
            if self._patch is not None:
                self._wall.clock[self._patch.near] = self._steps
            follow(self._wall, self._free, self._steps, self.activation, FAR_SWEEPS)
        self._steps += 1

    def _leave(self) -> None:
        """The sphere is no longer near where it was."""
        if self._patch is not None:
            self._wall.clock[self._patch.near] = self._steps
            self._sprung = self._steps + round(SPRING_S / self.dt)
        self._near = self._patch = None

    def _gather(self, p: list[float], radius: float) -> ImplicitPatch:
        """What is stepped while the sphere is near `p` [m]."""
        model, before = self.model, self._patch
        deepest = 0.0 if before is None else float(self._wall.u[before.near].max(initial=0.0))
        if before is not None:
            self._wall.clock[before.near] = self._steps - 1
        self._near = self._search.around(p, radius, deepest)
        vertex = self._free[self._near.vertex]
        stepped = np.zeros(len(model.vertices), dtype=bool)
        stepped[vertex] = stepped[self._free[self._tree.query_ball_point(p, 2 * radius + self._reach_m + _MARGIN_M)]] = True
        near = np.concatenate([np.flatnonzero(stepped)[first::_APART] for first in range(_APART)])
        follow(self._wall, near, self._steps - 1, self.activation, FAR_SWEEPS)
        table = np.column_stack((model.normals[vertex], model.vertices[vertex], model.breathing[vertex]))
        place = np.empty(len(model.vertices), dtype=np.intp)
        place[near] = np.arange(len(near))
        return ImplicitPatch(near, place[vertex], table, np.zeros(len(vertex)), np.empty((len(near), 2)))

    @property
    def contacts(self) -> NDArray[np.intp]:
        """Vertices in contact after the step, shape (k,)."""
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
    """The wall of a model at rest, for steps of `dt` [s], of which it takes at most `longest` in one."""
    n, g, tau = len(model.vertices), np.array(stiffness.prony_g), np.array(stiffness.prony_tau_s)
    K = stiffness_matrix(model, stiffness)
    foundation = model.stiffness * model.areas
    table = np.column_stack(
        (
            stiffness.dashpot_s * foundation / dt,
            K.diagonal(),
            foundation,
            model.stiffening**2,
            wall.straight_from(model.stiffening),
            model.tension,
        )
    )
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
