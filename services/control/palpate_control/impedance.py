"""Impedance control of a redundant arm: arrays in, joint torques out. Gravity is the driver's.

Cartesian, with e the pose error and all task quantities in axes of the desired indenter frame D:

    F   = K clip(e) + B (V_d - V) + F_ff,  B_i = 2 zeta_i sqrt(K_i m_i) - b_i
    tau = J^T F + N^T tau_0 + C(q, qd) qd + friction(qd_d)

m_i and b_i are the inertia and the joints' own viscous friction along axis i while the other axes are held: the diagonal of
(J M^-1 J^T)^-1 and what it gains a second when M + T D takes the place of M. So the arm shows the ratio of damping that
is asked for. N is the null-space projector of Khatib (1987, doi 10.1109/JRA.1987.1087068), consistent with M + T D: at
10 Nms/rad a joint's torque makes it move, not accelerate, and consistency with M alone lets the posture drag the indenter
along by millimetres. The rotational spring is the gradient of 1/2 phi^T K phi, phi the rotation vector, so the springs
store energy and never create any.

In joint space, with M = L L^T and L^-1 K L^-T = V diag(w^2) V^T, so that the columns of P = L V decouple inertia and stiffness:

    tau = P diag(w^2) P^T clip(q_d - q) + P diag(max(2 zeta w - b, ..)) P^T (qd_d - qd) + M qdd_d + C(q, qd) qd + friction(qd_d)

the double diagonalisation of Albu-Schaeffer et al. (ICRA 2003): each mode has the damping that its own
inertia needs. With M_ii joint by joint, two joints of almost one axis are damped as if the whole arm moved when they only turn
against each other, and then a few milliseconds from measuring to acting shake the arm.
"""

from __future__ import annotations

from math import isfinite

import numpy as np
from numpy.typing import NDArray

from palpate_control import kernel
from palpate_control.model import DOF, SLOW_S, ArmModel
from palpate_control.reference import Mode, Reference
from palpate_control.safety import LimitRepulsion, TorqueShaper

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
DEAD_TICKS = 2
"""From measuring to acting: a tick of transport, one of holding the torque, half of velocity's age, rounded up."""
SPRING_ANGLE = 0.3
"""Fastest undamped frequency of a spring, times the dead time [rad]: past it sampled damping adds energy."""
REGULARISATION = 1e-3
"""Added to a matrix of the task [1/kg, 1/(kg m^2)] where it has lost rank."""
DESIGN_TICKS = 10
"""Gains are designed for each set-point, and again after so many ticks: meanwhile the arm moves by milliradians."""


