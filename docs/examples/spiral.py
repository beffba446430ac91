"""A scan pattern: a spiral from the centre of the region outwards, in one stroke."""

import numpy as np

from palpate_models.scenario.patterns import Scan


def scan(exam, surface):
    """Return lines of targets in the abdomen frame [m]."""
    turns = min(exam.region_m) / 2 / exam.spacing_m
    count = int(np.pi * turns**2)
    angle = 2 * np.pi * np.sqrt(np.linspace(0, turns**2, count))  # evenly over the disc
    radius = exam.spacing_m * angle / (2 * np.pi)
    offsets = np.column_stack((radius * np.cos(angle), radius * np.sin(angle)))
    return Scan([exam.centre_m + offsets])
