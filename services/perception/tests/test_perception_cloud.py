"""Points from depth images, the pattern of targets, and the surface through the points."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from palpate_models.numerics.frames import look_at
from palpate_models.scenario.schema import Exam
from palpate_perception import cloud
from palpate_perception.cloud import Cloud, RegionBox
from palpate_perception.surface import TUNING, fit

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


def test_a_target_without_a_point_in_its_cell_has_no_support() -> None:
    x, y = np.linspace(-0.1, 0.1, 5), np.linspace(-0.06, 0.06, 3)
    rng = np.random.default_rng(0)
    p = np.column_stack((rng.uniform(-0.12, 0.12, 4000), rng.uniform(-0.08, 0.08, 4000), np.zeros(4000)))
    hole = np.hypot(p[:, 0] - 0.05, p[:, 1]) < 0.04
    nodes = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    known = cloud.find_supported(p[~hole], nodes, np.array((0.05, 0.06)))
    np.testing.assert_allclose(nodes[~known], [(0.05, 0.0)], atol=1e-12)


LOW, HIGH = (-0.13, -0.13), (0.13, 0.13)
RNG = np.random.default_rng


def points(height: object, n: int = 12_000, sigma: float = 0.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = RNG(seed)
    xy = rng.uniform(LOW, HIGH, (n, 2))
    z = height(xy[:, 0], xy[:, 1]) + sigma * rng.standard_normal(n)  # type: ignore[operator]
    return np.column_stack((xy, z)), np.full(n, max(sigma, 5e-4))


def grid(half: float = 0.1, n: int = 41) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.linspace(-half, half, n), np.linspace(-half, half, n), indexing="ij")
    return x.ravel(), y.ravel()


def dome(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.01 - 2.0 * x**2 - 0.9 * y**2 + 0.3 * x * y + 0.05 * x


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_a_quadric_is_reproduced_without_bias() -> None:
    field = fit(*points(dome), LOW, HIGH)
    x, y = grid(0.125)
    np.testing.assert_allclose(field.height(x, y), dome(x, y), atol=2e-7)


@pytest.mark.parametrize(("length", "gain"), [(3 * TUNING.cutoff_m, 1.0), (TUNING.cutoff_m, 0.5), (0.6 * TUNING.cutoff_m, 0.05)])
def test_waves_pass_as_the_cut_off_says(length: float, gain: float) -> None:
    def wave(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 1e-3 * np.sin(2 * np.pi * (x + 0.003) / length)

    field = fit(*points(wave, 40_000), LOW, HIGH)
    x, y = grid(0.08)
    passed = float(field.height(x, y) @ wave(x, y) / (wave(x, y) @ wave(x, y)))
    assert passed == pytest.approx(gain, abs=0.08)


def test_noise_is_reduced_as_the_error_bars_say() -> None:
    x, y = grid()
    errors, bars = [], []
    for seed in range(5):
        field = fit(*points(dome, sigma=6e-4, seed=seed), LOW, HIGH)
        errors.append(field.height(x, y) - dome(x, y))
        bars.append(field.sigma(x, y))
    assert rms(np.array(errors)) < 1e-4
    assert 0.8 < rms(np.array(bars)) / rms(np.array(errors)) < 1.5


def test_error_bars_grow_in_a_gap() -> None:
    p, sigma = points(dome, sigma=6e-4)
    gap = np.hypot(p[:, 0] - 0.04, p[:, 1]) < 0.025
    field = fit(p[~gap], sigma[~gap], LOW, HIGH)
    at = np.array([0.04, -0.06]), np.array([0.0, 0.0])
    in_gap, elsewhere = field.sigma(*at)
    assert in_gap > 3 * elsewhere
    assert abs(field.height(*at)[0] - dome(0.04, 0.0)) < 4 * in_gap


def test_normals_are_unit_outward_and_the_gradient() -> None:
    field = fit(*points(lambda x, y: dome(x, y) + 1e-3 * np.sin(60 * x), sigma=3e-4), LOW, HIGH)
    x, y = grid()
    n = field.normal(x, y)
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1, atol=1e-12)
    assert (n[:, 2] > 0).all()
    h = 1e-6
    slope_x = (field.height(x + h, y) - field.height(x - h, y)) / (2 * h)
    slope_y = (field.height(x, y + h) - field.height(x, y - h)) / (2 * h)
    np.testing.assert_allclose(-n[:, 0] / n[:, 2], slope_x, atol=1e-6)
    np.testing.assert_allclose(-n[:, 1] / n[:, 2], slope_y, atol=1e-6)


def test_stray_points_are_ignored() -> None:
    p, sigma = points(dome, sigma=6e-4)
    stray = RNG(5).random(len(p)) < 0.03
    p[stray, 2] += 0.012
    x, y = grid()
    assert rms(fit(p, sigma, LOW, HIGH).height(x, y) - dome(x, y)) < 1.2e-4


def test_a_sharp_dimple_without_noise_is_not_taken_for_stray_points() -> None:
    def navel(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return dome(x, y) - 5e-3 * np.exp(-(x**2 + y**2) / (2 * 0.01**2))

    x, y = grid()
    assert np.abs(fit(*points(navel), LOW, HIGH).height(x, y) - navel(x, y)).max() < 1e-3


def test_too_few_points_are_an_error() -> None:
    with pytest.raises(ValueError, match="9 points, at least 10"):
        fit(np.zeros((9, 3)), np.ones(9), LOW, HIGH)
