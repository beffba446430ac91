"""What resists the skin beside the linear solid: the stiffening of the wall, and contracted muscle (`patient.wall`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array
from palpate_models.patient import wall

MUSCLE = 1.06
"""A muscle's tension over the one that the foundation has (`palpate_models.patient.tension`): the solid spreads the load wider,
so that the press that defines the ratio of guarding would feel 3 % less. With it that press feels it within 2 %."""


@dataclass(frozen=True)
class VertexSprings:
    """Elastic springs in parallel with the solid, one a vertex, m of them.

    q(u) = k_w A [sigma(u) + tension a max(u, 0)]
    """

    gain: Array
    """k_w A [N/m], shape (m,): k_w is what the solid's modulus at the skin makes of it."""
    stiffening: Array
    """[1/m], shape (m,)."""
    tension: Array
    """[1], shape (m,)."""

    def at(self, index: NDArray[np.intp]) -> VertexSprings:
        """Those of some of the vertices."""
        return VertexSprings(self.gain[index], self.stiffening[index], self.tension[index])

    def table(self) -> Array:
        """What `resistance` takes of them, shape (m, 3)."""
        bent = wall.straight_from(self.stiffening)
        return np.column_stack((self.gain * self.stiffening**2, bent, self.gain * self.tension))

    def steepest(self, deepest: float) -> Array:
        """The largest q' [N/m] at any displacement up to `deepest` [m] and any activation, shape (m,)."""
        return self.gain * (wall.slope(np.full(len(self.gain), deepest), self.stiffening) + self.tension)

    def energy(self, u: Array, activation: float) -> float:
        """What they store [J]."""
        pressed = np.maximum(u, 0.0)
        return float(self.gain @ (wall.stored(u, self.stiffening) + 0.5 * activation * self.tension * pressed**2))


@compiled
def resistance(table: Array, u: Array, activation: float) -> Array:
    """The springs' force q [N], outward, at displacements `u` [m] with muscle contracted by `activation`, shape (m,).

    `table` (m, 3) is `Springs.table`; the stiffening part is `palpate_models.patient.wall.stress`.
    """
    q = np.zeros(len(u))
    for i in range(len(u)):
        pressed = u[i]
        if pressed > 0:
            bent = min(pressed, table[i, 1])
            q[i] = table[i, 0] * bent * bent * (pressed - 2 / 3 * bent) + activation * table[i, 2] * pressed
    return q
