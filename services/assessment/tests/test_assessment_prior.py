"""The fields of the prior: their factors against the dense covariance that they stand for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from assessment_samples import CONTACT, samples_of

from palpate_assessment.grid import MapGrid, map_grid
from palpate_assessment.inversion import Noise, footprints, invert, observe
from palpate_assessment.prior import HEALTHY, LESION, Component, Field


def oblong() -> MapGrid:
    """A grid whose axes differ: 28 nodes by 19."""
    axis = np.arange(-0.12, 0.1201, 0.005)
    x, y = np.meshgrid(axis, axis)
    return map_grid(np.column_stack((x.ravel(), y.ravel(), np.zeros(x.size))), (0.0, 0.0), (0.12, 0.07), 0.02, 0.006)


def dense(grid: MapGrid, components: tuple[Component, ...], envelope: np.ndarray) -> np.ndarray:
    """The covariance of a field by its definition, shape (n, n)."""
    p = grid.nodes[:, :2]
    squared = ((p[:, None] - p) ** 2).sum(axis=2)
    return envelope[:, None] * envelope * sum(c.sd**2 * np.exp(-0.5 * squared / c.length**2) for c in components)


@pytest.fixture
def case() -> tuple[Field, np.ndarray, np.ndarray]:
    """A field of two parts, its dense covariance, and rows that see a part of the grid, all of it and none."""
    grid = oblong()
    assert grid.z.shape == (19, 28)
    envelope = 0.2 + 0.8 * np.exp(-((grid.nodes[:, 0] - 0.02) ** 2 + grid.nodes[:, 1] ** 2) / 0.02**2)
    covariance = dense(grid, HEALTHY, np.ones(grid.z.size)) + dense(grid, LESION, envelope)
    rows = footprints(samples_of(grid, np.zeros(grid.z.size), region=0.07), grid, CONTACT)
    rng = np.random.Generator(np.random.PCG64(1))
    rows = np.concatenate((rows, rng.standard_normal((3, grid.z.size)), np.zeros((20, grid.z.size))))
    return Field(grid, HEALTHY) + Field(grid, LESION, envelope), covariance, rows


def test_a_field_is_its_covariance(case: tuple[Field, np.ndarray, np.ndarray]) -> None:
    field, covariance, rows = case
    expected = rows @ covariance
    assert np.abs(field.times(rows) - expected).max() < 3e-3 * np.abs(expected).max()


def test_the_factor_gives_what_rows_see_of_a_field(case: tuple[Field, np.ndarray, np.ndarray]) -> None:
    field, _, rows = case
    covariance = field.times(np.eye(rows.shape[1]))
    seen = field.factor(rows)
    assert seen @ seen.T == pytest.approx(rows @ covariance @ rows.T, rel=1e-10, abs=1e-10)
    assert field.unfold(seen) == pytest.approx(rows @ covariance, rel=1e-10, abs=1e-10)


def test_the_posterior_is_that_of_the_dense_formulas() -> None:
    """One step from a constant, where the footprints are the Jacobian: mean and standard deviation by their definitions."""
    grid, mean = oblong(), 12.0
    z = mean + 0.3 * np.sin(40 * grid.nodes[:, 0])
    observations = observe(samples_of(grid, z, region=0.07), grid, CONTACT, Noise())
    observations = replace(observations, value=mean + 0.1 * (observations.value - mean))
    field = Field(grid, HEALTHY) + Field(grid, LESION)
    posterior = invert(observations, field, mean, start=np.full(grid.z.size, mean), iterations=1)
    H, K = observations.footprint, field.times(np.eye(grid.z.size))
    gain = np.linalg.solve(H @ K @ H.T + observations.covariance, H @ K).T
    assert posterior.mean == pytest.approx(mean + gain @ (observations.value - mean), rel=1e-9)
    spread = posterior.sd_of(np.eye(len(K))) ** 2
    assert spread == pytest.approx(np.diag(K) - np.einsum("ij,ji->i", gain, H @ K), rel=1e-6)
    average = np.ones((1, len(K))) / len(K)
    assert posterior.sd_of(average) ** 2 == pytest.approx((K - gain @ H @ K).mean(), rel=1e-6)
