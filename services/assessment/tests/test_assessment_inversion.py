"""The inversion against fields that are known: no tissue, forces made from the footprint model itself or drawn from the prior."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from assessment_samples import CONTACT, flat_grid, samples_of

from palpate_assessment.inversion import Noise, estimate_noise, invert, observe, spread_under
from palpate_assessment.prior import BACKGROUND, HEALTHY, LESION, Field

MEAN = float(np.log(CONTACT.material.k_w_n_per_m3))
QUIET = Noise(depth_white=1e-5, depth_smooth=1e-5, depth_common=1e-5, model_common=1e-3, model_white=2e-3, model_edge=0.0)


def draw(grid, components, rng) -> np.ndarray:
    """A field of log k_w from the prior."""
    field = Field(grid, components)
    covariance = field.times(np.eye(grid.z.size)) + 1e-9 * np.eye(grid.z.size)
    return MEAN + np.linalg.cholesky(covariance) @ rng.standard_normal(grid.z.size)


def test_a_uniform_wall_comes_back_as_it_is() -> None:
    grid = flat_grid()
    z = np.full(grid.z.size, np.log(2.5e5))
    posterior = invert(observe(samples_of(grid, z), grid, CONTACT, QUIET), Field(grid, HEALTHY), MEAN)
    inside = np.abs(grid.nodes[:, :2]).max(axis=1) < 0.05
    assert np.exp(posterior.mean[inside]) == pytest.approx(2.5e5, rel=0.01)


@pytest.mark.parametrize("depth", [0.006, 0.010, 0.014])
def test_stiffness_does_not_depend_on_the_depth_at_which_it_is_felt(depth: float) -> None:
    grid = flat_grid()
    z = np.full(grid.z.size, np.log(2.5e5))
    samples = samples_of(grid, z, depth=depth)
    posterior = invert(observe(samples, grid, CONTACT, QUIET), Field(grid, HEALTHY), MEAN)
    assert np.exp(np.median(posterior.mean)) == pytest.approx(2.5e5, rel=0.01)


def test_an_edge_is_sharper_than_the_indenter_feels_it() -> None:
    grid = flat_grid()
    step = grid.nodes[:, 0] > 0
    z = MEAN + np.where(step, np.log(4.0), 0.0)
    observations = observe(samples_of(grid, z), grid, CONTACT, QUIET)
    posterior = invert(observations, Field(grid, HEALTHY) + Field(grid, LESION), MEAN)
    felt = observations.footprint @ np.exp(z)
    row = np.abs(grid.nodes[:, 1]) < 0.02
    error = np.abs(np.exp(posterior.mean) - np.exp(z))[row & (np.abs(grid.nodes[:, 0]) < 0.02)].mean()
    places = np.array([s.position for s in samples_of(grid, z)])
    near = (np.abs(places[:, 1]) < 0.02) & (np.abs(places[:, 0]) < 0.02)
    truth_there = np.where(places[:, 0] > 0, 4.0, 1.0) * np.exp(MEAN)
    blur = np.abs(felt - truth_there)[near].mean()
    assert error < 0.6 * blur


def test_the_band_holds_the_truth_as_often_as_it_says() -> None:
    """Fields drawn from the prior, noise drawn from the noise model: coverage of the 90 % band must be 90 %."""
    grid = flat_grid()
    noise = Noise(depth_common=1e-5, model_common=1e-3, model_edge=0.0)
    holds = []
    for seed in range(8):
        rng = np.random.Generator(np.random.PCG64(seed))
        z = draw(grid, (BACKGROUND, *LESION[1:]), rng)
        clean = samples_of(grid, z)
        observations = observe(clean, grid, CONTACT, noise)
        error = np.linalg.cholesky(observations.covariance) @ rng.standard_normal(len(clean))
        noisy = [replace(s, force=s.force * float(np.exp(e))) for s, e in zip(clean, error, strict=True)]
        prior = Field(grid, (BACKGROUND, *LESION[1:]))
        posterior = invert(observe(noisy, grid, CONTACT, noise), prior, MEAN, iterations=12)
        inside = np.abs(grid.nodes[:, :2]).max(axis=1) < 0.05
        holds.append((np.abs(posterior.mean - z) < 1.6449 * posterior.sd_of(np.eye(len(z))))[inside].mean())
    assert 0.85 < np.mean(holds) < 0.95


@pytest.mark.parametrize("smooth", [0.0001, 0.0005])
def test_depth_noise_is_estimated_from_the_samples(smooth: float) -> None:
    grid = flat_grid()
    rng = np.random.Generator(np.random.PCG64(5))
    z = draw(grid, (BACKGROUND,), rng)
    clean = samples_of(grid, z)
    true = Noise(depth_white=5e-5, depth_smooth=smooth, depth_common=1e-6, model_common=1e-4, model_edge=0.0)
    error = np.linalg.cholesky(observe(clean, grid, CONTACT, true).covariance) @ rng.standard_normal(len(clean))
    noisy = [replace(s, force=s.force * float(np.exp(e))) for s, e in zip(clean, error, strict=True)]
    observations = observe(noisy, grid, CONTACT, Noise())
    prior = Field(grid, HEALTHY)
    estimate = estimate_noise(observations, invert(observations, prior, MEAN), prior)
    assert smooth / 2.1 <= estimate.depth_smooth <= 2.1 * smooth


def test_shallow_samples_count_less() -> None:
    grid = flat_grid()
    z = np.full(grid.z.size, MEAN)
    deep, shallow = (observe(samples_of(grid, z, depth=d), grid, CONTACT, Noise()) for d in (0.010, 0.004))
    assert shallow.covariance[0, 0] > 3 * deep.covariance[0, 0]


def test_spread_under_a_footprint_is_that_of_the_wall_there() -> None:
    grid = flat_grid()
    z = MEAN + np.where(grid.nodes[:, 0] > 0, np.log(4.0), 0.0)
    samples = samples_of(grid, z)
    spread = spread_under(observe(samples, grid, CONTACT, Noise()).footprint, z)
    x = np.array([s.position[0] for s in samples])
    assert spread[np.abs(x) < 0.004].min() > 0.5
    assert spread[x < -0.045].max() < 0.05


def test_the_footprint_runs_ahead_of_a_sliding_indenter() -> None:
    grid = flat_grid()
    z = MEAN + np.where(grid.nodes[:, 0] > 0, np.log(4.0), 0.0)
    there, back = (samples_of(grid, z, speed=v) for v in (0.03, -0.03))
    at = int(np.argmin([np.linalg.norm(s.position) for s in there]))
    forth = observe(there, grid, CONTACT, Noise()).footprint[at] @ np.exp(z)
    reverse = observe(back, grid, CONTACT, Noise()).footprint[at] @ np.exp(z)
    assert forth > 1.05 * reverse
