"""The camera's systematic errors: each is in the image by the size that was drawn, and stays when frames are averaged."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from palpate_bus.contract import MS
from palpate_bus.messages import CameraTrigger, SurfaceMesh
from palpate_bus.messages.stamps import header
from palpate_bus.testing.hand_inbox import HandInbox
from palpate_camera.backends.kinect.errors import DepthBias, field
from palpate_camera.backends.kinect.service import CameraService
from palpate_camera.messages import Pinhole
from palpate_models.scenario.errors import CameraErrors, DrawnCamera, Errors, draw_errors
from palpate_models.scenario.load import plant_input
from palpate_models.scenario.schema import Camera, Scenario

PINHOLE = Pinhole.of(Camera())
SHAPE = (PINHOLE.height, PINHOLE.width)
NO_SKIN = np.zeros(SHAPE, bool)
QUIET = {"noise_scale": 0.0}


def drawn(seed: int = 0, **given: float) -> DrawnCamera:
    return draw_errors(Errors(level="none", camera=CameraErrors(**given)), seed).camera


def bias(seed: int = 0, **given: float) -> DepthBias:
    return DepthBias(PINHOLE, drawn(seed, **given), np.random.default_rng(seed))


def photograph(frames: int = 1, seed: int = 0, **given: float) -> np.ndarray:
    """Depth images [m] of a flat patient on the table, shape (frames, height, width)."""
    errors = Errors(level="none", camera=CameraErrors(**given))
    camera, inbox = CameraService(plant_input(Scenario(seed=seed, errors=errors))), HandInbox()
    vertices = np.array([(0.41, -0.15, 0.9), (0.71, -0.15, 0.9), (0.71, 0.15, 0.9), (0.41, 0.15, 0.9)], np.float32)
    surface = SurfaceMesh(
        header(0, "world"), vertices.ravel(), np.empty(0, np.float32), np.uint32([0, 1, 2, 0, 2, 3]), np.empty(0, np.float32)
    )
    inbox.receive({"sim/surface": surface, "planning/camera_trigger": CameraTrigger(header(0), frames)})
    sent: list[Any] = [camera.step(0, inbox)]
    sent += [camera.step(k * 100 * MS, inbox.receive({})) for k in range(1, frames)]
    return np.array([np.frombuffer(out["camera/depth/image_raw"].data, "<f4").reshape(SHAPE) for out in sent])


def test_without_errors_there_is_none() -> None:
    assert not bias().image(3.0, ~NO_SKIN).any()
    assert not bias().lost.any()


def test_a_unit_is_off_by_its_own_constant() -> None:
    one, other = (photograph(seed=seed, noise_scale=0.0, offset_m=0.02)[0] - photograph(**QUIET)[0] for seed in (1, 2))
    np.testing.assert_allclose(one[np.isfinite(one)], drawn(1, offset_m=0.02).offset_m, atol=1e-6)
    assert abs(np.nanmean(one) - np.nanmean(other)) > 1e-3


def test_the_field_is_smooth_and_as_large_as_is_said() -> None:
    waves = field(drawn(3, field_m=0.003), SHAPE)
    assert np.abs(waves).max() == pytest.approx(0.003)
    assert abs(waves.mean()) < 1e-9
    assert np.abs(np.diff(waves, axis=1)).max() < 0.003 / 20
    np.testing.assert_allclose(bias(3, field_m=0.003).image(0.0, NO_SKIN), waves, atol=1e-7)


def test_skin_is_too_far_and_the_table_is_not() -> None:
    off = photograph(noise_scale=0.0, skin_m=0.01)[0] - photograph(**QUIET)[0]
    middle = SHAPE[0] // 2, SHAPE[1] // 2
    assert off[middle] == pytest.approx(0.01, abs=1e-6)
    shares = [np.mean(np.isclose(off[np.isfinite(off)], value, atol=1e-6)) for value in (0.01, 0.0)]
    assert sum(shares) == pytest.approx(1.0)
    assert min(shares) > 0.05


def test_depth_moves_while_the_camera_warms_up() -> None:
    camera, end = bias(4, warm_up_m=0.005, warm_up_s=100.0), drawn(4, warm_up_m=0.005).warm_up_m
    found = [float(camera.image(t, NO_SKIN)[0, 0]) for t in (0.0, 100.0, 1000.0)]
    np.testing.assert_allclose(found, end * (1 - np.exp(np.array((0.0, -1.0, -10.0)))), atol=1e-6)
    assert abs(end) > 1e-4


def test_the_wander_has_its_size_everywhere_and_neighbours_share_it() -> None:
    images = np.array([bias(seed, wander_m=0.001, wander_px=20.0).image(0.0, NO_SKIN) for seed in range(60)])
    spread = images.std(axis=0)
    assert spread.mean() == pytest.approx(0.001, rel=0.05)
    assert spread[::10].mean() == pytest.approx(spread[5::10].mean(), rel=0.05)

    def shared(px: int) -> float:
        return float(np.mean(images[..., px:] * images[..., :-px]) / np.mean(images**2))

    assert shared(2) > 0.9
    assert abs(shared(60)) < 0.05


def test_frames_share_the_wander_for_its_time_and_the_mean_of_many_keeps_it() -> None:
    camera = bias(1, wander_m=0.001, wander_s=5.0)
    images = np.array([camera.image(0.1 * k, NO_SKIN) for k in range(400)])

    def shared(frames: int) -> float:
        return float(np.mean(images[frames:] * images[:-frames]) / np.mean(images**2))

    np.testing.assert_allclose([shared(1), shared(50)], np.exp(np.array((-0.02, -1.0))), atol=0.1)
    assert images[:20].mean(axis=0).std() > 0.85e-3
    assert bias(1, wander_m=0.001, wander_s=1e-3).image(0.1, NO_SKIN).std() == pytest.approx(1e-3, rel=0.1)


def test_averaged_frames_keep_what_they_share_and_lose_white_noise() -> None:
    truth = photograph(**QUIET)[0]
    white, shared = (
        np.nanstd((np.nanmean(photograph(16, wander_m=size), axis=0) - truth)[220:260, 300:340]) for size in (0.0, 0.005)
    )
    assert white < 0.0012
    assert shared > 0.0025


def test_lost_patches_have_no_depth_and_stay() -> None:
    given = drawn(2, lost_patches=40.0, lost_px=10.0)
    frames = photograph(3, seed=2, noise_scale=0.0, lost_patches=40.0, lost_px=10.0)
    gone = np.isnan(frames) & np.isfinite(photograph(**QUIET)[0])
    assert (gone == gone[0]).all()
    assert len(given.lost) > 20
    mask = bias(2, lost_patches=40.0, lost_px=10.0).lost
    assert mask.sum() == pytest.approx(np.pi * np.sum(given.lost[:, 2] ** 2), rel=0.25)
    np.testing.assert_array_equal(gone[0], mask & np.isfinite(photograph(**QUIET)[0]))
    for right, down, _ in given.lost:
        v, u = min(int(down * SHAPE[0]), SHAPE[0] - 1), min(int(right * SHAPE[1]), SHAPE[1] - 1)
        assert np.isnan(frames[0, v, u])
