"""Fusion of frames: noise, rounding, outliers, invalid pixels, motion."""

from __future__ import annotations

import numpy as np
import pytest

from palpate_perception.fusion import DepthFusion, frame_sigma

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
    fused = fuse(frames(truth, 20)).fused()
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
    fused = fuse(images).fused()
    assert np.mean(np.abs(fused.depth - 1.1) < 3e-3) > 0.97
    assert fused.depth.mean() == pytest.approx(1.1, abs=3e-3)


def test_invalid_pixels_do_not_count_and_never_valid_ones_stay_invalid() -> None:
    images = frames(np.full(SHAPE, 1.1), 10)
    for image in images[:9]:
        image[0] = np.nan
    for image in images:
        image[1] = np.nan
    fused = fuse(images).fused()
    np.testing.assert_array_equal(fused.depth[0], images[9][0])
    assert np.isnan(fused.depth[1]).all()
    assert np.isnan(fused.sigma[1]).all()
    assert np.isfinite(fused.depth[2:]).all()
    assert (fused.sigma[0] > 2 * fused.sigma[2:].mean()).all()


def test_only_the_window_is_kept() -> None:
    fusion = DepthFusion((slice(3, 8), slice(10, 20)))
    image = np.arange(SHAPE[0] * SHAPE[1], dtype=np.float32).reshape(SHAPE)
    fusion.add(image)
    np.testing.assert_array_equal(fusion.fused().depth, image[3:8, 10:20])


def test_a_breathing_surface_shows_as_motion_and_noise_does_not() -> None:
    truth = np.full(SHAPE, 1.1)
    still = frames(truth, 20)
    swing = 5e-3 * np.sin(2 * np.pi * np.arange(20) * 0.1 / 2.0)
    moving = [(image + offset).astype(np.float32) for image, offset in zip(still, swing, strict=True)]
    pixel = np.argwhere(np.ones(SHAPE, bool))
    quiet, breathing = fuse(still), fuse(moving)
    assert quiet.motion(quiet.fused().depth, pixel) < 1e-4
    assert breathing.motion(breathing.fused().depth, pixel) == pytest.approx(np.std(swing), rel=0.05)


def test_errors_name_what_is_wrong() -> None:
    with pytest.raises(ValueError, match="no depth frame"):
        DepthFusion(WHOLE).fused()
    fusion = fuse([np.ones(SHAPE, np.float32)])
    with pytest.raises(ValueError, match="previous frames had"):
        fusion.add(np.ones((5, 5), np.float32))
