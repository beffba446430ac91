"""A scan pattern of your own: a spiral from the centre of the region outwards, in one stroke. `palpate plan` draws it."""

import numpy as np

from palpate_models.patterns.scan import Scan


def scan(exam, surface):
    """Lines of targets in the abdomen frame [m]; `surface(xy)` would give points and normals of the skin."""
    turns = min(exam.region_m) / 2 / exam.spacing_m
    angle = 2 * np.pi * np.sqrt(np.linspace(0, turns**2, int(np.pi * turns**2)))  # points spread evenly over the disc
    radius = exam.spacing_m * angle / (2 * np.pi)
    return Scan([exam.centre_m + np.column_stack((radius * np.cos(angle), radius * np.sin(angle)))])
