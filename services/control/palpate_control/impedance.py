"""Impedance control of a redundant arm: arrays in, joint torques out. The driver adds gravity.

Cartesian, with e the pose error and all task quantities in axes of the desired indenter frame D:

    F   = K clip(e) + B (V_d - V) + F_ff,  B_i = 2 zeta_i sqrt(K_i m_i) - b_i
    tau = J^T F + N^T tau_0 + C(q, qd) qd + friction(qd_d)

m_i and b_i are the inertia and the joints' own viscous friction along axis i while the other axes are held: m_i is the diagonal
of (J M^-1 J^T)^-1, b_i its increase per second when M + T D replaces M. With both, the arm shows the requested damping ratio.
N is the null-space projector of Khatib (1987, doi 10.1109/JRA.1987.1087068), consistent with M + T D. At 10 Nms/rad a joint
torque causes motion rather than acceleration; with a projector consistent with M alone the posture drags the indenter by
millimetres. The rotational spring is the gradient of 1/2 phi^T K phi, phi the rotation vector, so the springs are conservative.

In joint space, with M = L L^T and L^-1 K L^-T = V diag(w^2) V^T, so that the columns of P = L V decouple inertia and stiffness:

    tau = P diag(w^2) P^T clip(q_d - q) + P diag(max(2 zeta w - b, ..)) P^T (qd_d - qd) + M qdd_d + C(q, qd) qd + friction(qd_d)

the double diagonalisation of Albu-Schaeffer et al. (ICRA 2003): each mode gets the damping that its own inertia needs. With
M_ii joint by joint, two nearly coaxial joints that turn against each other are damped as if the whole arm moved; a delay of a
few milliseconds then makes the arm oscillate.

Admittance control, of an arm that takes joint positions: set-point and F/T reading in, joint positions out.

The tool yields from the desired position p_D by y, in axes of the desired indenter frame D:

    T dy/dt + y = F / K,    F = F_measured + F_ff,    p_command = p_D + R_WD y

with the stiffness K of the set-point, the force of the environment on the tool, and the feed-forward force of the set-point. At
rest that is the law above: K (p_D - p) + F_ff is the force on the environment. The orientation does not yield.

It is the admittance 1 / (B s + K) with B = T K and no mass. On a wall whose force answers with Z(s) and an arm that follows with
G(s) after a delay d, the loop is L = Z G e^(-d s) / (K (T s + 1)) (Colgate and Hogan, Int. J. Control 1988, doi
10.1080/00207178808906161; Keemink et al., IJRR 2018, doi 10.1177/0278364918768950). Where |L| < 1 at all frequencies, no delay
makes it unstable (small gain).

The joints follow the planned posture, corrected by inverse kinematics on commanded positions. The least squares are damped: near
a singular wrist the tool tilts, where two joints would otherwise turn fast against each other and leave the plan.
"""

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from palpate_bus.setpoint import ControlMode, Setpoint
from palpate_control.model import ArmModel
from palpate_control.reference import JOINTS, POSITION, TWIST, WRENCH, Reference
from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import GRAVITY, Array
from palpate_models.robot.chain import Arm

Arrays = tuple[Array, ...]
TORQUE_RATE_NM_PER_MS = 1.0
"""Maximum change of a joint's torque in one millisecond [N m] (libfranka and CRISP bound it to 0.5 to 1.0)."""
REPULSION_FRACTION = 0.3
"""Repulsion at a joint limit, as a fraction of the joint's torque limit."""

# Read by compiled functions, which take no dataclass.


