"""The places of samples: their usual distance, the area that they fill, and the skin through them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay, cKDTree

from palpate_assessment.sampling import ForceSample
from palpate_models.numerics.frames import Array, Mask

_GAP: Final = 2.0
"""Maximum circumradius of a triangle of samples without a gap, over their usual distance."""

_NEIGHBOURS: Final = 9
"""Samples, itself among them, whose median is the height of the skin at a place."""


@dataclass(frozen=True)
class SampledPlaces:
    """Places of samples; m of them, not all on one line."""

    xy: Array
    """[m], shape (m, 2)."""
    z: Array
    """Height of the skin there [m], shape (m,)."""

    @cached_property
    def mesh(self) -> Delaunay:
        """Triangles between the places."""
        return Delaunay(self.xy)

    @cached_property
    def circumradii(self) -> Array:
        """Circumradii of the triangles [m], shape (t,)."""
        sides = [self.xy[self.mesh.simplices[:, k]] - self.xy[self.mesh.simplices[:, k - 1]] for k in range(3)]
        doubled = np.abs(np.linalg.det(np.stack(sides[:2], axis=1)))
        return np.asarray(np.prod([np.linalg.norm(side, axis=1) for side in sides], axis=0) / np.maximum(2 * doubled, 1e-30))

    @cached_property
    def spacing(self) -> float:
        """Usual distance of neighbours [m]: in a raster its pitch, in lines about that of one from the next."""
        whole = (self.mesh.neighbors >= 0).all(axis=1)  # those along the border may be slivers
        return float(np.sqrt(2) * np.median(self.circumradii[whole if whole.any() else slice(None)]))

    @cached_property
    def filled(self) -> Mask:
        """True for triangles without a gap of many samples, as in a notch of the region, shape (t,)."""
        return np.asarray(self.circumradii <= _GAP * self.spacing)

    def encloses(self, places: Array) -> Mask:
        """Return True for places [m] between samples, shape (k, 2) -> (k,)."""
        inside = self.mesh.find_simplex(places)
        return np.asarray((inside >= 0) & self.filled[inside])

    def lift(self, places: Array) -> Array:
        """Return places [m] on the skin through the samples, shape (k, 2) -> (k, 3); outside it is as high as the nearest one."""
        height = np.asarray(self._height(places))
        outside = np.isnan(height)
        height[outside] = self.z[cKDTree(self.xy).query(places[outside])[1]]
        return np.column_stack((places, height))

    @cached_property
    def _height(self) -> LinearNDInterpolator:
        return LinearNDInterpolator(self.mesh, self.z)


def places_of(samples: Sequence[ForceSample]) -> SampledPlaces:
    """Return the places of samples; each is as high as its neighbours, for an error of its own depth is not the body's shape."""
    position = np.array([sample.position for sample in samples])
    near = cKDTree(position[:, :2]).query(position[:, :2], min(_NEIGHBOURS, len(position)))[1].reshape(len(position), -1)
    return SampledPlaces(position[:, :2], np.median(position[near, 2], axis=1))
