"""Fusion of depth images and visibility of the wall."""

import numpy as np
import pytest

from palpate_bus.messages.codes import ViewReason
from palpate_models.numerics.frames import apply, inverse, look_at
from palpate_models.scenario.schema import Exam
from palpate_perception import cloud, visibility
from palpate_perception.cloud import DepthFusion, frame_sigma
from palpate_perception.pipeline import PIPELINE
from palpate_perception.visibility import Gaps

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
    xy, _ = visibility.cells(EXAM)
    return np.column_stack((xy, np.zeros(len(xy))))


def gaps(missing: np.ndarray, depth: np.ndarray) -> Gaps:
    return visibility.gaps(missing, len(all_cells()), X_CA, K, depth, (0, 0), SEEN_SHAPE)


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