class LawTuning(NamedTuple):
    """Settings of the compiled law, which takes no dataclass."""

    position_clip_m: float = 0.1
    """Maximum position error that loads the spring, per axis (Mayr and Salt-Ducaju, JOSS 05194, and CRISP use similar values)."""
    rotation_clip_rad: float = 0.5
    null_torque_nm: float = 5.0
    """Limit of the null-space torque per joint."""
    joint_damping_ratio: float = 0.7
    """Damping ratio of the joint springs in mode JOINT and of the null-space posture [1]."""
    stiction_speed_radps: float = 0.02
    """Joint speed at which half of the Coulomb friction is compensated. Keeps the compensation smooth."""
    min_damping: float = 0.1
    """Fraction of the designed damping that is always commanded [1]: the friction estimate is poor."""
    regularisation: float = 1e-7
    """Added to the diagonal of a task mobility [1/kg, 1/(kg m^2)], which loses rank where the arm is singular."""
    slow_s: float = 0.1
    """T: time scale on which friction and inertia matter equally. Postures and scans move this slowly or slower."""
    spring_angle_rad: float = 0.3
    """Maximum undamped spring frequency times the dead time. Above it sampled damping adds energy."""


LAW = LawTuning()


class ControllerTuning(NamedTuple):
    """Settings of the controller outside the compiled law."""

    joint_clip_rad: float = 0.25
    """Maximum joint error that loads the spring in mode JOINT."""
    dead_ticks: int = 2
    """Delay from measurement to torque: one tick of transport, half a tick of zero-order hold, half a tick of velocity age."""
    design_ticks: int = 10
    """Gains are designed for each set-point and after this many ticks, in which the arm moves by milliradians."""


TUNING = ControllerTuning()


class CartesianGains(NamedTuple):
    """Gains of mode CARTESIAN."""

    K: Array
    """Stiffness along and about the axes of D, shape (6,)."""
    B: Array
    """Damping along and about the axes of D, shape (6,)."""
    K_0: Array
    """Stiffness of the null-space posture, shape (n,)."""
    B_0: Array
    """Damping of the null-space posture, shape (n,)."""
    J_bar: Array
    """Inverse of the Jacobian weighted by inertia and friction, shape (n, 6)."""


class JointGains(NamedTuple):
    """Gains of mode JOINT, shape (n, n) each."""

    K: Array
    B: Array


class ImpedanceController:
    """The control law with its safety net. One instance per arm: the rate limit needs the previous torque."""

    def __init__(self, model: ArmModel, limit_zone: float = 0.05, period_s: float = 1e-3) -> None:
        """Create a controller called every `period_s`, with joint-limit repulsion in the last `limit_zone` [rad] (0: none).

        The repulsion is a progressive spring before each joint limit: conservative, and smooth at the edge of the zone.
        """
        self.model = model
        lower, upper, limit = model.position_lower, model.position_upper, model.torque_limit
        gain = REPULSION_FRACTION * limit / limit_zone**2 if limit_zone > 0 else np.zeros_like(lower)
        self._joints = np.stack(((lower + upper) / 2, (upper - lower) / 2 - limit_zone, gain, limit))
        self.peak = np.zeros_like(limit)
        """Largest magnitude of each torque so far [N m], shape (n,)."""
        self._rate = TORQUE_RATE_NM_PER_MS * period_s / 1e-3
        self._last = np.zeros_like(limit)
        self._dead_time = TUNING.dead_ticks * period_s
        self._friction = np.stack((model.viscous_friction, model.coulomb_friction, model.velocity_limit))
        self._designed_for: Setpoint | None = None
        self._design_age = 0
        self._cartesian_gains: CartesianGains  # designed in the first tick, as the joint gains
        self._joint_gains: JointGains

    def reset(self) -> None:
        """Restart the rate limit from zero torque, after a pause without commands."""
        self._last = np.zeros_like(self._last)
        self._designed_for = None

    def command(self, q: Array, qd: Array, reference: Reference) -> Array:
        """Return the torque command without gravity [N m], shape (n,), at positions `q` [rad] and velocities `qd` [rad/s]."""
        q, qd = np.array(q, dtype=float), np.array(qd, dtype=float)
        law = self._cartesian if reference.setpoint.mode is ControlMode.CARTESIAN else self._joint
        wanted, torque = law(q, qd, reference), np.empty(len(q))
        safe_torque(wanted, q, self.model.gravity, self._last, self._rate, self._joints, self.peak, torque)
        self._last = torque
        return torque

    def _cartesian(self, q: Array, qd: Array, reference: Reference) -> Array:
        """Return the unlimited torque of mode CARTESIAN [N m], shape (n,)."""
        model, R_WD, x = self.model, reference.motion.R_WD, reference.motion.x
        model.update(q, qd)
        if self._design_due(reference.setpoint):
            setpoint = reference.setpoint  # copied: arrays of messages are read-only, a different type for numba
            requested = (setpoint.stiffness.copy(), setpoint.damping_ratio.copy(), setpoint.joint_stiffness.copy())
            inertia, friction = model.inertia(q), model.viscous_friction
            self._cartesian_gains = cartesian_gains(requested, R_WD, model.J_W, inertia, friction, self._dead_time)
        arm = (q, qd, model.p_WI, model.J_W, model.bias, model.gravity)
        R_DI = R_WD.T.dot(model.R_WI)
        gains, torque = tuple(self._cartesian_gains), np.empty(len(q))
        cartesian_torque(arm, R_WD, x, pin.log3(R_DI), pin.Jlog3(R_DI), gains, self._friction, torque)
        return torque

    def _joint(self, q: Array, qd: Array, reference: Reference) -> Array:
        """Return the unlimited torque of mode JOINT [N m], shape (n,)."""
        model, motion = self.model, reference.motion
        model.update_gravity(q)
        if self._design_due(reference.setpoint):
            self._joint_gains = joint_gains(
                reference.setpoint.joint_stiffness, model.inertia(q), model.viscous_friction, self._dead_time
            )
        error = np.minimum(np.maximum(motion.q - q, -TUNING.joint_clip_rad), TUNING.joint_clip_rad)
        impedance = self._joint_gains.K @ error + self._joint_gains.B @ (motion.qd - qd)
        inertial = model.inverse_dynamics(q, qd, motion.qdd) - model.gravity
        return impedance + inertial + friction_torque(motion.qd, model.viscous_friction, model.coulomb_friction)

    def _design_due(self, setpoint: Setpoint) -> bool:
        """Return True if gains must be designed at this tick; called once a tick, since it counts ticks since the last design."""
        if setpoint is self._designed_for and self._design_age < TUNING.design_ticks:
            self._design_age += 1
            return False
        self._designed_for, self._design_age = setpoint, 1
        return True


