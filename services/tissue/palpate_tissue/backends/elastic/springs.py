"""What resists the skin beside the linear solid: the stiffening of the wall, and contracted muscle (`palpate_models.wall`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate_models import wall
from palpate_models.frames import Array


@dataclass(frozen=True)
class Springs:
    """Elastic springs in parallel with the solid, one a vertex, m of them.

    q(u) = k_w A [sigma(u) + tension a max(u, 0)]
    """

    gain: Array
    """k_w A [N/m], shape (m,): k_w is what the solid's modulus at the skin makes of it."""
    stiffening: Array
    """[1/m], shape (m,)."""
    tension: Array
    """[1], shape (m,)."""

    def at(self, index: NDArray[np.intp]) -> Springs:
        """Those of some of the vertices."""
        return Springs(self.gain[index], self.stiffening[index], self.tension[index])

    def force(self, u: Array, activation: float) -> Array:
        """Resistance q [N], outward, at displacements `u` [m] with muscle contracted by `activation`, shape (m,)."""
        return self.gain * (wall.stress(u, self.stiffening) + activation * self.tension * np.maximum(u, 0.0))

    def steepest(self, deepest: float) -> Array:
        """The largest q' [N/m] at any displacement up to `deepest` [m] and any activation, shape (m,)."""
        return self.gain * (wall.slope(np.full(len(self.gain), deepest), self.stiffening) + self.tension)

    def energy(self, u: Array, activation: float) -> float:
        """What they store [J]."""
        pressed = np.maximum(u, 0.0)
        return float(self.gain @ (wall.stored(u, self.stiffening) + 0.5 * activation * self.tension * pressed**2))
