"""The smoothing spline: what it passes, what it smooths, normals, its own error bars, stray points."""

import numpy as np
import pytest

from palpate_perception import surface
from palpate_perception.surface import TUNING, fit

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


def test_slope_is_continuous_across_knots() -> None:
    field = fit(*points(dome, sigma=6e-4), LOW, HIGH)
    knots = field.x.knots[(field.x.knots > -0.1) & (field.x.knots < 0.1)]
    zero = np.zeros(len(knots))
    np.testing.assert_allclose(field.normal(knots - 1e-9, zero), field.normal(knots + 1e-9, zero), atol=1e-6)


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


def test_gram_matrices_are_exact() -> None:
    axis = surface.KnotAxis(0.0, 1.0, 0.25)
    total = axis.values(np.array([0.3]), 0).sum()
    assert total == pytest.approx(1)
    assert axis.gram(0).sum() == pytest.approx(1)  # the sum of all splines is 1
    for derivative in (1, 2, 3):
        np.testing.assert_allclose(axis.gram(derivative) @ np.ones(axis.size), 0, atol=1e-6)
