"""Registration of a patient who has moved: the wall of one scan against that of the previous one, pixel by pixel.

A body on a table shifts along it by s_x, s_y and turns about its long axis by theta. The wall's pixels then measure the outward
displacement (see `tracker`)

    y_i = m_i d + n_i . (s_x, s_y, 0) + theta n_i . (e_y x p_i) + noise

with the normals n_i midway between both scans, which leaves no error of second order. Both walls are means over two breaths, so
the remaining error is the camera's systematic one, not pixel noise.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_perception.wall import SeenWall

PRIOR: Final = (0.010, 0.015, 0.015, 0.05)
"""Standard deviations of the rise d [m], s_x, s_y [m] and theta [rad] of a body that moves."""
SEEN_M: Final = 1.4e-3
"""Equivalent independent error of a pixel in both scans [m]: 0.7 mm shared by four neighbours (docs/errors.md)."""
TUKEY: Final = 5.0
"""Tukey's biweight, in standard deviations of a pixel: clothes and arms move otherwise."""
ROUNDS: Final = 4


def reasons(lifts: Array, n_A: Array, from_middle: Array) -> Array:
    """Return the outward displacement of pixels by unit d, s_x, s_y and theta, shape (n, 4); theta turns about the middle."""
    turn = from_middle[:, 2] * n_A[:, 0] - from_middle[:, 0] * n_A[:, 2]  # n . (e_y x p)
    return np.column_stack((lifts, n_A[:, :2], turn))


def shift_between(before: SeenWall, after: SeenWall, middle: Array, drift: float) -> Array:
    """Return the shift of the skin around `middle` (A, [m], shape (3,)) along the table [m], in A, shape (2,).

    `drift`: drift of the camera's depth between the scans [m]; in an oblique view it would look like a shift.
    """
    _, i, j = np.intersect1d(before.pixel, after.pixel, assume_unique=True, return_indices=True)
    y = 2 * (after.depth[j] - drift - before.depth[i]) / (after.gain[j] + before.gain[i])
    n_A = (before.n_A[i] + after.n_A[j]) / 2
    X = reasons((before.lifts[i] + after.lifts[j]) / 2, n_A, (before.p_A[i] + after.p_A[j]) / 2 - middle)
    motion: Array = np.zeros(4)
    prior = np.diag(np.array(PRIOR) ** -2.0)
    weight: Array = np.full(len(y), SEEN_M**-2.0)
    for _ in range(ROUNDS):
        motion = np.asarray(np.linalg.solve(X.T @ (weight[:, np.newaxis] * X) + prior, X.T @ (weight * y)))
        scale = max(SEEN_M, 1.5 * float(np.median(np.abs(y - X @ motion))))
        weight = np.clip(1 - ((y - X @ motion) / (TUKEY * scale)) ** 2, 0, None) ** 2 / scale**2
    return np.asarray(motion[1:3])
