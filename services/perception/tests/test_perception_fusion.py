"""Points from depth images, their fusion, the surface through them, and the pattern of targets."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from palpate_bus.messages.codes import ViewReason
from palpate_models.numerics.frames import apply, inverse, look_at
from palpate_models.scenario.schema import Exam
from palpate_perception import cloud, pipeline
from palpate_perception.cloud import Cloud, DepthFusion, RegionBox, frame_sigma
from palpate_perception.pipeline import PIPELINE, Gaps
from palpate_perception.surface import TUNING, fit

SHAPE = (40, 50)
WHOLE = (slice(0, SHAPE[0]), slice(0, SHAPE[1]))
STEP = 3.4e-3
"""Rounding of a Kinect's depth at 1.1 m [m]."""


def frames(truth: np.ndarray, count: int, seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    noisy = truth + float(frame_sigma(np.float32(1.1))) * rng.standard_normal((count, *truth.shape))
    return list((STEP * np.rint(noisy / STEP)).astype(np.float32))


def fuse(images: list[np.ndarray]) -> DepthFusion:
    fusion = DepthFusion(WHOLE)
    for image in images:
        fusion.add(image)
    return fusion


def test_the_mean_does_not_stick_to_the_steps_of_rounding() -> None:
    truth = np.broadcast_to(np.linspace(1.1, 1.1 + STEP, SHAPE[1]), SHAPE)
    fused = fuse(frames(truth, 20)).fuse()
    error = fused.depth - truth
    assert fused.frames == 20
    assert np.abs(error.mean(axis=0)).max() < 0.4e-3  # no column is drawn to a step
    single = np.sqrt(float(frame_sigma(np.float32(1.1))) ** 2 + STEP**2 / 12)
    assert error.std() == pytest.approx(single / np.sqrt(20), rel=0.1)
    assert np.median(fused.sigma) == pytest.approx(error.std(), rel=0.15)


def test_frames_that_looked_past_an_edge_are_left_out() -> None:
    truth = np.full(SHAPE, 1.1)
    images = frames(truth, 20)
    rng = np.random.default_rng(1)
    for image in images:
        image[rng.random(SHAPE) < 0.25] = 1.4
    fused = fuse(images).fuse()
    assert np.mean(np.abs(fused.depth - 1.1) < 3e-3) > 0.97
    assert fused.depth.mean() == pytest.approx(1.1, abs=3e-3)


@pytest.mark.parametrize(("noise_m", "usable"), [(0.0, True), (0.005, True), (0.04, False)])
def test_frames_of_a_camera_that_only_sends_noise_do_not_agree(noise_m: float, usable: bool) -> None:
    rng = np.random.default_rng(2)
    images = [image + np.float32(noise_m) * rng.standard_normal(SHAPE, np.float32) for image in frames(np.full(SHAPE, 1.1), 10)]
    assert (fuse(images).fuse().agreeing > PIPELINE.min_agreeing) == usable


def test_invalid_pixels_do_not_count_and_never_valid_ones_stay_invalid() -> None:
    images = frames(np.full(SHAPE, 1.1), 10)
    for image in images[:9]:
        image[0] = np.nan
    for image in images:
        image[1] = np.nan
    fused = fuse(images).fuse()
    np.testing.assert_array_equal(fused.depth[0], images[9][0])
    assert np.isnan(fused.depth[1]).all()
    assert np.isnan(fused.sigma[1]).all()
    assert np.isfinite(fused.depth[2:]).all()
    assert (fused.sigma[0] > 2 * fused.sigma[2:].mean()).all()


def test_a_breathing_surface_shows_as_motion_and_noise_does_not() -> None:
    truth = np.full(SHAPE, 1.1)
    still = frames(truth, 20)
    swing = 5e-3 * np.sin(2 * np.pi * np.arange(20) * 0.1 / 2.0)
    moving = [(image + offset).astype(np.float32) for image, offset in zip(still, swing, strict=True)]
    pixel = np.argwhere(np.ones(SHAPE, bool))
    quiet, breathing = fuse(still), fuse(moving)
    assert quiet.motion(quiet.fuse().depth, pixel) < 1e-4
    assert breathing.motion(breathing.fuse().depth, pixel) == pytest.approx(np.std(swing), rel=0.05)


K = np.array([[585.0, 0.0, 319.5], [0.0, 585.0, 239.5], [0.0, 0.0, 1.0]])
X_AC = look_at(np.array([0.4, -0.45, 0.92]), np.array([0.0, 0.0, -0.03]))
X_CA = inverse(X_AC)
SEEN_SHAPE = (480, 640)
EXAM = Exam()


def flat_depth(z: float = 0.0) -> np.ndarray:
    """Depth image of the plane z_A = `z`."""
    direction = cloud.deproject(np.ones(SEEN_SHAPE), K) @ X_AC[:3, :3].T
    return (z - X_AC[2, 3]) / direction[..., 2]


def all_cells() -> np.ndarray:
    xy, _ = pipeline.cells(EXAM)
    return np.column_stack((xy, np.zeros(len(xy))))


def gaps(missing: np.ndarray, depth: np.ndarray) -> Gaps:
    return pipeline.gaps(missing, len(all_cells()), X_CA, K, depth, (0, 0), SEEN_SHAPE)


@pytest.mark.parametrize(
    ("offset", "plane_m", "reason"),
    [
        ((0.0, 0.0, 0.0), 0.3, ViewReason.VIEW_BLOCKED),
        ((0.0, 0.0, -0.06), 0.0, ViewReason.SELF_OCCLUDED),
        ((0.0, 0.0, 0.0), np.nan, ViewReason.NO_DEPTH),
        ((0.0, 0.0, 0.0), -0.2, ViewReason.BEYOND_ABDOMEN),
        ((3.0, 0.0, 0.0), 0.0, ViewReason.OUT_OF_IMAGE),
        ((0.0, 0.0, 0.0), 0.0, ViewReason.TOO_FEW_POINTS),
    ],
)
def test_reason_of_missing_cells(offset: tuple[float, float, float], plane_m: float, reason: ViewReason) -> None:
    found = gaps(all_cells() + np.array(offset), flat_depth(plane_m))
    assert found.reason == reason
    assert found.shares == {reason: 1.0}


def test_obstacle_has_distance_and_share() -> None:
    found = gaps(all_cells()[:120], flat_depth(0.3))
    assert found.shares == {ViewReason.VIEW_BLOCKED: pytest.approx(0.3)}
    assert found.obstacle_m == pytest.approx(0.35, abs=0.05)


def test_largest_gap_comes_first_but_a_blocked_view_is_the_reason() -> None:
    depth = flat_depth()
    u, _ = cloud.project(apply(X_CA, all_cells()), K)
    middle = int(np.quantile(u, 0.7))
    depth[:, :middle] = np.nan
    depth[:, middle:] = flat_depth(0.3)[:, middle:]
    found = gaps(all_cells(), depth)
    assert list(found.shares) == [ViewReason.NO_DEPTH, ViewReason.VIEW_BLOCKED]
    assert found.reason == ViewReason.VIEW_BLOCKED


K_KINECT = np.array([[585.0, 0.0, 319.5], [0.0, 580.0, 239.5], [0.0, 0.0, 1.0]])
X_WA = np.eye(4)
X_WA[:3, 3] = 0.56, 0.0, 0.93
X_WC = look_at(np.array([0.95, -0.45, 1.85]), np.array([0.56, 0.0, 0.9]))
BOX = RegionBox.of(Exam(), 0.03, (-0.16, 0.06))

coordinate = st.floats(-0.3, 0.3)


@settings(deadline=None)
@given(st.tuples(coordinate, coordinate, st.floats(0.5, 4.0)), st.integers(0, 200), st.integers(0, 200))
def test_projection_and_deprojection_are_inverse(p: tuple[float, float, float], row: int, column: int) -> None:
    p_C = np.array([p])
    u, v = cloud.project(p_C, K_KINECT)
    seen = (np.stack((u, v), axis=1) - K_KINECT[:2, 2]) / np.diag(K_KINECT)[:2] * p_C[:, 2:]
    np.testing.assert_allclose(seen, p_C[:, :2], atol=1e-12)
    depth = np.full((3, 4), p[2])
    u, v = cloud.project(cloud.deproject(depth, K_KINECT, (row, column)).reshape(-1, 3), K_KINECT)
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
