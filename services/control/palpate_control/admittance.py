"""Admittance control of an arm that takes joint positions: set-point and F/T reading in, joint positions out.

The tool yields from the desired position p_D by y, in axes of the desired indenter frame D:

    T dy/dt + y = F / K,    F = F_measured + F_ff,    p_command = p_D + R_WD y

with the stiffness K of the set-point, the force of the environment on the tool, and the feed-forward force of the set-point. At
rest that is the law of `impedance`: K (p_D - p) + F_ff is the force on the environment. The orientation does not yield.

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

from palpate_bus.setpoint import ControlMode
from palpate_control.model import ArmModel
from palpate_control.reference import Reference
from palpate_models.numerics.frames import GRAVITY, Array
from palpate_models.robot.chain import Arm


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


TUNING = AdmittanceTuning()


class AdmittanceController:
    """The law for one arm; it keeps the commanded joint positions."""

    def __init__(self, model: ArmModel, arm: Arm, tool_mass_kg: float, limit_zone: float, reading_s: float) -> None:
        """Create a controller with an F/T reading every `reading_s`.

        It stays `limit_zone` [rad] away from joint limits where it starts there.

        `tool_mass_kg`: mass below the F/T sensor.
        """
        self._acceleration = arm.acceleration_radps2
        self.model, self._tare_share = model, min(reading_s / TUNING.tare_s, 1.0)
        self._lower, self._upper = model.position_lower + limit_zone, model.position_upper - limit_zone
        self._weight_W = np.array((0.0, 0.0, -tool_mass_kg * GRAVITY))
        self._damping = np.diag(np.repeat((TUNING.damping_m, TUNING.damping_rad), 3) ** 2)
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
        dt = 0.0 if self._t is None else min(max(reference.t - self._t, 0) * 1e-9, 1 / TUNING.follow_per_s)
        self._t = reference.t
        model, motion = self.model, reference.motion
        model.update_kinematics(self._q)
        if reference.setpoint.mode is ControlMode.JOINT:
            self._tare(model.R_WI)
            self._yield = np.zeros(3)
            error = motion.q - dt * motion.qd - self._q
            most = np.maximum(TUNING.catch_up_share * np.abs(motion.qd), TUNING.catch_up_radps)
            most = np.minimum(most, np.sqrt(2 * self._acceleration * np.abs(error)))
            rate = motion.qd + np.clip(TUNING.follow_per_s * error, -most, most)
        else:
            rate = self._cartesian(reference, dt)
        rate = rate / max(1.0, float(np.max(np.abs(rate) / (TUNING.speed_share * model.velocity_limit))))
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
        goal = np.clip(force_D / np.maximum(K, 1e-9), -TUNING.yield_max_m, TUNING.yield_max_m)
        yield_rate = (goal - self._yield) / TUNING.yield_s
        self._yield = self._yield + dt * yield_rate
        twist = motion.V_WD + np.concatenate((R_WD @ yield_rate, np.zeros(3)))
        error = np.concatenate((motion.p_WD + R_WD @ self._yield - model.p_WI, pin.log3(R_WD @ model.R_WI.T)))
        twist = twist + TUNING.follow_per_s * (error - dt * twist)
        back = TUNING.posture_per_s * (motion.q - self._q)
        posture = motion.qd + back / max(1.0, float(np.linalg.norm(back)) / TUNING.posture_radps)
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
