"""Points from depth images, and the pattern of targets."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate_models.numerics.frames import apply, inverse, look_at
from palpate_models.scenario.schema import Exam
from palpate_perception import cloud
from palpate_perception.cloud import Cloud, RegionBox

K = np.array([[585.0, 0.0, 319.5], [0.0, 580.0, 239.5], [0.0, 0.0, 1.0]])
X_WA = np.eye(4)
X_WA[:3, 3] = 0.56, 0.0, 0.93
X_WC = look_at(np.array([0.95, -0.45, 1.85]), np.array([0.56, 0.0, 0.9]))
BOX = RegionBox.of(Exam(), 0.03, (-0.16, 0.06))

coordinate = st.floats(-0.3, 0.3)


@settings(deadline=None)
@given(st.tuples(coordinate, coordinate, st.floats(0.5, 4.0)), st.integers(0, 200), st.integers(0, 200))
def test_projection_and_deprojection_are_inverse(p: tuple[float, float, float], row: int, column: int) -> None:
    p_C = np.array([p])
    u, v = cloud.project(p_C, K)
    np.testing.assert_allclose(
        np.stack(((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]), axis=1) * p_C[:, 2:], p_C[:, :2], atol=1e-12
    )
    depth = np.full((3, 4), p[2])
    u, v = cloud.project(cloud.deproject(depth, K, (row, column)).reshape(-1, 3), K)
    rows, columns = np.indices(depth.shape)
    np.testing.assert_allclose(u, columns.ravel() + column, atol=1e-9)
    np.testing.assert_allclose(v, rows.ravel() + row, atol=1e-9)


def test_the_window_holds_the_box_and_not_much_more() -> None:
    rows, columns = cloud.window(BOX, inverse(X_WC) @ X_WA, K, (480, 640))
    p_A = np.random.default_rng(0).uniform(BOX.low, BOX.high, (500, 3))
    u, v = cloud.project(apply(inverse(X_WC) @ X_WA, p_A), K)
    assert ((v >= rows.start) & (v < rows.stop) & (u >= columns.start) & (u < columns.stop)).all()
    assert (rows.stop - rows.start) * (columns.stop - columns.start) < 480 * 640 / 3


def test_the_window_is_empty_when_the_camera_looks_aside_and_whole_when_the_box_surrounds_it() -> None:
    aside = look_at(np.array([0.95, -0.45, 1.85]), np.array([3.0, -2.0, 1.5]))
    rows, columns = cloud.window(BOX, inverse(aside) @ X_WA, K, (480, 640))
    assert (rows.stop - rows.start) * (columns.stop - columns.start) == 0 or (rows, columns) == (slice(0, 480), slice(0, 640))
    inside = look_at(np.array([0.56, 0.0, 0.95]), np.array([0.56, 0.3, 0.9]))
    assert cloud.window(BOX, inverse(inside) @ X_WA, K, (480, 640)) == (slice(0, 480), slice(0, 640))


def organised(depth: np.ndarray) -> Cloud:
    return cloud.to_world(cloud.deproject(depth, K), np.full(depth.shape, 5e-4), X_WC)


def test_step_one_moves_every_point_to_world_and_keeps_the_invalid() -> None:
    depth = np.full((480, 640), 1.0)
    depth[10, 20] = np.nan
    points = organised(depth)
    assert len(points.p_W) == depth.size
    centre = points.p_W[np.all(points.pixel == (240, 320), axis=1)][0]
    assert np.linalg.norm(centre - apply(X_WC, np.array([[0.0, 0.0, 1.0]]))[0]) < 2e-3
    assert np.isnan(points.p_W).any(axis=1).sum() == 1


def test_step_two_drops_exactly_the_invalid() -> None:
    depth = np.full((48, 64), 1.0)
    depth[::3, ::2] = np.nan
    points = cloud.remove_invalid(organised(depth))
    assert len(points.p_W) == np.isfinite(depth).sum()
    assert np.isfinite(depth[tuple(points.pixel.T)]).all()


def test_step_three_keeps_the_box_and_drops_the_table() -> None:
    rng = np.random.default_rng(2)
    p_W = rng.uniform((0.2, -0.4, 0.6), (0.9, 0.4, 1.2), (5000, 3))
    points = Cloud(p_W, np.ones(len(p_W)), np.zeros((len(p_W), 2), np.intp))
    kept = cloud.crop(points, X_WA, BOX, 0.8).p_W
    p_A = kept - X_WA[:3, 3]
    assert len(kept) > 50
    assert (np.abs(p_A[:, :2]) <= 0.13).all()
    assert (p_A[:, 2] <= 0.06).all()
    assert (kept[:, 2] > 0.8).all()
    expected = (np.abs(p_W[:, :2] - X_WA[:2, 3]) <= 0.13).all(axis=1) & (p_W[:, 2] > 0.8) & (p_W[:, 2] <= 0.99)
    assert len(kept) == expected.sum()


def test_what_hovers_above_the_skin_is_on_another_sheet() -> None:
    p_A = np.mgrid[-0.1:0.1:80j, -0.1:0.1:80j].reshape(2, -1).T
    height = -1.5 * np.sum(p_A**2, axis=1)
    hovering = np.all(np.abs(p_A - 0.03) < 0.02, axis=1)
    height[hovering] = 0.04
    depth = 1.0 - height.reshape(80, 80)
    pixel = np.argwhere(np.ones((80, 80), bool))
    points = Cloud(np.column_stack((p_A, height)), np.ones(len(p_A)), pixel)
    kept = cloud.main_sheet(points, depth, np.ones(len(p_A), bool))
    assert len(kept.p_W) == len(p_A) - hovering.sum()
    assert kept.p_W[:, 2].max() < 0.01


def test_the_sheet_in_the_region_wins_over_a_larger_one_in_the_margin() -> None:
    depth = np.full((20, 50), 1.0)
    depth[:, :15] = 0.9
    pixel = np.argwhere(np.ones(depth.shape, bool))
    points = Cloud(np.column_stack((pixel, depth.ravel())), np.ones(depth.size), pixel)
    kept = cloud.main_sheet(points, depth, pixel[:, 1] < 15)
    assert set(kept.p_W[:, 2]) == {0.9}


def test_no_points_are_no_sheet() -> None:
    empty = Cloud(np.empty((0, 3)), np.empty(0), np.empty((0, 2), np.intp))
    assert len(cloud.main_sheet(empty, np.ones((4, 4)), np.empty(0, bool)).p_W) == 0


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
