"""Shapes in which lumps and ridges are felt."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist
from scipy.special import erfc

from palpate_assessment.standard import LENGTHS
from palpate_models.numerics.frames import Array

_AROUND = np.linspace(0.0, 2 * np.pi, 16, endpoint=False)
"""Directions of the points of a disc's outline [rad]."""


def smooth(a: Array, b: Array, length: float | Array) -> Array:
    """Return the squared-exponential covariance between places a (k, 2) and b (l, 2), shape (k, l)."""
    return np.asarray(np.exp(-0.5 * cdist(a / length, b / length, "sqeuclidean")))


class Bump(NamedTuple):
    """The shape in which a lump is felt: 1 inside, 0 outside, with a soft edge. A ridge is a band about its path."""

    x: float
    y: float
    """Centre [m]."""
    radius: float
    """Radius of a disc, or half-width of a ridge [m]."""
    edge: float = LENGTHS.edge_m
    """Standard deviation of its edge [m]."""
    path: tuple[tuple[float, float], ...] = ()
    """Corners of a ridge's middle line [m]; empty for a disc."""

    @property
    def corners(self) -> Array:
        """Corners of a ridge's middle line, or the centre of a disc [m], shape (k, 2)."""
        return np.array(self.path or ((self.x, self.y),))

    @property
    def length(self) -> float:
        """Length of a ridge's path [m], 0 for a disc."""
        return float(np.linalg.norm(np.diff(self.corners, axis=0), axis=1).sum())

    @property
    def area(self) -> float:
        """Area of the shape [m^2]."""
        return float(np.pi * self.radius**2 + 2 * self.radius * self.length)

    def distance(self, xy: Array) -> Array:
        """Return the distance of places from the centre or the path [m], shape (k, 2) -> (k,)."""
        if not self.path:
            return np.hypot(xy[:, 0] - self.x, xy[:, 1] - self.y)
        corners = self.corners
        start, along = corners[:-1], np.diff(corners, axis=0)
        off = xy[:, None] - start
        length2 = np.maximum((along**2).sum(axis=1), np.finfo(float).tiny)  # a search may bring both ends to one corner
        share = np.clip((off * along).sum(axis=2) / length2, 0.0, 1.0)
        return np.asarray(np.linalg.norm(off - share[:, :, None] * along, axis=2).min(axis=1))

    def __call__(self, xy: Array, beyond: float = 0.0) -> Array:
        """Return the shape at places [m], shape (k, 2) -> (k,), its radius greater by `beyond`."""
        return np.asarray(0.5 * erfc((self.distance(xy) - self.radius - beyond) / (np.sqrt(2) * self.edge)))

    def outline(self) -> Array:
        """Return points of its boundary [m], shape (k, 2): of a disc a circle, of a ridge both sides and the ends."""
        around = self.radius * np.column_stack((np.cos(_AROUND), np.sin(_AROUND)))
        if not self.path:
            return np.asarray(around + self.corners)
        corners = self.corners
        along = np.diff(corners, axis=0) / np.linalg.norm(np.diff(corners, axis=0), axis=1)[:, None]
        aside = self.radius * np.column_stack((-along[:, 1], along[:, 0]))
        middles = 0.5 * (corners[1:] + corners[:-1])
        ends = corners[[0, -1]] + self.radius * along[[0, -1]] * ((-1,), (1,))
        return np.concatenate((middles + aside, middles - aside, corners[1:] + aside, corners[1:] - aside, ends))

    def apart(self, other: Bump) -> float:
        """Return the distance between two bumps over the sum of their radii."""
        return float(self.distance(_fill(other.corners)).min()) / (self.radius + other.radius)


def _fill(corners: Array) -> Array:
    """Return points along a path, shape (k, 2)."""
    if len(corners) < 2:
        return corners
    share = np.linspace(0.0, 1.0, 8)[:, None]
    return np.concatenate([a + share * (b - a) for a, b in pairwise(corners)])


def ridge(corners: Array, radius: float, edge: float) -> Bump:
    """Return the ridge about a path, shape (k, 2) [m]."""
    x, y = _fill(corners).mean(axis=0)
    return Bump(float(x), float(y), radius, edge, tuple((float(a), float(b)) for a, b in corners))
