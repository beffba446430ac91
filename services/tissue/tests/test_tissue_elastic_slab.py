"""The elastic tier where theory has an answer: a flat half-space under a sphere."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from scipy.optimize import brentq

from palpate_tissue.backends.elastic.slab import FlatSlab, hertz_force

OFFSETS = ((0.0, 0.0), (0.00075, 0.0), (0.0, 0.00087), (0.0004, 0.00025))
"""Where the sphere presses, against the lattice [m]: a result must not depend on it."""


def sphere_force(young_pa: float, poisson: float, radius_m: float, depth_m: float) -> float:
    """Force [N] on a true sphere at depth d in a half-space (Sneddon 1965): Hertz's, less 2 % at d = R/5 and less 6 % at 2R/3.

    d = a/2 ln((R + a)/(R - a)),  F = E / (1 - nu^2) [(a^2 + R^2)/2 ln((R + a)/(R - a)) - a R].
    """

    def depth(a: float) -> float:
        return 0.5 * a * math.log((radius_m + a) / (radius_m - a))

    a = float(brentq(lambda a: depth(a) - depth_m, 0.0, radius_m * (1 - 1e-12), xtol=1e-12))
    return young_pa / (1 - poisson**2) * (0.5 * (a**2 + radius_m**2) * math.log((radius_m + a) / (radius_m - a)) - a * radius_m)


@cache
def slab(edge_m: float = 0.0015, half_m: float = 0.025, thickness_m: float = np.inf) -> FlatSlab:
    return FlatSlab(young_pa=1e4, edge_m=edge_m, half_m=half_m, thickness_m=thickness_m)


@pytest.mark.parametrize("depth", [0.002, 0.003, 0.005, 0.007, 0.010])
@pytest.mark.parametrize("radius", [0.015, 0.020])
def test_a_paraboloid_meets_hertz_and_a_sphere_sneddon(radius: float, depth: float) -> None:
    for xy in OFFSETS:
        s = slab()
        by_hertz = s.press(radius, depth, xy, "paraboloid").force_n / hertz_force(s.young_pa, s.poisson, radius, depth)
        by_sneddon = s.press(radius, depth, xy).force_n / sphere_force(s.young_pa, s.poisson, radius, depth)
        assert by_hertz == pytest.approx(1, abs=0.02)
        assert by_sneddon == pytest.approx(1, abs=0.02)


def test_force_scales_with_radius_and_depth_as_hertz_says() -> None:
    forces = {(r, d): slab().press(r, d, profile="paraboloid").force_n for r in (0.01, 0.04) for d in (0.0025, 0.01)}
    assert forces[0.04, 0.0025] / forces[0.01, 0.0025] == pytest.approx(2, rel=0.02)
    assert forces[0.04, 0.01] / forces[0.04, 0.0025] == pytest.approx(8, rel=0.02)


def test_contact_radius_is_hertzs() -> None:
    pressed = slab().press(0.02, 0.005, profile="paraboloid")
    assert pressed.contact_radius_m == pytest.approx(0.010, rel=0.06)  # sqrt(R d); the lattice resolves 1.5 mm


def test_halving_the_mesh_changes_the_force_by_under_three_percent() -> None:
    for depth in (0.003, 0.010):
        coarse = slab(edge_m=0.003).press(0.015, depth).force_n
        fine = slab(edge_m=0.0015).press(0.015, depth).force_n
        assert coarse == pytest.approx(fine, rel=0.03)