# The law is compiled because it takes most of a tick at 1 kHz. pinocchio's log3 and Jlog3 are called before it. Each array
# argument costs 0.1 us and a returned array 0.5 us, so arguments are packed and the result is written into the last one. Reading
# a plain tuple takes half the time of a named one.


@compiled
def cartesian_torque(
    arm: Arrays, R_WD: Array, x: Array, phi: Array, Jlog: Array, gains: Arrays, friction: Array, torque: Array
) -> None:
    """Compute the torque of mode CARTESIAN before limits.

    Args:
        arm: q, qd, p_WI, J_W, C(q, qd) qd + gravity, and gravity, as `ArmModel` evaluates them.
        R_WD: desired rotation of the indenter, shape (3, 3).
        x: coordinates of the desired `ReferenceMotion`, shape (18 + 3 n,).
        phi: rotation vector of R_DI [rad], shape (3,).
        Jlog: derivative of `phi` with respect to a rotation in axes of I, shape (3, 3).
        gains: `CartesianGains` as a plain tuple.
        friction: viscous [N m s/rad] and Coulomb [N m] friction and the velocity limit [rad/s], shape (3, n).
        torque: output [N m], shape (n,).
    """
    q, qd, p_WI, J_W, bias, gravity = arm
    p_WD, V_WD, F_W = x[POSITION], x[TWIST], x[WRENCH]
    q_0, qd_0 = x[JOINTS : JOINTS + len(q)], x[JOINTS + len(q) : JOINTS + 2 * len(q)]
    K, B, K_0, B_0, J_bar = gains
    viscous, coulomb, velocity_limit = friction[0], friction[1], friction[2]

    p_error = clip(R_WD.T @ (p_WD - p_WI), LAW.position_clip_m)
    phi_error = clip(-phi, LAW.rotation_clip_rad)
    V_error = to_axes(R_WD.T, V_WD - J_W @ qd)
    # gradient of 1/2 phi' K phi in axes of D: R_DI Jlog^T = Jlog, since phi is the common axis
    spring = np.concatenate((K[:3] * p_error, Jlog @ (K[3:] * phi_error)))
    wrench_W = to_axes(R_WD, spring + B * V_error) + F_W

    tau_0 = K_0 * (q_0 - q) + B_0 * (qd_0 - qd)
    null = tau_0 - J_W.T @ (J_bar.T @ tau_0)
    null *= LAW.null_torque_nm / max(LAW.null_torque_nm, np.abs(null).max())  # scaled as a whole: stays in the null space

    qd_d = clip(qd_0 + J_bar @ (V_WD - J_W @ qd_0), velocity_limit)
    torque[:] = J_W.T @ wrench_W + null + (bias - gravity) + friction_torque(qd_d, viscous, coulomb)