class ImpedanceController:
    """The control law with its safety net. One instance an arm: it remembers the torque before, for the rate limit."""

    def __init__(self, model: ArmModel, limit_zone: float = 0.05, period_s: float = 1e-3) -> None:
        """A controller on `model`, called every `period_s`, with joint-limit repulsion in the last `limit_zone` [rad]."""
        self.model = model
        self._repulsion = LimitRepulsion(model.position_lower, model.position_upper, model.torque_limit, limit_zone)
        self._shaper = TorqueShaper(model.torque_limit, period_s)
        self._dead_time = DEAD_TICKS * period_s
        self._spring_rate = SPRING_ANGLE / self._dead_time
        self._clip = np.array([POSITION_CLIP_M] * 3 + [ROTATION_CLIP_RAD] * 3)
        self._J, self._JW, self._slow_inertia = np.zeros((6, DOF)), np.zeros((6, DOF)), np.zeros((6, 6))  # in D's axes
        self._designed_for: Array | None = None
        self._design_age = 0
        self._stiffness = self._damping = np.zeros(6)
        self._posture_damping = np.zeros(DOF)
        self._joint_stiffness = self._joint_damping = np.zeros((DOF, DOF))

    def reset(self) -> None:
        """Starts the rate limit from zero torque: nothing has been commanded of late."""
        self._shaper.reset()
        self._designed_for = None

    def torque(self, q: Array, qd: Array, reference: Reference) -> Array:
        """Torque command without gravity [N m], shape (7,), at positions `q` [rad] and velocities `qd` [rad/s].

        Raises ValueError if `q` or `qd` is not finite or not of shape (7,).
        """
        if q.shape != (DOF,) or qd.shape != (DOF,) or not isfinite(q.dot(q) + qd.dot(qd)):
            raise ValueError(f"joint_states: position = {q}, velocity = {qd}: must be {DOF} finite values each")
        raw = self._cartesian(q, qd, reference) if reference.mode is Mode.CARTESIAN else self._joint(q, qd, reference)
        push = self._repulsion.torque(q)
        return self._shaper.shape(raw if push is None else raw + push, self.model.gravity)

    def _friction(self, qd: Array) -> Array:
        """Torque that overcomes viscous and Coulomb friction at the desired velocity, shape (7,)."""
        model = self.model
        return (model.viscous_friction + model.coulomb_friction / (np.abs(qd) + STICTION_SPEED)) * qd

    def _joint(self, q: Array, qd: Array, reference: Reference) -> Array:
        model = self.model
        model.update_gravity(q)
        if self._outdated(reference.joint_stiffness):
            self._design_joint(q, reference.joint_stiffness)
        error = np.minimum(np.maximum(reference.q - q, -JOINT_CLIP_RAD), JOINT_CLIP_RAD)
        torque: Array = (
            self._joint_stiffness.dot(error) + self._joint_damping.dot(reference.qd - qd) + self._friction(reference.qd)
        )
        return torque + model.inverse_dynamics(q, qd, reference.qdd)

    def _outdated(self, stiffness: Array) -> bool:
        """Whether gains are to be designed now for the stiffness that is asked for, of the mode that is on."""
        if stiffness is self._designed_for and self._design_age < DESIGN_TICKS:
            self._design_age += 1
            return False
        self._designed_for, self._design_age = stiffness, 1
        return True

    def _design_joint(self, q: Array, stiffness: Array) -> None:
        """Gains of mode JOINT at a posture, mode by mode bounded as in `_design`."""
        L = np.linalg.cholesky(self.model.inertia(q))
        L_inverse = np.linalg.inv(L)
        squared, V = np.linalg.eigh((L_inverse * stiffness).dot(L_inverse.T))
        P, P_inverse = L.dot(V), V.T.dot(L_inverse)
        friction = (P_inverse**2).dot(self.model.viscous_friction)
        squared = np.minimum(np.maximum(squared, 0.0), np.maximum(self._spring_rate**2, friction / (4 * self._dead_time)))
        damping = (2 * JOINT_DAMPING_RATIO) * np.sqrt(squared)
        self._joint_stiffness = (P * squared).dot(P.T)
        self._joint_damping = (P * np.maximum(damping - friction, LEAST_DAMPING * damping)).dot(P.T)

    def _cartesian(self, q: Array, qd: Array, reference: Reference) -> Array:
        model = self.model
        model.update(q, qd)
        R_WD = np.ascontiguousarray(reference.R_WD)
        kernel.task_space(R_WD, model.J_W, model.slow_mobility, REGULARISATION, self._J, self._JW, self._slow_inertia)
        if self._outdated(reference.stiffness):
            self._design(reference)
        torque = np.empty(DOF)
        kernel.cartesian_torque(
            q,
            qd,
            model.R_WI,
            model.p_WI,
            self._J,
            self._JW,
            self._slow_inertia,
            model.coriolis,
            R_WD,
            reference.p_WD,
            reference.V_WD,
            reference.F_W,
            reference.q,
            reference.qd,
            reference.joint_stiffness,
            self._stiffness,
            self._damping,
            self._posture_damping,
            self._clip,
            model.velocity_limit,
            model.viscous_friction,
            model.coulomb_friction,
            STICTION_SPEED,
            NULL_TORQUE_NM,
            torque,
        )
        return torque

    def _design(self, reference: Reference) -> None:
        """Gains for this set-point and posture: stiffness that sampling can bear and the damping that goes with it."""
        J = self._J
        joint_mobility = self.model.mobility
        mobility = J.dot(joint_mobility).dot(J.T)
        inertia = _inverse(mobility).diagonal()
        friction = (self._slow_inertia.diagonal() - inertia) / SLOW_S
        # Near a singularity the inertia with the other axes held grows without bound: four times the free one is enough.
        mass = np.minimum(inertia, 4 / mobility.diagonal())
        bound = np.maximum(self._spring_rate**2 * mass, friction / (4 * self._dead_time))
        self._stiffness = np.minimum(reference.stiffness, bound)
        damping = 2 * reference.damping_ratio * np.sqrt(self._stiffness * mass)
        self._damping = np.maximum(damping - friction, LEAST_DAMPING * damping)
        free = joint_mobility.diagonal()
        self._posture_damping = (2 * JOINT_DAMPING_RATIO) * np.sqrt(reference.joint_stiffness / free)


def _inverse(matrix: Array) -> Array:
    """Inverse of a symmetric positive definite matrix by Cholesky, shape (6, 6); regularised where the arm is singular."""
    inverse = np.empty_like(matrix)
    if not kernel.spd_inverse(matrix, inverse, 0.0):
        kernel.spd_inverse(matrix, inverse, REGULARISATION)
    return inverse
