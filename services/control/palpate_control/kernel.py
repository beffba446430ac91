"""The compiled part of the Cartesian law; `impedance.py` says what it computes and why."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray
from palpate_models.compiled import compiled

from palpate_control.rotations import jlog3_times, log3

Array = NDArray[np.float64]

_DOF = 7


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
def task_space(R_WD: Array, J_W: Array, W: Array, regularisation: float, J: Array, JW: Array, inertia: Array) -> None:
    """The task in axes of D: J (6, 7), J W (6, 7) and (J W J')^-1 (6, 6), regularised where the arm is singular."""
    for part in range(0, 6, 3):
        for i in range(3):
            for j in range(_DOF):
                total = 0.0
                for k in range(3):
                    total += R_WD[k, i] * J_W[part + k, j]
                J[part + i, j] = total
    for i in range(6):
        for j in range(_DOF):
            total = 0.0
            for k in range(_DOF):
                total += J[i, k] * W[k, j]
            JW[i, j] = total
    mobility = np.empty((6, 6))
    for i in range(6):
        for j in range(6):
            total = 0.0
            for k in range(_DOF):
                total += JW[i, k] * J[j, k]
            mobility[i, j] = total
    if not spd_inverse(mobility, inertia, 0.0):
        spd_inverse(mobility, inertia, regularisation)


@compiled
def _times(J: Array, x: Array, y: Array) -> None:
    """Product J x into `y`."""
    for i in range(J.shape[0]):
        total = 0.0
        for k in range(J.shape[1]):
            total += J[i, k] * x[k]
        y[i] = total


@compiled
def _to_axes(R_WD: Array, x_W: Array, x_D: Array) -> None:
    """Linear and angular part (6,) from world's axes to D's."""
    for part in range(0, 6, 3):
        for i in range(3):
            x_D[part + i] = R_WD[0, i] * x_W[part] + R_WD[1, i] * x_W[part + 1] + R_WD[2, i] * x_W[part + 2]


@compiled
def cartesian_torque(
    q: Array,
    qd: Array,
    R_WI: Array,
    p_WI: Array,
    J: Array,
    JW: Array,
    slow_inertia: Array,
    coriolis: Array,
    R_WD: Array,
    p_WD: Array,
    V_WD: Array,
    F_W: Array,
    q_desired: Array,
    qd_desired: Array,
    joint_stiffness: Array,
    stiffness: Array,
    damping: Array,
    posture_damping: Array,
    clip: Array,
    velocity_limit: Array,
    viscous: Array,
    coulomb: Array,
    stiction_speed: float,
    null_torque: float,
    torque: Array,
) -> None:
    """`torque` (7,) [N m] by the Cartesian law, before limits; gains are the designed ones, J, JW, slow_inertia in D's axes."""
    R_DI = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            R_DI[i, j] = R_WD[0, i] * R_WI[0, j] + R_WD[1, i] * R_WI[1, j] + R_WD[2, i] * R_WI[2, j]
    phi = np.empty(3)
    angle = log3(R_DI, phi)
    F, V, own = np.empty(6), np.empty(6), np.empty(6)
    for i in range(3):
        error = 0.0
        for k in range(3):
            error += (p_WD[k] - p_WI[k]) * R_WD[k, i]
        F[i] = stiffness[i] * min(max(error, -clip[i]), clip[i])
        F[3 + i] = stiffness[3 + i] * min(max(-phi[i], -clip[3 + i]), clip[3 + i])
    jlog3_times(phi, angle, F[3:])  # d phi = J_l^-1 w with w in D's axes, and J_l^-T = Jlog3
    _to_axes(R_WD, V_WD, V)
    _times(J, qd, own)
    forward = np.empty(6)
    _to_axes(R_WD, F_W, forward)
    for i in range(6):
        F[i] += damping[i] * (V[i] - own[i]) + forward[i]

    posture, null = np.empty(_DOF), np.empty(_DOF)
    for j in range(_DOF):
        posture[j] = joint_stiffness[j] * (q_desired[j] - q[j]) + posture_damping[j] * (qd_desired[j] - qd[j])
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
    share = null_torque / max(largest, null_torque) if square > null_torque * null_torque else 1.0

    _times(J, qd_desired, own)
    for i in range(6):
        own[i] = V[i] - own[i]
    _times(slow_inertia, own, hold)
    for j in range(_DOF):
        wanted = qd_desired[j]
        total = coriolis[j] + share * null[j]
        for i in range(6):
            wanted += JW[i, j] * hold[i]
            total += J[i, j] * F[i]
        wanted = min(max(wanted, -velocity_limit[j]), velocity_limit[j])
        torque[j] = total + (viscous[j] + coulomb[j] / (abs(wanted) + stiction_speed)) * wanted


@compiled
def repulsion(q: Array, middle: Array, half: Array, gain: Array, cap: Array, push: Array) -> bool:
    """Torque away from the joint limits (7,) [N m]; False where no joint is in its zone."""
    inside = False
    for j in range(_DOF):
        off = q[j] - middle[j]
        depth = abs(off) - half[j]
        push[j] = 0.0
        if depth > 0.0:
            inside = True
            size = min(gain[j] * depth * depth, cap[j])
            push[j] = -size if off > 0.0 else size
    return inside


@compiled
def shape(torque: Array, gravity: Array, limit: Array, rate: float, last: Array, out: Array) -> None:
    """`torque` (7,) within `limit`, also with gravity added, and within `rate` of `last`."""
    for j in range(_DOF):
        low = max(-limit[j], -limit[j] - gravity[j], last[j] - rate)
        high = min(limit[j], limit[j] - gravity[j], last[j] + rate)
        out[j] = min(max(torque[j], low), high)
