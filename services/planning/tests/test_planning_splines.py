"""Compiled splines against scipy's own evaluation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from palpate_planning.wall.surface import BicubicField, CubicPieces, bicubic_at, cubic_at

RNG = np.random.default_rng(5)
KNOTS = np.cumsum(RNG.uniform(0.1, 1.0, 12))
X, Y = np.linspace(-1.0, 2.0, 13), np.linspace(0.0, 1.0, 9)


@pytest.mark.parametrize("s", [KNOTS[0], KNOTS[5], KNOTS[-1], *RNG.uniform(KNOTS[0], KNOTS[-1], 20)])
def test_a_curve_and_its_derivative_are_those_of_scipy(s: float) -> None:
    curve = CubicSpline(KNOTS, RNG.normal(size=(12, 16)), bc_type="natural")
    value, derivative = cubic_at(CubicPieces(curve.x, curve.c), float(s))
    assert value == pytest.approx(curve(s), abs=1e-12)
    assert derivative == pytest.approx(curve(s, 1), abs=1e-11)


@pytest.mark.parametrize(
    "xy", [(-1.0, 0.0), (2.0, 1.0), (0.25, 0.5), (-3.0, 0.4), (5.0, 7.0), *RNG.uniform((-1, 0), (2, 1), (20, 2))]
)
def test_a_field_at_one_point_is_that_of_scipy_at_many(xy: tuple[float, float]) -> None:
    field = BicubicField(X, Y, RNG.normal(size=(13, 9, 3)))
    x, y = map(float, xy)
    assert bicubic_at(field.spline, x, y) == pytest.approx(field(np.array((x, y))), abs=1e-12)


def test_a_field_goes_through_the_values_it_is_made_of() -> None:
    values = RNG.normal(size=(13, 9, 3))
    field = BicubicField(X, Y, values)
    assert bicubic_at(field.spline, float(X[4]), float(Y[7])) == pytest.approx(values[4, 7], abs=1e-12)
