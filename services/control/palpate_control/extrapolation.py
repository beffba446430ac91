"""The compiled part of the extrapolator: a set-point at an age, and the gap to the one before that fades.

Set-points and references are flat arrays as in `layout`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate_control.layout import F_W, P_WD, QD, QDD, R_WD, V_WD, Q
from palpate_control.rotations import exp3
from palpate_models.compiled import compiled

Array = NDArray[np.float64]

_DOF = 7


@compiled
def carry(setpoint: Array, acceleration: Array, age: float, standing: bool, reference: Array) -> None:
    """The set-point (64,) carried on by `age` [s] into `reference` (64,): pose (+) twist * age, and the joints likewise.

    `acceleration` (7,) is the joints' [rad/s^2]. A standing reference has no velocity.
    """
    for i in range(reference.size):
        reference[i] = setpoint[i]
    turn = np.empty(3)
    for i in range(3):
        turn[i] = setpoint[V_WD + 3 + i] * age
        reference[P_WD + i] = setpoint[P_WD + i] + setpoint[V_WD + i] * age
    _turned(turn, setpoint[R_WD:QDD], reference[R_WD:QDD])
    for i in range(_DOF):
        qd, qdd = setpoint[QD + i], acceleration[i]
        reference[Q + i] = setpoint[Q + i] + (qd + qdd * (0.5 * age)) * age
        reference[QD + i] = 0.0 if standing else qd + qdd * age
        reference[QDD + i] = 0.0 if standing else qdd
    if standing:
        reference[V_WD : V_WD + 6] = 0.0


@compiled
def bridge(fade: float, gap: Array, reference: Array) -> None:
    """Fades the gap and adds it to the reference (64,).

    `gap` (32,): position (3,), rotation vector in world axes (3,), twist (6,), wrench (6,), joint position and velocity (14,).
    """
    for i in range(32):
        gap[i] *= fade
    for i in range(3):
        reference[P_WD + i] += gap[i]
    _turned(gap[3:6], reference[R_WD:QDD].copy(), reference[R_WD:QDD])
    for i in range(6):
        reference[V_WD + i] += gap[6 + i]
        reference[F_W + i] += gap[12 + i]
    for i in range(_DOF):
        reference[Q + i] += gap[18 + i]
        reference[QD + i] += gap[25 + i]


@compiled
def follow(setpoint: Array, acceleration: Array, age: float, standing: bool, fade: float, gap: Array, reference: Array) -> None:
    """The reference at one tick: `carry`, then `bridge`."""
    carry(setpoint, acceleration, age, standing, reference)
    bridge(fade, gap, reference)


@compiled
def change_over(before: Array, after: Array, turn: Array, gap: Array) -> None:
    """Adds to the gap what two references (64,) of one moment differ by; `turn` (3,) is their rotation vector in world axes."""
    for i in range(3):
        gap[i] += before[P_WD + i] - after[P_WD + i]
        gap[3 + i] += turn[i]
    for i in range(6):
        gap[6 + i] += before[V_WD + i] - after[V_WD + i]
        gap[12 + i] += before[F_W + i] - after[F_W + i]
    for i in range(_DOF):
        gap[18 + i] += before[Q + i] - after[Q + i]
        gap[25 + i] += before[QD + i] - after[QD + i]


@compiled
def joint_acceleration(before: Array, after: Array, spacing: float, bound: float, acceleration: Array) -> None:
    """`acceleration` (7,) [rad/s^2], within `bound`, that the velocities of two set-points (64,) `spacing` [s] apart tell."""
    for i in range(_DOF):
        acceleration[i] = min(max((after[QD + i] - before[QD + i]) / spacing, -bound), bound)


@compiled
def _turned(turn: Array, R: Array, out: Array) -> None:
    """The rotation `R`, turned by a rotation vector in world axes, into `out`; matrices row by row, shape (9,)."""
    change = np.empty((3, 3))
    exp3(turn, change)
    for i in range(3):
        for j in range(3):
            out[3 * i + j] = change[i, 0] * R[j] + change[i, 1] * R[3 + j] + change[i, 2] * R[6 + j]
