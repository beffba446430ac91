"""What the service asks of the physics behind it."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class SoftBody(Protocol):
    """A soft body with a skin of n vertices that a sphere presses. In the abdomen frame A and SI units."""

    touching: bool
    """Whether the sphere holds a vertex after the step."""

    def step(self, t_s: float, p_A: Array, v_A: Array, radius: float, w_A: Array | None = None) -> tuple[Array, Array]:
        """Advances by one period to `t_s` [s]; force [N] and torque about its centre [N m] on a sphere at `p_A` [m], (3,) each.

        `v_A` [m/s] and `w_A` [rad/s] are its velocities, `radius` [m] is its size.
        """

    def idle(self, t_s: float) -> None:
        """Advances by one period to `t_s` [s] with no sphere anywhere."""

    def excursion(self, t_s: float) -> float:
        """Breathing excursion [m] at `t_s` [s], outward positive, where the profile is 1."""

    @property
    def contacts(self) -> NDArray[np.intp]:
        """Vertices in contact after the step, shape (k,)."""

    @property
    def inward(self) -> Array:
        """How far each vertex is from its place at rest [m] along its inward normal, breathing included, shape (n,)."""

    @property
    def deformed_vertices(self) -> Array:
        """Surface as it is now [m], shape (n, 3)."""
