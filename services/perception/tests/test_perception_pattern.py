"""Step 4: which cells of the lattice, and of the targets, the cloud has points in."""

from __future__ import annotations

import numpy as np

from palpate_perception import cloud


def test_down_sampling_gives_one_node_a_cell_and_says_which_have_no_points() -> None:
    x, y = np.linspace(-0.1, 0.1, 5), np.linspace(-0.05, 0.05, 3)
    rng = np.random.default_rng(0)
    p = np.column_stack((rng.uniform(-0.12, 0.12, 4000), rng.uniform(-0.08, 0.08, 4000), np.zeros(4000)))
    hole = np.hypot(p[:, 0] - 0.05, p[:, 1]) < 0.04
    nodes, known = cloud.downsample(p[~hole], x, y)
    assert nodes.shape == (15, 2)
    np.testing.assert_allclose(nodes[:3], [(-0.1, -0.05), (-0.1, 0.0), (-0.1, 0.05)])
    np.testing.assert_allclose(nodes[~known], [(0.05, 0.0)], atol=1e-12)
    assert (cloud.supported(p[~hole], nodes, 0.05) == known).all()
