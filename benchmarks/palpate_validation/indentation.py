"""The measurement of Remus et al. as a simulation: their sphere pressed into the flat surface tier at their speed."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_models.patient.phantom import PhantomModel, flat_phantom
from palpate_models.patient.remus2024 import RADIUS_M, SPEED_MPS
from palpate_models.patient.schema import Stiffness
from palpate_models.patient.wall import WallParameters
from palpate_tissue.backends.winkler.tissue import WinklerTissue

HALF_M = 0.08
"""Half width of the flat wall; with 0.13 m the forces are the same within 0.1 %."""
EDGE_M = 0.0025
"""Edge of its mesh: with half of the default the force of so small a sphere is within 1 % of the continuum's from 3 mm on."""
XY_M = (0.00125, 0.0)
"""Place of the press: in the middle of an edge, where the force is within 0.3 % of its mean over the lattice."""
SPACING_M = 1e-4
"""Spacing of the depths at which a force is taken."""
REACH_M = 0.022
"""Depth of a curve [m]: 20 mm and the largest zero offset."""
COMPARED_M = np.arange(1.0, 20.01, 0.5) * 1e-3
"""Depths at which forces are compared: to 20 mm, and from 1 mm on, where a force is no longer a few hundredths of a newton."""
RATIO_AT_M = 0.010
"""Depth at which tensed muscles are compared with relaxed ones."""


def wall_tissue(wall: WallParameters, tension: float = 0.0) -> WinklerTissue:
    """A flat wall of the surface tier with the default relaxation and without friction."""
    model = _flat(wall.k_w_n_per_m3)
    n = len(model.vertices)
    model = replace(model, stiffening=np.full(n, wall.stiffening_per_m), tension=np.full(n, tension))
    return WinklerTissue(model, Stiffness(k_w_n_per_m3=wall.k_w_n_per_m3, length_m=wall.length_m, friction=0.0))


def press(wall: WallParameters, tension: float = 0.0, depth_m: float = REACH_M) -> Array:
    """Force [N] of their sphere as it is pressed to `depth_m` [m], at each `SPACING_M` from the surface down, the first 0."""
    depths = SPACING_M * np.arange(1.0, round(depth_m / SPACING_M) + 1)
    return force_along(wall_tissue(wall, tension), depths, SPEED_MPS)


def force_along(tissue: WinklerTissue, depths: Array, speed: float) -> Array:
    """Force [N] at depths [m] from 0 along straight lines at `speed` [m/s], shape (n + 1,); the first is 0, before contact."""
    force, depth = np.zeros(len(depths) + 1), 0.0
    for k, end in enumerate(depths.tolist()):
        steps = max(1, round(abs(end - depth) / (speed * tissue.dt)))
        velocity = np.array((0.0, 0.0, -np.sign(end - depth) * speed))
        for at in np.linspace(depth, end, steps + 1)[1:]:
            push, _ = tissue.step(0.0, np.array((*XY_M, RADIUS_M - at)), velocity, RADIUS_M)
        force[k + 1], depth = push[2], end
    return force


@cache
def _flat(k_w_n_per_m3: float) -> PhantomModel:
    return flat_phantom(HALF_M, EDGE_M, k_w_n_per_m3)


def at_depths(force: Array, zero_offset_m: float, depths: Array = COMPARED_M) -> Array:
    """A simulated `force` at depths [m] below a zero that is `zero_offset_m` [m] below the untouched skin."""
    return np.interp(depths + zero_offset_m, np.arange(len(force)) * SPACING_M, force)
