"""Errors of the camera: noise, bias, lost pixels."""

from typing import Any

import numpy as np
import pytest

from palpate_bus.messages import MS, CameraTrigger, header
from palpate_bus.messages.geometry import mesh_message
from palpate_bus.testing import HandInbox
from palpate_camera.backends.kinect.errors import (
    BASELINE_M,
    DISPARITY_STEP_PX,
    DepthBias,
    KinectNoise,
    axial_sigma,
    field,
    lateral_sigma,
)
from palpate_camera.backends.kinect.scene import View
from palpate_camera.backends.kinect.service import CameraService
from palpate_camera.messages import Pinhole
from palpate_models.scenario.errors import CameraErrors, DrawnCamera, Errors, draw_errors
from palpate_models.scenario.load import plant_input
from palpate_models.scenario.schema import Camera, Scenario

FOCAL = 585.0
SHAPE = (240, 320)


def plane(z: float, tilt: float = 0.0) -> View:
    """Return a view whose every pixel sees the same: a plane at depth `z` [m], tilted [rad] about the image's v axis."""
    view = View.empty(*SHAPE)
    view.w[:] = 1 / z
    view.gu[:] = np.tan(tilt) / (z * FOCAL)
    view.cos[:] = np.cos(tilt)
    return view


def noise(scale: float = 1.0, seed: int = 3) -> KinectNoise:
    return KinectNoise(FOCAL, scale, np.random.default_rng(seed))


NONE = np.zeros(SHAPE, np.float32)
"""No bias."""


def step(z: float, scale: float = 1.0) -> float:
    """Depth of a disparity step [m]."""
    return scale * DISPARITY_STEP_PX * z**2 / (FOCAL * BASELINE_M)


@pytest.mark.parametrize("z", [0.6, 1.0, 1.5, 2.5])
def test_axial_noise_and_rounding_have_the_models_variance(z: float) -> None:
    image = noise().image(plane(z), NONE)
    model = np.sqrt(float(axial_sigma(np.float32(z), np.float32(0))) ** 2 + step(z) ** 2 / 12)
    assert np.std(image, dtype=np.float64) == pytest.approx(model, rel=0.03)


@pytest.mark.parametrize("degrees", [30.0, 50.0])
def test_lateral_jitter_shows_on_a_slope(degrees: float) -> None:
    tilt = np.deg2rad(degrees)
    view = plane(1.0, tilt)
    view.w[:] += view.gu * (np.arange(SHAPE[1]) - SHAPE[1] / 2)
    z = 1 / view.w
    image = noise().image(view, NONE)
    lateral = z**2 * view.gu * lateral_sigma(np.full(SHAPE, tilt, np.float32))
    model = np.sqrt(axial_sigma(z, np.full(SHAPE, tilt, np.float32)) ** 2 + lateral**2 + step(z) ** 2 / 12)
    inner = np.s_[:, 8:-8]  # jitter stays in the image
    assert np.std(((image - z) / model)[inner], dtype=np.float64) == pytest.approx(1, rel=0.03)
    assert np.mean(lateral / model) > 0.3  # so that the test would notice its absence


@pytest.mark.parametrize(("degrees", "lost"), [(60.0, 0.0), (77.5, 0.5), (86.0, 1.0), (90.0, 1.0)])
def test_grazing_pixels_are_lost(degrees: float, lost: float) -> None:
    view = plane(1.0)
    view.cos[:] = np.cos(np.deg2rad(degrees))
    assert np.isnan(noise().image(view, NONE)).mean() == pytest.approx(lost, abs=0.02)


def test_jitter_at_an_edge_sees_near_or_far_and_nothing_between() -> None:
    view = plane(1.0)
    view.w[:, 160:] = 1 / 1.5
    image = noise().image(view, NONE)
    column = image[:, 159]
    far = (column > 1.25).mean()
    assert 0.15 < far < 0.4  # P(jitter of 0.8 px rounds to one pixel to the right) = 0.27
    assert not ((image > 1.03) & (image < 1.45)).any()


def test_without_noise_depth_is_exact_even_at_grazing_angles() -> None:
    view = plane(1.234)
    view.cos[:] = 0.01
    np.testing.assert_allclose(noise(0.0).image(view, NONE), 1.234, rtol=1e-6)


@pytest.mark.parametrize("scale", [0.0, 1.0])
def test_void_and_out_of_range_are_nan(scale: float) -> None:
    view = plane(1.0)
    view.w[:40] = 0
    view.w[40:80] = 1 / 0.3
    view.w[80:120] = 1 / 6.0
    image = noise(scale).image(view, NONE)
    assert np.isnan(image[:34]).all()
    assert np.isnan(image[46:114]).all()
    assert np.isfinite(image[126:]).all()


