"""Palpable properties of a pressed patient: apparent stiffness between the pressed places, and areas of lumps.

The felt contrast of a lump is the force with it over the force without it, and e its logarithm. A lump's area is the connected
set about its maximum |e| in which e has the sign that it has there and |e| is at least half of it. Everything is in the xy plane
of A; areas are on the skin.
"""

from typing import Final, NamedTuple

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import label, maximum
from scipy.spatial import Delaunay

from palpate.truth.pressed import Pressed, TrueSurface
from palpate_models.numerics.frames import Array, Mask
from palpate_models.scenario.schema import Exam

RASTER_M: Final = 0.001
"""Pitch of the raster on which areas are compared."""
PALPABLE: Final = 0.05
"""A lump whose |e| is smaller everywhere in the examined region is not palpable."""


class Lump(NamedTuple):
    """Palpable properties of a lump."""

    palpable: bool
    contrast: float
    """Felt contrast where |e| is maximal [1]; below 1 if softer than its surroundings."""
    centroid: Array
    """Centre of its area [m], shape (2,); where |e| is maximal if it is not palpable."""
    area: float
    """[m^2]; 0 if it is not palpable."""
    inside: Mask
    """Its area on the raster, shape (ny, nx)."""


class Felt:
    """Apparent stiffness by the standard press over the examined region and a border around it."""

    def __init__(self, pressed: Pressed, surface: TrueSurface, exam: Exam) -> None:
        mesh = Delaunay(pressed.places[:, :2])

        def between(values: Array) -> LinearNDInterpolator:
            return LinearNDInterpolator(mesh, values)

        self.pressed, self.surface = pressed, surface
        self._force = between(np.log(pressed.force))
        self._limited = between(pressed.limited.astype(float))
        self._excess = between(np.log(pressed.force / pressed.healthy))
        low, high = pressed.places[:, :2].min(axis=0), pressed.places[:, :2].max(axis=0)
        self._x, self._y = (np.arange(a + 0.5 * RASTER_M, b, RASTER_M) for a, b in zip(low, high, strict=True))
        xx, yy = np.meshgrid(self._x, self._y)
        self.raster = np.column_stack((xx.ravel(), yy.ravel()))
        """Raster points [m], shape (ny nx, 2)."""
        self.cells = surface.steepness(self.raster) * RASTER_M**2
        """Skin area of each raster point [m^2], shape (ny nx,)."""
        half = 0.5 * np.asarray(exam.region_m)
        self._examined = (np.abs(self.raster - exam.centre_m) <= half).all(axis=1).reshape(xx.shape)
        self.lumps = tuple(self._lump(between(np.log(pressed.force / alone))) for alone in pressed.alone)
        guard = np.nan_to_num(between(np.log(pressed.force / pressed.relaxed))(self.raster)).reshape(xx.shape)
        self.guarded: Mask = guard >= max(0.5 * float(guard.max()), PALPABLE)
        """Mask of guarding: at least half of its maximum effect, shape (ny, nx)."""
        changed = np.abs(np.nan_to_num(between(np.log(pressed.force / pressed.plain))(self.raster)).reshape(xx.shape))
        parts, count = label(changed >= PALPABLE)
        maxima = np.append(np.inf, maximum(changed, parts, np.arange(1, count + 1)))
        self.structured: Mask = changed >= 0.5 * maxima[parts]
        """Mask of structures: at least half of the maximum effect of each connected one that is palpable, shape (ny, nx)."""

    def force(self, xy: Array) -> Array:
        """Return apparent stiffness [N] at points [m], shape (p, 2) -> (p,); NaN outside the pressed places."""
        return np.asarray(np.exp(self._force(xy)))

    def limited(self, xy: Array) -> Mask:
        """Return True where the press ended at its limit, so `force` is a lower bound, shape (p,)."""
        return np.asarray(np.nan_to_num(self._limited(xy)) > 0.5)

    def excess(self, xy: Array) -> Array:
        """Return e of all lumps together at points, shape (p,); NaN outside the pressed places."""
        return np.asarray(self._excess(xy))

    def inside(self, area: Mask, xy: Array) -> Mask:
        """Return True for points [m], shape (p, 2), in an area of the raster, shape (p,)."""
        j = np.floor((xy[:, 1] - self._y[0]) / RASTER_M + 0.5).astype(np.intp)
        i = np.floor((xy[:, 0] - self._x[0]) / RASTER_M + 0.5).astype(np.intp)
        there = (i >= 0) & (i < len(self._x)) & (j >= 0) & (j < len(self._y))
        found = np.zeros(len(xy), dtype=bool)
        found[there] = area[j[there], i[there]]
        return found

    def in_lump(self, xy: Array) -> Mask:
        """Return True for points [m], shape (p, 2), in the area of any lump, shape (p,)."""
        found = np.zeros(len(xy), dtype=bool)
        for lump in self.lumps:
            found |= self.inside(lump.inside, xy)
        return found

    def _lump(self, excess: LinearNDInterpolator) -> Lump:
        e = np.nan_to_num(excess(self.raster)).reshape(self._examined.shape)
        peak = int(np.argmax(np.abs(e) * self._examined))
        extreme = float(e.ravel()[peak])
        if abs(extreme) < PALPABLE:
            return Lump(False, float(np.exp(extreme)), self.raster[peak], 0.0, np.zeros(e.shape, dtype=bool))
        parts, _ = label(e * np.sign(extreme) >= 0.5 * abs(extreme))
        inside = parts == parts.ravel()[peak]
        weight = self.cells * inside.ravel()
        area = float(weight.sum())
        return Lump(True, float(np.exp(extreme)), weight @ self.raster / area, area, inside)
