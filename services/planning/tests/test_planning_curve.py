"""Curves at one point, against scipy's own evaluation."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from palpate_planning.curve import Curve, polynomial_at


def test_values_and_tangents_are_scipys_to_the_bit() -> None:
    rng = np.random.default_rng(5)
    for n in (2, 3, 40):
        s, samples = np.cumsum(rng.uniform(0.01, 0.1, n)), rng.normal(size=(n, 16))
        curve, spline = Curve(s, samples), CubicSpline(s, samples, bc_type="natural")
        y, dy = np.empty(16), np.empty(16)
        for at in (*s.tolist(), *rng.uniform(s[0], s[-1], 100).tolist()):
            polynomial_at(curve.knots, curve.cubics, at, y)
            polynomial_at(curve.knots, curve.tangents, at, dy)
            assert y.tolist() == spline(at).tolist()
            assert dy.tolist() == spline.derivative()(at).tolist()
