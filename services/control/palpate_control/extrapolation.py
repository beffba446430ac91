"""The compiled part of the extrapolator: a set-point at an age, and the gap to the one before that fades."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from palpate_models.compiled import compiled

from palpate_control.rotations import exp3

Array = NDArray[np.float64]


@compiled
def carry(
    R_WD: Array,
    p_WD: Array,
    V_WD: Array,
    q: Array,
    qd: Array,
    acceleration: Array,
    age: float,
    standing: bool,
    R: Array,
    p: Array,
    V: Array,
    joint: Array,
) -> None:
    """The set-point carried on by `age` [s]: pose (+) twist * age, and joint position, velocity, acceleration.

    Results: `R` (3, 3), `p` (3,), `V` (6,), `joint` (3, 7). A standing reference has no velocity.
    """
    turn, change = np.empty(3), np.empty((3, 3))
    for i in range(3):
        turn[i] = V_WD[3 + i] * age
        p[i] = p_WD[i] + V_WD[i] * age
    exp3(turn, change)
    for i in range(3):
        for j in range(3):
            R[i, j] = change[i, 0] * R_WD[0, j] + change[i, 1] * R_WD[1, j] + change[i, 2] * R_WD[2, j]
    for i in range(6):
        V[i] = 0.0 if standing else V_WD[i]
    for i in range(7):
        joint[0, i] = q[i] + (qd[i] + acceleration[i] * (0.5 * age)) * age
        joint[1, i] = 0.0 if standing else qd[i] + acceleration[i] * age
        joint[2, i] = 0.0 if standing else acceleration[i]


@compiled
def bridge(fade: float, gap: Array, R: Array, p: Array, V: Array, F: Array, joint: Array) -> None:
    """Fades the gap and adds it to the reference.

    `gap` (32,): position (3,), rotation vector in world axes (3,), twist (6,), wrench (6,), joint position and velocity (14,).
    """
    for i in range(32):
        gap[i] *= fade
    change, before = np.empty((3, 3)), R.copy()
    exp3(gap[3:6], change)
    for i in range(3):
        p[i] += gap[i]
        for j in range(3):
            R[i, j] = change[i, 0] * before[0, j] + change[i, 1] * before[1, j] + change[i, 2] * before[2, j]
    for i in range(6):
        V[i] += gap[6 + i]
        F[i] += gap[12 + i]
    for i in range(7):
        joint[0, i] += gap[18 + i]
        joint[1, i] += gap[25 + i]