@compiled
def clip(x: Array, bound: Array | float) -> Array:
    """Return `x` limited to plus or minus `bound`."""
    return np.minimum(np.maximum(x, -bound), bound)


@compiled
def friction_torque(qd: Array, viscous: Array, coulomb: Array) -> Array:
    """Return the torque that compensates joint friction at desired velocities `qd` [rad/s], [N m], shape (n,)."""
    return (viscous + coulomb / (np.abs(qd) + LAW.stiction_speed_radps)) * qd


@compiled
def to_axes(R_AB: Array, x_B: Array) -> Array:
    """Rotate a twist or wrench at one point (linear, angular), shape (6,), from axes of B to axes of A."""
    return (x_B.reshape(2, 3) @ R_AB.T).ravel()


@compiled
def cartesian_gains(requested: Arrays, R_WD: Array, J_W: Array, M: Array, D: Array, dead_time: float) -> CartesianGains:
    """Return the stiffness that is stable when sampled, the matching damping, and the null-space gains at a posture.

    Args:
        requested: stiffness, damping ratio and joint stiffness of a `Setpoint`.
        R_WD: desired rotation of the indenter, shape (3, 3).
        J_W: Jacobian in world axes, shape (6, n).
        M: joint-space inertia [kg m^2], shape (n, n).
        D: viscous joint friction [N m s/rad], shape (n,).
        dead_time: delay from measurement to torque [s].
    """
    stiffness, damping_ratio, K_0 = requested
    turn = np.kron(np.eye(2), R_WD.T)  # twist or wrench from world axes to axes of D
    J_D = turn @ J_W
    M_inverse, W = np.linalg.inv(M), np.linalg.inv(M + LAW.slow_s * np.diag(D))
    mobility = J_D @ M_inverse @ J_D.T
    inertia = np.diag(np.linalg.inv(mobility + LAW.regularisation * np.eye(6)))
    slow_inertia = np.linalg.inv(J_D @ W @ J_D.T + LAW.regularisation * np.eye(6))
    friction_task = (np.diag(slow_inertia) - inertia) / LAW.slow_s
    # Near a singularity the inertia with the other axes held grows without bound; four times the free inertia is enough.
    mass = np.minimum(inertia, 4 / np.diag(mobility))
    K = np.minimum(stiffness, np.maximum((LAW.spring_angle_rad / dead_time) ** 2 * mass, friction_task / (4 * dead_time)))
    B = 2 * damping_ratio * np.sqrt(K * mass)
    B_0 = 2 * LAW.joint_damping_ratio * np.sqrt(K_0 / np.diag(M_inverse))
    J_bar = W @ J_D.T @ slow_inertia @ turn
    return CartesianGains(K, np.maximum(B - friction_task, LAW.min_damping * B), K_0, B_0, J_bar)


