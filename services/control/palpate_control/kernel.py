"""The compiled part of the law and of its safety net; `impedance.py` says what it computes and why.

References are flat arrays as in `layout`. What the arm is has a row (7,) each in `joints`: largest velocity [rad/s], viscous
friction [N m s/rad] and Coulomb friction [N m]. `gains` (19,) are the designed ones: stiffness (6,) and damping (6,) in axes
of D, damping of the posture (7,).
"""

from __future__ import annotations

from math import isfinite, sqrt

import numpy as np
from numpy.typing import NDArray

from palpate_control.layout import DAMPING_RATIO, F_W, JOINT_STIFFNESS, P_WD, QD, QDD, R_WD, STIFFNESS, V_WD, Q
from palpate_control.rotations import jlog3_times, log3
from palpate_models.compiled import compiled

Array = NDArray[np.float64]

POSITION_CLIP_M = 0.1
"""Largest position error that stretches the spring, each axis (Mayr and Salt-Ducaju, JOSS 05194, and CRISP use the like)."""
ROTATION_CLIP_RAD = 0.5
JOINT_CLIP_RAD = 0.25
"""The same for a joint in mode JOINT."""
NULL_TORQUE_NM = 5.0
"""Cap of the null-space torque, each joint."""
JOINT_DAMPING_RATIO = 0.7
"""Of the joint spring in mode JOINT and of the null-space posture [1]."""
STICTION_SPEED = 0.02
"""Joint speed at which half of the Coulomb friction is compensated [rad/s]; keeps the compensation smooth."""
LEAST_DAMPING = 0.1
"""Part of the designed damping that is commanded even where friction alone would do: friction is known badly."""
REGULARISATION = 1e-3
"""Added to a matrix of the task [1/kg, 1/(kg m^2)] where it has lost rank."""

_DOF = 7


@compiled
def finite(q: Array, qd: Array) -> bool:
    """Whether all joint positions and velocities, shapes (7,), are finite."""
    total = 0.0
    for j in range(_DOF):
        total += q[j] * q[j] + qd[j] * qd[j]
    return isfinite(total)


@compiled
def spd_inverse(A: Array, out: Array, extra: float) -> bool:
    """Inverse of the symmetric positive definite matrix A + extra 1 by Cholesky, shapes (n, n); False if it is not definite."""
    n = A.shape[0]
    L = np.empty((n, n))
    for i in range(n):
        for j in range(i + 1):
            total = A[i, j] + (extra if i == j else 0.0)
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                L[i, i] = sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    for column in range(n):  # L L' x = e
        for i in range(n):
            total = 1.0 if i == column else 0.0
            for k in range(i):
                total -= L[i, k] * out[k, column]
            out[i, column] = total / L[i, i]
        for i in range(n - 1, -1, -1):
            total = out[i, column]
            for k in range(i + 1, n):
                total -= L[k, i] * out[k, column]
            out[i, column] = total / L[i, i]
    return True


@compiled
def _regular_inverse(A: Array, out: Array) -> None:
    """Inverse of a symmetric positive definite matrix, shape (6, 6); regularised where the arm is singular."""
    if not spd_inverse(A, out, 0.0):
        spd_inverse(A, out, REGULARISATION)


@compiled
def task_space(reference: Array, J_W: Array, W: Array, J: Array, JW: Array, inertia: Array) -> None:
    """The task in axes of D: J (6, 7), J W (6, 7) and (J W J')^-1 (6, 6), regularised where the arm is singular."""
    R = reference[R_WD:QDD]
    for part in range(0, 6, 3):
        for i in range(3):
            for j in range(_DOF):
                total = 0.0
                for k in range(3):
                    total += R[3 * k + i] * J_W[part + k, j]
                J[part + i, j] = total
    for i in range(6):
        for j in range(_DOF):
            total = 0.0
            for k in range(_DOF):
                total += J[i, k] * W[k, j]
            JW[i, j] = total
    mobility = np.empty((6, 6))
    for i in range(6):
        for j in range(i + 1):  # the half that its inverse takes
            total = 0.0
            for k in range(_DOF):
                total += JW[i, k] * J[j, k]
            mobility[i, j] = total
    _regular_inverse(mobility, inertia)


