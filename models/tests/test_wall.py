"""The stiffening wall, and the measured curves that it reproduces."""

from hashlib import sha256

import numpy as np
import pytest

from palpate_models.patient import remus2024, wall
from palpate_models.patient.remus2024 import curve, curves, exponent, fitted, relaxed_people

BETAS = (20.0, 77.0, 200.0)


@pytest.mark.parametrize("beta", BETAS)
def test_the_modulus_is_the_derivative_of_the_pressure_and_the_pressure_of_the_energy(beta: float) -> None:
    corner = float(wall.straight_from(np.array(beta)))
    u = np.linspace(-0.5, 3.0, 701) * corner
    du = 1e-6 * corner
    slope = (wall.stress(u + du, beta) - wall.stress(u - du, beta)) / (2 * du)
    np.testing.assert_allclose(slope, wall.slope(u, beta), rtol=1e-5, atol=1e-5)
    stress = (wall.stored_energy(u + du, beta) - wall.stored_energy(u - du, beta)) / (2 * du)
    np.testing.assert_allclose(stress, wall.stress(u, beta), rtol=1e-5, atol=1e-5 * corner)


def test_the_modulus_rises_with_the_square_of_the_depth_up_to_the_cap() -> None:
    u = np.array((-0.01, 0.0, 0.01, 0.02, 1.0))
    np.testing.assert_allclose(wall.slope(u, np.array(100.0)), (0.0, 0.0, 1.0, 4.0, wall.MOST_STIFFENING))
    np.testing.assert_allclose(wall.stress(u, np.array(100.0))[:4], (0.0, 0.0, 0.01 / 3, 0.08 / 3))


def test_the_file_is_as_published() -> None:
    published = "ce9e4039ea5f7d3141c3158c0653dcfb98646cf5b00842fa02357cfa79907e17"
    assert sha256((remus2024.FOLDER / "DataSheet1.csv").read_bytes()).hexdigest() == published
    assert len(curves()) == 154


def test_forces_are_in_newton_at_depths_in_metres() -> None:
    assert float(curve("R3", "rangeMean").force(0.010)) == pytest.approx(2.12, abs=0.005)
    assert float(curve("R1", "rangeMean").force(0.020)) == pytest.approx(8.40, abs=0.005)


@pytest.mark.parametrize("depth", [-1e-6, 0.0357, np.nan])
def test_depths_that_were_not_measured_are_refused(depth: float) -> None:
    with pytest.raises(ValueError, match=r"R1 P01.*0 to 0\.0356 m"):
        curve("R1", "P01").force(np.array((0.01, depth)))


def test_the_relaxed_people_have_the_known_medians() -> None:
    people = relaxed_people()
    assert len(people) == 48
    shallow = [exponent(curve(*place).force((0.005, 0.010))) for place in people]
    deep = [exponent(curve(*place).force((0.010, 0.020))) for place in people]
    assert np.median(shallow) == pytest.approx(1.19, abs=0.005)
    assert np.median(deep) == pytest.approx(1.37, abs=0.005)
    ratios = [fitted()[place].activated_ratio for place in people]
    assert min(ratios) > 1
    assert np.median(ratios) == pytest.approx(2.56, abs=0.05)


def test_every_relaxed_place_is_fitted() -> None:
    assert list(fitted()) == relaxed_people()
    for fit in fitted().values():
        assert 0 <= fit.zero_offset_m <= 0.002
        assert 0.004 < fit.wall.length_m < 0.03
        assert fit.tension > 0