def joint_gains(stiffness: Array, M: Array, viscous_friction: Array, dead_time: float) -> JointGains:
    """Return the gains of mode JOINT at inertia `M`, shape (n, n), bounded mode by mode as in `cartesian_gains`."""
    L = np.linalg.cholesky(M)
    L_inverse = np.linalg.inv(L)
    squared, eigenvectors = np.linalg.eigh((L_inverse * stiffness) @ L_inverse.T)
    modes, modes_inverse = L @ eigenvectors, eigenvectors.T @ L_inverse
    friction = modes_inverse**2 @ viscous_friction
    squared = np.clip(squared, 0.0, np.maximum((LAW.spring_angle_rad / dead_time) ** 2, friction / (4 * dead_time)))
    damping = 2 * LAW.joint_damping_ratio * np.sqrt(squared)
    damping = np.maximum(damping - friction, LAW.min_damping * damping)
    return JointGains((modes * squared) @ modes.T, (modes * damping) @ modes.T)


@compiled
def safe_torque(
    wanted: Array, q: Array, gravity: Array, last: Array, rate: float, joints: Array, peak: Array, safe: Array
) -> None:
    """Set `safe` [N m], shape (n,), to `wanted` plus repulsion from joint limits, within all limits; keep the `peak` magnitude.

    It is within the torque limits, also with `gravity` added, and within `rate` of `last` [N m]. Rows of `joints`: middle of each
    joint range [rad], angle from it at which the repulsion begins [rad], its gain [N m/rad^2], torque limit [N m].
    """
    middle, free, gain, limit = joints[0], joints[1], joints[2], joints[3]
    off = q - middle
    depth = np.maximum(np.abs(off) - free, 0.0)
    repulsion = np.minimum(gain * depth**2, REPULSION_FRACTION * limit)
    low = np.maximum(np.maximum(-limit, -limit - gravity), last - rate)
    high = np.minimum(np.minimum(limit, limit - gravity), last + rate)
    safe[:] = np.minimum(np.maximum(wanted - np.sign(off) * repulsion, low), high)
    peak[:] = np.maximum(peak, np.abs(safe))


class AdmittanceTuning(NamedTuple):
    """Constants of the law."""

    yield_s: float = 0.15
    """T. The stiffest wall gives |L| < 1 with any delay."""
    yield_max_m: float = 0.03
    """Maximum |y| per axis."""
    tare_s: float = 0.5
    """Time constant with which the bias of the F/T sensor is learned in free motion."""
    follow_per_s: float = 50.0
    """Gain of the inverse kinematics on the error of pose and of joint positions."""
    catch_up_share: float = 0.2
    """Maximum correction of a joint in free motion over its planned speed: the supervisor stops a tool 1.3 times as fast."""
    catch_up_radps: float = 0.05
    """Smallest value of that maximum, so that an arm at rest arrives."""
    posture_per_s: float = 2.0
    """Gain of the inverse kinematics on the error of the posture."""
    posture_radps: float = 0.5
    """Maximum speed of a joint towards the posture."""
    damping_m: float = 0.02
    """Damping of the least squares: a motion that moves the tool by less per rad follows the posture instead of the pose."""
    damping_rad: float = 0.3
    """Damping for turns of the tool [1]: near a singularity it tilts by a few degrees, and its place stays."""
    speed_share: float = 0.8
    """Maximum commanded speed over a joint's limit: the arm's position loop overshoots, and its driver holds beyond the limit."""


ADMITTANCE = AdmittanceTuning()


