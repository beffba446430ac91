"""Tension field of guarding muscle, and the tension that gives a force ratio.

The ratio of a scenario is one of forces, as measured on people. The tension acts on the foundation alone, not on the shear layer,
so it exceeds the ratio; it is solved for on a flat uniform wall with the scenario's mechanics.
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from scipy.linalg import solve_banded
from scipy.optimize import brentq

from palpate_models.numerics.frames import Array, Mask
from palpate_models.patient import wall
from palpate_models.patient.field import edge_distance, smoothstep
from palpate_models.patient.mesh_file import MeshError
from palpate_models.patient.schema import Stiffness
from palpate_models.patient.wall import Guarding

RADIUS_M, DEPTH_M, SPEED_MPS = 0.010, 0.010, 0.005
"""The press in which the ratio is defined: that of the measured people (Remus 2024)."""
_RINGS = 800
_MOST_ROUNDS = 200


def tension_field(xy: Array, areas: Sequence[Guarding], stiffness: Stiffness, front: Mask) -> Array:
    """Return the tension over k_w [1] of contracted muscle at points (n, 2) of A [m], shape (n,); 0 where `front` is false.

    It rises over `edge_m`, centred on the outline. The larger tension counts where areas overlap. Raises MeshError if an area
    contains none of the points.
    """
    tension = np.zeros(len(xy))
    for index, area in enumerate(areas):
        share = np.where(front, smoothstep(0.5 - edge_distance(xy, area) / area.edge_m), 0.0)
        if not share.any():
            raise MeshError(
                f"phantom.guarding[{index}]: centre_m {area.centre_m}, radii_m {area.radii_m}: no point of the abdomen's front "
                "belongs to it (expected metres from the umbilicus)"
            )
        np.maximum(tension, tension_of_ratio(area.ratio, stiffness) * share, out=tension)
    return tension


@lru_cache(maxsize=64)
def tension_of_ratio(ratio: float, stiffness: Stiffness) -> float:
    """Return the tension relative to k_w [1] at which the force of the defining press is `ratio` times the relaxed one."""
    relaxed = pressed_force(stiffness, 0.0)
    bound = 2.0
    while pressed_force(stiffness, bound) < ratio * relaxed:
        bound *= 2
    return float(brentq(lambda tension: pressed_force(stiffness, tension) - ratio * relaxed, 0.0, bound, rtol=1e-6))


def pressed_force(stiffness: Stiffness, tension: float, depth_m: float = DEPTH_M) -> float:
    """Return the force [N] on the sphere at the end of the defining press, or one to `depth_m` [m], on a flat nominal wall.

        left (u - l^2 lap u) + drag u + sigma(u) + tension u = p / k_w,   p >= 0,  u >= w,  p (u - w) = 0

    is solved on rings around the axis. `left` is the unrelaxed share after a linear ramp of duration depth / SPEED_MPS, `drag`
    the share of the dashpot. Contact: primal-dual active set, with sigma linearised in each iteration (Newton).
    """
    seconds = depth_m / SPEED_MPS
    g, tau = np.array(stiffness.prony_g), np.array(stiffness.prony_tau_s)
    left = 1 - float(g @ (1 - tau / seconds * (1 - np.exp(-seconds / tau))))
    drag = stiffness.dashpot_s / seconds
    width = (RADIUS_M + 8 * stiffness.length_m) / _RINGS
    r = (np.arange(_RINGS) + 0.5) * width
    area = 2 * np.pi * r * width
    tie = 2 * np.pi * np.arange(1, _RINGS) * left * stiffness.length_m**2  # between a ring and the next
    stiffening = np.full(_RINGS, stiffness.stiffening_per_m)
    linear = area * (left + drag + tension)
    linear[:-1] += tie
    linear[1:] += tie
    w = np.where(r < RADIUS_M, depth_m - RADIUS_M + np.sqrt(np.maximum(RADIUS_M**2 - r**2, 0.0)), -1.0)
    u = np.maximum(w, 0.0)
    held = w > 0.5 * depth_m
    for _ in range(_MOST_ROUNDS):
        sigma, slope = wall.stress(u, stiffening), wall.slope(u, stiffening)
        bands = np.zeros((3, _RINGS))
        bands[0, 1:], bands[1], bands[2, :-1] = -tie, linear + area * slope, -tie
        load = area * (slope * u - sigma)
        row = bands.copy()
        row[1, held] = 1.0
        row[0, 1:][held[:-1]] = 0.0
        row[2, :-1][held[1:]] = 0.0
        last, u = u, solve_banded((1, 1), row, np.where(held, w, load))
        force = bands[1] * u - load
        force[:-1] -= tie * u[1:]
        force[1:] -= tie * u[:-1]
        touching = np.where(held, force > 0, u < w)
        if (touching == held).all() and np.abs(u - last).max() < 1e-9:
            return float(stiffness.k_w_n_per_m3 * force[held].sum())
        held = touching
    raise RuntimeError(f"the press on a flat wall did not settle in {_MOST_ROUNDS} rounds: {stiffness}, tension = {tension}")