@compiled
def design(
    reference: Array,
    mobility: Array,
    joint_mobility: Array,
    slow_inertia: Array,
    slow_s: float,
    square_rate: float,
    dead_time: float,
    gains: Array,
) -> None:
    """`gains` at mobilities (6, 6) and (7, 7): stiffness that sampling can bear and the damping that goes with it.

    `square_rate` [1/s^2] is that of the fastest undamped spring, `slow_s` and `dead_time` [s] are as in `impedance.py`.
    """
    inverse = np.empty((6, 6))
    _regular_inverse(mobility, inverse)
    for i in range(6):
        inertia = inverse[i, i]
        friction = (slow_inertia[i, i] - inertia) / slow_s
        # Near a singularity the inertia with the other axes held grows without bound: four times the free one is enough.
        mass = np.minimum(inertia, 4 / mobility[i, i])
        bound = np.maximum(square_rate * mass, friction / (4 * dead_time))
        stiffness = np.minimum(reference[STIFFNESS + i], bound)
        damping = 2 * reference[DAMPING_RATIO + i] * sqrt(stiffness * mass)
        gains[i] = stiffness
        gains[6 + i] = np.maximum(damping - friction, LEAST_DAMPING * damping)
    for j in range(_DOF):
        gains[12 + j] = (2 * JOINT_DAMPING_RATIO) * sqrt(reference[JOINT_STIFFNESS + j] / joint_mobility[j, j])


@compiled
def _times(J: Array, x: Array, y: Array) -> None:
    """Product J x into `y`."""
    for i in range(J.shape[0]):
        total = 0.0
        for k in range(J.shape[1]):
            total += J[i, k] * x[k]
        y[i] = total


@compiled
def _to_axes(R: Array, x_W: Array, x_D: Array) -> None:
    """Linear and angular part (6,) from world's axes to D's; the rotation row by row, shape (9,)."""
    for part in range(0, 6, 3):
        for i in range(3):
            x_D[part + i] = R[i] * x_W[part] + R[3 + i] * x_W[part + 1] + R[6 + i] * x_W[part + 2]


@compiled
def _friction(joints: Array, j: int, speed: float) -> float:
    """Torque that overcomes viscous and Coulomb friction of joint `j` at a desired velocity."""
    torque: float = (joints[1, j] + joints[2, j] / (abs(speed) + STICTION_SPEED)) * speed
    return torque


@compiled
def cartesian_torque(
    q: Array,
    qd: Array,
    reference: Array,
    R_WI: Array,
    p_WI: Array,
    J: Array,
    JW: Array,
    slow_inertia: Array,
    bias: Array,
    gravity: Array,
    gains: Array,
    joints: Array,
    torque: Array,
) -> None:
    """`torque` (7,) [N m] by the Cartesian law, before limits; J, JW, slow_inertia in D's axes."""
    R, p = reference[R_WD:QDD], reference[P_WD:V_WD]
    stiffness, damping, posture_damping = gains[:6], gains[6:12], gains[12:]
    R_DI = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            R_DI[i, j] = R[i] * R_WI[0, j] + R[3 + i] * R_WI[1, j] + R[6 + i] * R_WI[2, j]
    phi = np.empty(3)
    angle = log3(R_DI, phi)
    F, V, own = np.empty(6), np.empty(6), np.empty(6)
    for i in range(3):
        error = 0.0
        for k in range(3):
            error += (p[k] - p_WI[k]) * R[3 * k + i]
        F[i] = stiffness[i] * min(max(error, -POSITION_CLIP_M), POSITION_CLIP_M)
        F[3 + i] = stiffness[3 + i] * min(max(-phi[i], -ROTATION_CLIP_RAD), ROTATION_CLIP_RAD)
    jlog3_times(phi, angle, F[3:])  # d phi = J_l^-1 w with w in D's axes, and J_l^-T = Jlog3
    _to_axes(R, reference[V_WD:F_W], V)
    _times(J, qd, own)
    forward = np.empty(6)
    _to_axes(R, reference[F_W:Q], forward)
    for i in range(6):
        F[i] += damping[i] * (V[i] - own[i]) + forward[i]

    posture, null = np.empty(_DOF), np.empty(_DOF)
    for j in range(_DOF):
        spring = reference[JOINT_STIFFNESS + j] * (reference[Q + j] - q[j])
        posture[j] = spring + posture_damping[j] * (reference[QD + j] - qd[j])
    drag, hold = np.empty(6), np.empty(6)
    _times(JW, posture, drag)
    _times(slow_inertia, drag, hold)
    square = largest = 0.0
    for j in range(_DOF):
        total = posture[j]
        for i in range(6):
            total -= J[i, j] * hold[i]
        null[j] = total
        square += total * total
        largest = max(largest, abs(total))
    # As a whole: so it stays in the null space.
    share = NULL_TORQUE_NM / max(largest, NULL_TORQUE_NM) if square > NULL_TORQUE_NM * NULL_TORQUE_NM else 1.0

    _times(J, reference[QD:R_WD], own)
    for i in range(6):
        own[i] = V[i] - own[i]
    _times(slow_inertia, own, hold)
    for j in range(_DOF):
        wanted = reference[QD + j]
        total = (bias[j] - gravity[j]) + share * null[j]
        for i in range(6):
            wanted += JW[i, j] * hold[i]
            total += J[i, j] * F[i]
        wanted = min(max(wanted, -joints[0, j]), joints[0, j])
        torque[j] = total + _friction(joints, j, wanted)