class AdmittanceController:
    """The law for one arm; it keeps the commanded joint positions."""

    def __init__(self, model: ArmModel, arm: Arm, tool_mass_kg: float, limit_zone: float, reading_s: float) -> None:
        """Create a controller with an F/T reading every `reading_s`.

        It stays `limit_zone` [rad] away from joint limits where it starts there.

        `tool_mass_kg`: mass below the F/T sensor.
        """
        self._acceleration = arm.acceleration_radps2
        self.model, self._tare_share = model, min(reading_s / ADMITTANCE.tare_s, 1.0)
        self._lower, self._upper = model.position_lower + limit_zone, model.position_upper - limit_zone
        self._weight_W = np.array((0.0, 0.0, -tool_mass_kg * GRAVITY))
        self._damping = np.diag(np.repeat((ADMITTANCE.damping_m, ADMITTANCE.damping_rad), 3) ** 2)
        self._bias: Array | None = None
        self._reading: Array | None = None
        self._fresh = False
        self.reset()

    def reset(self) -> None:
        """Start again from the measured position, as after a pause without commands."""
        self._q: Array | None = None
        self._t: int | None = None
        self._rate = np.zeros(self.model.joints)
        self._yield = np.zeros(3)

    def sense(self, force_S: Array, *, commanded: bool) -> None:
        """Take an F/T reading: force in the sensor's axes, not tared [N], shape (3,).

        `commanded`: the driver executes the commands. While it holds the arm, the arm may be in contact.
        """
        self._reading, self._fresh = force_S, commanded

    def command(self, q: Array, qd: Array, reference: Reference) -> Array:
        """Return the joint positions to command [rad], shape (n,), at measured positions `q` [rad]; `qd` is not used."""
        if self._q is None:
            self._q = np.array(q, dtype=float)
        dt = 0.0 if self._t is None else min(max(reference.t - self._t, 0) * 1e-9, 1 / ADMITTANCE.follow_per_s)
        self._t = reference.t
        model, motion = self.model, reference.motion
        model.update_kinematics(self._q)
        if reference.setpoint.mode is ControlMode.JOINT:
            self._tare(model.R_WI)
            self._yield = np.zeros(3)
            error = motion.q - dt * motion.qd - self._q
            most = np.maximum(ADMITTANCE.catch_up_share * np.abs(motion.qd), ADMITTANCE.catch_up_radps)
            most = np.minimum(most, np.sqrt(2 * self._acceleration * np.abs(error)))
            rate = motion.qd + np.clip(ADMITTANCE.follow_per_s * error, -most, most)
        else:
            rate = self._cartesian(reference, dt)
        rate = rate / max(1.0, float(np.max(np.abs(rate) / (ADMITTANCE.speed_share * model.velocity_limit))))
        change = self._acceleration * dt  # late set-points must not jerk the arm
        self._rate = np.clip(rate, self._rate - change, self._rate + change)
        low, high = np.minimum(self._lower, self._q), np.maximum(self._upper, self._q)
        self._q = np.clip(self._q + dt * self._rate, low, high)
        return self._q

    def _cartesian(self, reference: Reference, dt: float) -> Array:
        """Return joint velocities [rad/s] that follow pose and posture, less what the force makes the tool yield in `dt` [s]."""
        assert self._q is not None
        model, setpoint, motion = self.model, reference.setpoint, reference.motion
        R_WD = motion.R_WD
        force_D = R_WD.T @ (self._force(model.R_WI) + motion.F_W[:3])
        K = setpoint.stiffness[:3]
        goal = np.clip(force_D / np.maximum(K, 1e-9), -ADMITTANCE.yield_max_m, ADMITTANCE.yield_max_m)
        yield_rate = (goal - self._yield) / ADMITTANCE.yield_s
        self._yield = self._yield + dt * yield_rate
        twist = motion.V_WD + np.concatenate((R_WD @ yield_rate, np.zeros(3)))
        error = np.concatenate((motion.p_WD + R_WD @ self._yield - model.p_WI, pin.log3(R_WD @ model.R_WI.T)))
        twist = twist + ADMITTANCE.follow_per_s * (error - dt * twist)
        back = ADMITTANCE.posture_per_s * (motion.q - self._q)
        posture = motion.qd + back / max(1.0, float(np.linalg.norm(back)) / ADMITTANCE.posture_radps)
        J = model.J_W
        return np.asarray(posture + J.T @ np.linalg.solve(J @ J.T + self._damping, twist - J @ posture))

    def _force(self, R_WS: Array) -> Array:
        """Return the force of the environment on the tool [N], world axes, shape (3,); zero before the first tare."""
        if self._bias is None or self._reading is None:
            return np.zeros(3)
        return np.asarray(R_WS @ (self._reading - self._bias) - self._weight_W)

    def _tare(self, R_WS: Array) -> None:
        """Learn the bias: in free motion nothing but the tool loads the sensor, whose axes are those of the indenter."""
        if self._reading is None or not self._fresh:
            return
        self._fresh = False
        bias = self._reading - R_WS.T @ self._weight_W
        self._bias = bias if self._bias is None else self._bias + (bias - self._bias) * self._tare_share