def test_the_same_seed_gives_the_same_bits_and_frames_differ() -> None:
    one, two, other = noise(seed=7), noise(seed=7), noise(seed=8)
    view = plane(1.0)
    first = one.image(view, NONE)
    assert first.tobytes() == two.image(view, NONE).tobytes()
    assert first.tobytes() != one.image(view, NONE).tobytes()
    assert first.tobytes() != other.image(view, NONE).tobytes()


PINHOLE = Pinhole.of(Camera())
BIAS_SHAPE = (PINHOLE.height, PINHOLE.width)
NO_SKIN = np.zeros(BIAS_SHAPE, bool)


def errors(**given: float) -> Errors:
    return Errors(level="none", camera=CameraErrors(**given))


def drawn(seed: int = 0, **given: float) -> DrawnCamera:
    return draw_errors(errors(**given), seed).camera


def bias(seed: int = 0, **given: float) -> DepthBias:
    return DepthBias(PINHOLE, drawn(seed, **given), np.random.default_rng(seed))


def photograph(frames: int = 1, seed: int = 0, **given: float) -> np.ndarray:
    """Depth images [m] of a flat patient on the table without noise, shape (frames, height, width)."""
    case = Scenario(seed=seed, errors=errors(noise_scale=0.0, **given))
    camera, inbox = CameraService(plant_input(case)), HandInbox()
    vertices = ((0.41, -0.15, 0.9), (0.71, -0.15, 0.9), (0.71, 0.15, 0.9), (0.41, 0.15, 0.9))
    surface = mesh_message(header(0, "world"), vertices, triangles=(0, 1, 2, 0, 2, 3))
    inbox.receive({"sim/surface": surface, "planning/camera_trigger": CameraTrigger(header(0), frames)})
    sent: list[Any] = [camera.step(0, inbox)]
    sent += [camera.step(k * 100 * MS, inbox.receive({})) for k in range(1, frames)]
    return np.array([np.frombuffer(out["camera/depth/image_raw"].data, "<f4").reshape(BIAS_SHAPE) for out in sent])


def test_a_unit_is_off_by_its_own_constant() -> None:
    one, other = (photograph(seed=seed, offset_m=0.02)[0] - photograph()[0] for seed in (1, 2))
    np.testing.assert_allclose(one[np.isfinite(one)], drawn(1, offset_m=0.02).offset_m, atol=1e-6)
    assert abs(np.nanmean(one) - np.nanmean(other)) > 1e-3


def test_the_field_is_smooth_and_as_large_as_is_said() -> None:
    waves = field(drawn(3, field_m=0.003), BIAS_SHAPE)
    assert np.abs(waves).max() == pytest.approx(0.003)
    assert abs(waves.mean()) < 1e-9
    assert np.abs(np.diff(waves, axis=1)).max() < 0.003 / 20
    np.testing.assert_allclose(bias(3, field_m=0.003).image(0.0, NO_SKIN), waves, atol=1e-7)


def test_skin_is_too_far_and_the_table_is_not() -> None:
    off = photograph(skin_m=0.01)[0] - photograph()[0]
    middle = BIAS_SHAPE[0] // 2, BIAS_SHAPE[1] // 2
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
    near, far = (np.mean(images[..., px:] * images[..., :-px]) / np.mean(images**2) for px in (2, 60))
    assert near > 0.9
    assert abs(far) < 0.05


def test_frames_share_the_wander_for_its_time_and_the_mean_of_many_keeps_it() -> None:
    camera = bias(1, wander_m=0.001, wander_s=5.0)
    images = np.array([camera.image(0.1 * k, NO_SKIN) for k in range(400)])
    kept = [np.mean(images[frames:] * images[:-frames]) / np.mean(images**2) for frames in (1, 50)]
    np.testing.assert_allclose(kept, np.exp(np.array((-0.02, -1.0))), atol=0.1)
    assert images[:20].mean(axis=0).std() > 0.85e-3
    assert bias(1, wander_m=0.001, wander_s=1e-3).image(0.1, NO_SKIN).std() == pytest.approx(1e-3, rel=0.1)


def test_lost_patches_have_no_depth_and_stay() -> None:
    given = drawn(2, lost_patches=40.0, lost_px=10.0)
    frames = photograph(3, seed=2, lost_patches=40.0, lost_px=10.0)
    seen = np.isfinite(photograph()[0])
    gone = np.isnan(frames) & seen
    assert (gone == gone[0]).all()
    assert len(given.lost) > 20
    mask = bias(2, lost_patches=40.0, lost_px=10.0).lost
    assert mask.sum() == pytest.approx(np.pi * np.sum(given.lost[:, 2] ** 2), rel=0.25)
    np.testing.assert_array_equal(gone[0], mask & seen)
    for right, down, _ in given.lost:
        v, u = min(int(down * BIAS_SHAPE[0]), BIAS_SHAPE[0] - 1), min(int(right * BIAS_SHAPE[1]), BIAS_SHAPE[1] - 1)
        assert np.isnan(frames[0, v, u])
