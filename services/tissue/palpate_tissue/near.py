"""The vertices of the skin that a sphere might touch while it stays near a place."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate_models.numerics.frames import Array

RIM = 0.2
"""Vertices are held by the sphere where its surface makes less than 78 degrees with the tangent plane (cos > 0.2)."""
_REACH_M = 0.030
"""Least depth of the sphere's centre below the rest surface at which the vertices found are still all that it might touch."""


class Near(NamedTuple):
    """Vertices that a sphere might touch while its centre stays near `origin`; m of them."""

    origin: list[float]
    """[m], three of them."""
    reach: float
    """How far the centre may go from there [m]."""
    radius: float
    """Radius of the sphere [m]."""
    vertex: NDArray[np.intp]
    """Which of the vertices searched, ascending, shape (m,)."""
    n: Array
    """Their outward normals, shape (m, 3)."""
    X: Array
    """Their positions from `origin` [m], shape (m, 3)."""

    def holds(self, p: list[float], radius: float) -> bool:
        """Whether this is still all that a sphere of `radius` [m] at `p` [m] might touch."""
        return radius == self.radius and math.dist(p, self.origin) <= self.reach


class VertexSearch:
    """Finds the vertices near a sphere among some at rest. Everything is in A."""

    def __init__(self, vertices: Array, normals: Array, excursion: float, margin: float) -> None:
        """`vertices` [m] and outward `normals`, shape (n, 3); the largest breathing `excursion` [m].

        The centre may move by `margin` [m] before they have to be searched again.
        """
        self._vertices, self._normals = vertices, normals
        self._tree = cKDTree(vertices)
        self._excursion, self._margin = excursion, margin

    def around(self, p: list[float], radius: float, deepest: float) -> Near:
        """What a sphere of `radius` [m] near `p` [m] might touch, where the skin is displaced by at most `deepest` [m]."""
        ball = math.hypot(radius, max(_REACH_M, deepest + 0.01)) + self._excursion + self._margin
        distance, nearest = self._tree.query(p)
        index = np.sort(np.asarray(self._tree.query_ball_point(p, ball), dtype=np.intp))
        n, X = self._normals[index], self._vertices[index] - p
        height = (n * X).sum(axis=1)
        lateral = np.linalg.norm(X - height[:, None] * n, axis=1)
        facing = n @ self._normals[nearest] > 0  # not the far side of something thin
        keep = (lateral < radius + self._margin) & facing
        return Near(p, max(self._margin, float(distance) - ball), radius, index[keep], n[keep], X[keep])
