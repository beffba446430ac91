"""The stiffening law: its pressure, modulus and energy belong together."""

from __future__ import annotations

import numpy as np
import pytest

from palpate_models.patient import wall

BETAS = (20.0, 77.0, 200.0)


@pytest.mark.parametrize("beta", BETAS)
def test_the_modulus_is_the_derivative_of_the_pressure_and_the_pressure_of_the_energy(beta: float) -> None:
    corner = float(wall.straight_from(np.array(beta)))
    u = np.linspace(-0.5, 3.0, 701) * corner
    du = 1e-6 * corner
    slope = (wall.stress(u + du, beta) - wall.stress(u - du, beta)) / (2 * du)
    np.testing.assert_allclose(slope, wall.slope(u, beta), rtol=1e-5, atol=1e-5)
    stress = (wall.stored(u + du, beta) - wall.stored(u - du, beta)) / (2 * du)
    np.testing.assert_allclose(stress, wall.stress(u, beta), rtol=1e-5, atol=1e-5 * corner)


def test_the_modulus_rises_with_the_square_of_the_depth_up_to_the_cap() -> None:
    u = np.array((-0.01, 0.0, 0.01, 0.02, 1.0))
    np.testing.assert_allclose(wall.slope(u, np.array(100.0)), (0.0, 0.0, 1.0, 4.0, wall.MOST_STIFFENING))
    np.testing.assert_allclose(wall.stress(u, np.array(100.0))[:4], (0.0, 0.0, 0.01 / 3, 0.08 / 3))


def test_a_wall_without_stiffening_has_none() -> None:
    u, none = np.linspace(-0.01, 0.05, 13), np.zeros(13)
    for law in (wall.stress, wall.slope, wall.stored):
        np.testing.assert_array_equal(law(u, none), 0.0)
    np.testing.assert_array_equal(wall.largest_slope(none, none + 1.5), 1.5)
