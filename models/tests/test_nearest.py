"""The nearest point against scipy's tree."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from palpate_models.numerics.vectors import nearest_vertex


def test_it_is_the_tree_s() -> None:
    rng = np.random.default_rng(2)
    vertices = rng.uniform(-0.2, 0.2, size=(3000, 3))
    tree = cKDTree(vertices)
    for p in rng.uniform(-0.3, 0.3, size=(500, 3)):
        assert nearest_vertex(p, vertices) == tree.query(p)


def test_of_equals_it_is_the_first() -> None:
    assert nearest_vertex(np.zeros(3), np.array(((2.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0)))) == (1.0, 1)
