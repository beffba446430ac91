"""Samples that the footprint model makes of a known wall, on a flat patch."""

from __future__ import annotations

import numpy as np

from palpate_assessment.contact import ReferenceContact
from palpate_assessment.grid import MapGrid, map_grid
from palpate_assessment.inversion import POWER, footprints, reference_force
from palpate_assessment.sampling import ForceSample

CONTACT = ReferenceContact(0.015, 0.010)
REGION = 0.12
SPACING, ALONG = 0.0125, 0.005


def flat_grid(pitch: float = 0.006, region: float = REGION) -> MapGrid:
    axis = np.arange(-0.1, 0.1001, 0.005)
    x, y = np.meshgrid(axis, axis)
    surface = np.column_stack((x.ravel(), y.ravel(), np.zeros(x.size)))
    return map_grid(surface, (0.0, 0.0), (region, region), 0.02, pitch)


def samples_of(
    grid: MapGrid, z: np.ndarray, depth: float = 0.010, speed: float = 0.0, region: float = REGION
) -> list[ForceSample]:
    """A snake of samples over a wall of log k_w `z` on the grid's nodes, without noise."""
    bare = [
        ForceSample(
            time=0.0,
            position=np.array((x, y, 0.0)),
            normal=np.array((0.0, 0.0, 1.0)),
            velocity=np.array((speed, 0.0, 0.0)),
            depth=depth,
            depth_rate=0.0,
            force=1.0,
            force_noise=0.0,
            lost=0.0,
            time_in_contact=1.0,
            force_limited=False,
        )
        for y in np.arange(-0.5 * region, 0.5 * region + 1e-9, SPACING)
        for x in np.arange(-0.5 * region, 0.5 * region + 1e-9, ALONG)
    ]
    felt = (footprints(bare, grid, CONTACT) @ np.exp(POWER * z)) ** (1 / POWER)
    force = felt * reference_force(bare, CONTACT, np.zeros(len(bare)))
    return [ForceSample(**{**vars(s), "force": float(f)}) for s, f in zip(bare, force, strict=True)]