@compiled
def joint_errors(q: Array, qd: Array, reference: Array, position: Array, velocity: Array) -> None:
    """How far the joints are from where and how fast they ought to be, shapes (7,) [rad, rad/s]; `position` is clipped."""
    for j in range(_DOF):
        position[j] = min(max(reference[Q + j] - q[j], -JOINT_CLIP_RAD), JOINT_CLIP_RAD)
        velocity[j] = reference[QD + j] - qd[j]


@compiled
def joint_torque(
    spring: Array, damper: Array, inverse_dynamics: Array, gravity: Array, reference: Array, joints: Array, torque: Array
) -> None:
    """`torque` (7,) [N m] by the law in joint space, before limits, from its parts; `inverse_dynamics` has gravity in it."""
    for j in range(_DOF):
        wanted = (spring[j] + damper[j]) + _friction(joints, j, reference[QD + j])
        torque[j] = wanted + (inverse_dynamics[j] - gravity[j])


@compiled
def repel(q: Array, zone: Array, torque: Array) -> None:
    """Adds the torque away from the joint limits to `torque` (7,) [N m].

    `zone` (4, 7) has the middle of each joint's range and where its zone begins on either side of it [rad], gain and cap of
    the repulsion [N m/rad^2, N m].
    """
    for j in range(_DOF):
        off = q[j] - zone[0, j]
        depth = abs(off) - zone[1, j]
        if depth > 0.0:
            size = min(zone[2, j] * depth * depth, zone[3, j])
            torque[j] += -size if off > 0.0 else size


@compiled
def shape(torque: Array, gravity: Array, limit: Array, rate: float, last: Array, out: Array) -> None:
    """`torque` (7,) within `limit`, also with gravity added, and within `rate` of `last`."""
    for j in range(_DOF):
        low = max(-limit[j], -limit[j] - gravity[j], last[j] - rate)
        high = min(limit[j], limit[j] - gravity[j], last[j] + rate)
        out[j] = min(max(torque[j], low), high)


@compiled
def safe(torque: Array, q: Array, gravity: Array, zone: Array, limit: Array, rate: float, last: Array, out: Array) -> None:
    """`repel` on `torque`, then `shape` into `out` and `last`."""
    repel(q, zone, torque)
    shape(torque, gravity, limit, rate, last, out)
    for j in range(_DOF):
        last[j] = out[j]


@compiled
def widen(peak: Array, torque: Array) -> None:
    """`peak` (7,) becomes what is largest of it and the size of `torque` (7,)."""
    for j in range(_DOF):
        peak[j] = np.maximum(peak[j], abs(torque[j]))
