"""The noise against the published model, by statistics over a plane's pixels."""

from __future__ import annotations

import numpy as np
import pytest

from palpate_camera.backends.kinect.errors import (
    BASELINE_M,
    DISPARITY_STEP_PX,
    GRAZING_RAD,
    KinectNoise,
    axial_sigma,
    lateral_sigma,
)
from palpate_camera.backends.kinect.scene import View

FOCAL = 585.0
SHAPE = (240, 320)


def plane(z: float, tilt: float = 0.0) -> View:
    """A view whose every pixel sees the same: a plane at depth `z` [m], tilted [rad] about the image's v axis."""
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


def test_the_published_figures() -> None:
    # Nguyen 2012 at 1 m, head-on: 0.0012 + 0.0019 * 0.36 m, and 0.8 px.
    assert axial_sigma(np.float32(1.0), np.float32(0.0)) == pytest.approx(1.884e-3, rel=1e-4)
    assert lateral_sigma(np.float32(0.0)) == pytest.approx(0.8)
    # Khoshelham 2012: about 2.8 mm a step at 1 m.
    assert step(1.0) == pytest.approx(2.85e-3, rel=0.01)


@pytest.mark.parametrize("z", [0.6, 1.0, 1.5, 2.5])
def test_axial_noise_and_rounding_have_the_models_variance(z: float) -> None:
    image = noise().image(plane(z), NONE)
    model = np.sqrt(float(axial_sigma(np.float32(z), np.float32(0))) ** 2 + step(z) ** 2 / 12)
    assert np.std(image, dtype=np.float64) == pytest.approx(model, rel=0.03)


@pytest.mark.parametrize("z", [0.6, 1.0, 1.5])
def test_the_mean_is_true(z: float) -> None:
    image = noise().image(plane(z), NONE).astype(np.float64)
    assert abs(image.mean() - z) < 5 * image.std() / np.sqrt(image.size) + 0.02 * step(z)


@pytest.mark.parametrize("degrees", [30.0, 50.0])
def test_lateral_jitter_shows_on_a_slope(degrees: float) -> None:
    tilt = np.deg2rad(degrees)
    view = plane(1.0, tilt)
    view.w += view.gu * (np.arange(SHAPE[1]) - SHAPE[1] / 2)
    z = 1 / view.w
    image = noise().image(view, NONE)
    lateral = z**2 * view.gu * lateral_sigma(np.full(SHAPE, tilt, np.float32))
    model = np.sqrt(axial_sigma(z, np.full(SHAPE, tilt, np.float32)) ** 2 + lateral**2 + step(z) ** 2 / 12)
    inner = np.s_[:, 8:-8]  # jitter stays in the image
    assert np.std(((image - z) / model)[inner], dtype=np.float64) == pytest.approx(1, rel=0.03)
    assert np.mean(lateral / model) > 0.3  # so that the test would notice its absence


def test_depth_lies_on_disparity_steps() -> None:
    disparity = FOCAL * BASELINE_M / noise().image(plane(1.1), NONE).astype(np.float64) / DISPARITY_STEP_PX
    np.testing.assert_allclose(disparity, np.rint(disparity), atol=1e-4)


@pytest.mark.parametrize(("degrees", "lost"), [(60.0, 0.0), (77.5, 0.5), (86.0, 1.0), (90.0, 1.0)])
def test_grazing_pixels_are_lost(degrees: float, lost: float) -> None:
    view = plane(1.0)
    view.cos[:] = np.cos(np.deg2rad(degrees))
    assert np.isnan(noise().image(view, NONE)).mean() == pytest.approx(lost, abs=0.02)
    assert np.rad2deg(GRAZING_RAD).tolist() == [70.0, 85.0]


def test_jitter_at_an_edge_sees_near_or_far_and_nothing_between() -> None:
    view = plane(1.0)
    view.w[:, 160:] = 1 / 1.5
    image = noise().image(view, NONE)
    column = image[:, 159]
    far = (column > 1.25).mean()
    assert 0.15 < far < 0.4  # P(jitter of 0.8 px rounds to one pixel to the right) = 0.27
    assert not ((image > 1.03) & (image < 1.45)).any()


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_the_scale_multiplies_the_noise(scale: float) -> None:
    z = 1.0
    image = noise(scale).image(plane(z), NONE)
    model = np.hypot(scale * float(axial_sigma(np.float32(z), np.float32(0))), step(z, scale) / np.sqrt(12))
    assert np.std(image, dtype=np.float64) == pytest.approx(model, rel=0.03)


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
    assert image.dtype == np.float32
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
