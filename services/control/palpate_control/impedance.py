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

import numpy as np
from numpy.typing import NDArray

from palpate_control import kernel
from palpate_control.kernel import JOINT_DAMPING_RATIO, LEAST_DAMPING
from palpate_control.layout import QDD
from palpate_control.model import DOF, SLOW_S, ArmModel
from palpate_control.reference import Mode, Reference, Setpoint
from palpate_control.safety import SafetyNet

Array = NDArray[np.float64]

DEAD_TICKS = 2
"""From measuring to acting: a tick of transport, one of holding the torque, half of velocity's age, rounded up."""
SPRING_ANGLE = 0.3
"""Fastest undamped frequency of a spring, times the dead time [rad]: past it sampled damping adds energy."""
DESIGN_TICKS = 10
"""Gains are designed for each set-point, and again after so many ticks: meanwhile the arm moves by milliradians."""


class ImpedanceController:
    """The control law with its safety net. One instance an arm: it remembers the torque before, for the rate limit."""

    def __init__(self, model: ArmModel, limit_zone: float = 0.05, period_s: float = 1e-3) -> None:
        """A controller on `model`, called every `period_s`, with joint-limit repulsion in the last `limit_zone` [rad]."""
        self.model = model
        self._net = SafetyNet(model.position_lower, model.position_upper, model.torque_limit, limit_zone, period_s)
        self._dead_time = DEAD_TICKS * period_s
        self._spring_rate = SPRING_ANGLE / self._dead_time
        self._joints = np.stack((model.velocity_limit, model.viscous_friction, model.coulomb_friction))
        self._q, self._qd, self._raw = np.zeros(DOF), np.zeros(DOF), np.zeros(DOF)
        self._J, self._JW, self._slow_inertia = np.zeros((6, DOF)), np.zeros((6, DOF)), np.zeros((6, 6))  # in D's axes
        self._designed_for: Setpoint | None = None
        self._design_age = 0
        self._gains = np.zeros(6 + 6 + DOF)
        self._joint_stiffness = self._joint_damping = np.zeros((DOF, DOF))
        self._position_error, self._velocity_error = np.zeros(DOF), np.zeros(DOF)

    def reset(self) -> None:
        """Starts the rate limit from zero torque: nothing has been commanded of late."""
        self._net.reset()
        self._designed_for = None

    def torque(self, q: Array, qd: Array, reference: Reference) -> Array:
        """Torque command without gravity [N m], shape (7,), at positions `q` [rad] and velocities `qd` [rad/s].

        Raises ValueError if `q` or `qd` is not finite or not of shape (7,).
        """
        if not self._take(q, qd):
            raise ValueError(f"joint_states: position = {q}, velocity = {qd}: must be {DOF} finite values each")
        if reference.setpoint.mode is Mode.CARTESIAN:
            self._cartesian(reference)
        else:
            self._joint(reference)
        return self._net.torque(self._raw, self._q, self.model.gravity)

    def _take(self, q: Array, qd: Array) -> bool:
        """Copies a joint state; False where it is none."""
        if q.shape != (DOF,) or qd.shape != (DOF,):
            return False
        self._q[:] = q
        self._qd[:] = qd
        return kernel.finite(self._q, self._qd)

    def _joint(self, reference: Reference) -> None:
        model, q, qd = self.model, self._q, self._qd
        model.update_gravity(q)
        if self._outdated(reference.setpoint):
            self._design_joint(q, reference["joint_stiffness"])
        kernel.joint_errors(q, qd, reference.values, self._position_error, self._velocity_error)
        kernel.joint_torque(
            self._joint_stiffness.dot(self._position_error),
            self._joint_damping.dot(self._velocity_error),
            model.inverse_dynamics(q, qd, reference.values[QDD:]),
            model.gravity,
            reference.values,
            self._joints,
            self._raw,
        )

    def _outdated(self, setpoint: Setpoint) -> bool:
        """Whether gains are to be designed now for the set-point."""
        if setpoint is self._designed_for and self._design_age < DESIGN_TICKS:
            self._design_age += 1
            return False
        self._designed_for, self._design_age = setpoint, 1
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

    def _cartesian(self, reference: Reference) -> None:
        model, q, qd, values = self.model, self._q, self._qd, reference.values
        J, JW, slow_inertia = self._J, self._JW, self._slow_inertia
        model.update(q, qd)
        kernel.task_space(values, model.J_W, model.slow_mobility, J, JW, slow_inertia)
        if self._outdated(reference.setpoint):
            self._design(reference)
        kernel.cartesian_torque(
            q,
            qd,
            values,
            model.R_WI,
            model.p_WI,
            J,
            JW,
            slow_inertia,
            model.bias,
            model.gravity,
            self._gains,
            self._joints,
            self._raw,
        )

    def _design(self, reference: Reference) -> None:
        """Gains for this set-point and posture: stiffness that sampling can bear and the damping that goes with it."""
        joint_mobility = self.model.mobility
        mobility = self._J.dot(joint_mobility).dot(self._J.T)
        square_rate = self._spring_rate**2
        kernel.design(
            reference.values, mobility, joint_mobility, self._slow_inertia, SLOW_S, square_rate, self._dead_time, self._gains
        )
