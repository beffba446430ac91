"""Probing of a tissue: a sphere is held below a flat surface until equilibrium."""

from collections.abc import Sequence

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_models.patient.phantom import PhantomModel
from palpate_models.patient.schema import Stiffness
from palpate_tissue.backends.winkler.tissue import WinklerTissue

ELASTIC = Stiffness(k_w_n_per_m3=1.7e5, length_m=0.015, stiffening_per_m=0.0, prony_g=(), prony_tau_s=(), friction=0.0)
"""Linear wall near a half-space of 10 kPa, without relaxation and friction, for comparison with static references."""
SETTLE_S = 0.3
"""Duration of a hold [s]: six times the dashpot's 0.05 s."""
OFFSETS = ((0.0, 0.0), (0.0025, 0.0), (0.0, 0.0029), (0.0013, 0.0008), (0.0031, 0.0017))
"""Positions on the vertex lattice over which a force is averaged [m]: on a vertex, an edge, a triangle."""
STILL = np.zeros(3)


def hold(tissue: WinklerTissue, depth: float, radius: float, xy: Sequence[float] = (0, 0), seconds: float = SETTLE_S) -> float:
    """Return the normal force [N] on a sphere of `radius` [m] held at `depth` [m] below z = 0, after `seconds` [s]."""
    p = np.array((*xy, radius - depth))
    force = STILL
    for k in range(round(seconds / tissue.dt)):
        force, _ = tissue.step(k * tissue.dt, p, STILL, radius)
    return float(force[2])


def static_curve(model: PhantomModel, depths: Array, radius: float) -> Array:
    """Return the static force [N] at increasing `depths` [m], of their shape, as a mean over positions on the lattice.

    Without relaxation the equilibrium does not depend on the path, so one tissue is pressed deeper and deeper.
    """
    forces = np.zeros(len(depths))
    for xy in OFFSETS:
        tissue = WinklerTissue(model, ELASTIC)
        forces += [hold(tissue, float(depth), radius, xy) for depth in depths]
    return forces / len(OFFSETS)
