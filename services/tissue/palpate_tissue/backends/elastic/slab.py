"""A flat slab pressed by a sphere, for comparison of the elastic tissue with theory.

slab = FlatSlab(young_pa=1e4)
slab.press(radius_m=0.02, depth_m=0.005)
"""

import math
from typing import Literal

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_models.patient.phantom import PhantomModel, flat_phantom
from palpate_tissue.backends.elastic.compliance import COMPLIANCE, YOUNG_OVER_K_W, Compliance, compliance
from palpate_tissue.backends.elastic.patch import ContactSolver

Profile = Literal["sphere", "paraboloid"]


class FlatSlab:
    """A flat layer of skin vertices on a hexagonal lattice, elastic and instantaneous; half-space when `thickness_m` is infinite.

    The skin continues beyond the lattice but cannot be touched there: choose `half_m` larger than the contact radius.
    """

    def __init__(
        self,
        young_pa: float = 1e4,
        thickness_m: float = math.inf,
        half_m: float = 0.025,
        edge_m: float = 0.0015,
        pitch_m: float = 0.010,
    ) -> None:
        self.young_pa = young_pa
        self.poisson = COMPLIANCE.poisson
        self.model: PhantomModel = flat_phantom(half_m, edge_m, young_pa / YOUNG_OVER_K_W)
        self.compliance: Compliance = compliance(self.model, (), thickness_m, pitch_m=pitch_m)
        self._matrix: Array = self.compliance.matrix.astype(np.float64)

    @property
    def vertices(self) -> Array:
        """Return rest positions [m], shape (n, 3), in z = 0 with a vertex at the origin."""
        return self.model.vertices

    def press(self, radius_m: float, depth_m: float, xy_m: tuple[float, float] = (0, 0), profile: Profile = "sphere") -> float:
        """Return the force [N] on a sphere at `xy_m` whose lowest point is `depth_m` below z = 0, along the outward normal.

        `paraboloid` is Hertz's indenter, a sphere to second order.
        """
        offset = self.vertices[self.compliance.free, :2] - np.asarray(xy_m)
        square = (offset**2).sum(axis=1)
        if profile == "paraboloid":
            held = depth_m - square / (2 * radius_m)
        else:
            held = depth_m - radius_m + np.sqrt(np.maximum(radius_m**2 - square, 0.0))
            held[square >= radius_m**2] = -1.0
        near = np.flatnonzero(held > 0)
        solver = ContactSolver(np.ascontiguousarray(self._matrix[np.ix_(near, near)]))
        solver.begin_with(held[near] > 0.5 * held[near].max(initial=0.0))
        return float(solver.solve(held[near])[0].sum())
