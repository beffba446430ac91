"""A plant for the controller's tests: the arm on pinocchio, with joint friction, stepped at 1 kHz, and a contact."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin

from palpate_bus.setpoint import ControlMode, Setpoint
from palpate_control.model import ArmModel
from palpate_control.reference import Reference, ReferenceMotion, coordinates
from palpate_models.robot.arm import urdf
from palpate_models.scenario.schema import Robot

DT = 1e-3
ROBOT = Robot()
WORKING = (
    np.deg2rad([0.0, 90.0, 0.0, -60.0, 0.0, 30.0, 0.0]),
    np.deg2rad([15.0, 95.0, -5.0, -95.0, 5.0, -5.0, 20.0]),
    np.deg2rad([-20.0, 80.0, 10.0, -30.0, -10.0, 60.0, -40.0]),
)
"""Postures over the table, tool about vertical: folded, in between, and stretched out [rad]."""

External = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Position and velocity of the indenter in world -> force on it [N], each shape (3,)."""


def no_force(p: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Free space."""
    return np.zeros(3)


class Plant:
    """Rigid-body dynamics without gravity (the driver compensates it exactly), friction implicit, Coulomb smoothed."""

    def __init__(self, q: np.ndarray, robot: Robot = ROBOT) -> None:
        self.model = pin.buildModelFromXML(urdf(robot))
        self.model.gravity.linear = np.zeros(3)
        self.data = self.model.createData()
        self.frame = self.model.getFrameId("indenter")
        self.q, self.qd = np.array(q, dtype=float), np.zeros(7)
        self.viscous = np.diag(self.model.damping)
        self.coulomb = self.model.upperDryFrictionLimit

    def tip(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rotation, position and Jacobian (6, 7) of the indenter in world."""
        J = pin.computeFrameJacobian(self.model, self.data, self.q, self.frame, pin.LOCAL_WORLD_ALIGNED)
        pose = pin.updateFramePlacement(self.model, self.data, self.frame)
        return pose.rotation.copy(), pose.translation.copy(), J

    def step(self, torque: np.ndarray, external: External = no_force) -> None:
        """A millisecond."""
        _, p, J = self.tip()
        force = J[:3].T @ external(p, J[:3] @ self.qd)
        bias = pin.nonLinearEffects(self.model, self.data, self.q, self.qd)
        M = pin.crba(self.model, self.data, self.q)
        M = np.triu(M) + np.triu(M, 1).T
        friction = self.coulomb * np.tanh(self.qd / 1e-3)
        # Coulomb friction is implicit too, by its slope, so that it does not chatter on the light wrist
        slope = np.diag(self.coulomb * (1 - np.tanh(self.qd / 1e-3) ** 2) / 1e-3)
        left = M + DT * (self.viscous + slope)
        right = M @ self.qd + DT * (torque - bias + force - friction + slope @ self.qd)
        self.qd = np.linalg.solve(left, right)
        self.q = self.q + DT * self.qd


def setpoint(arm: ArmModel, at: Any, stamp: int = 0, mode: ControlMode = ControlMode.CARTESIAN, **changes: Any) -> Setpoint:
    """Return a set-point that holds posture `at`, with `changes`."""
    q, rest, none = np.array(at, dtype=float), np.zeros(arm.joints), np.zeros(6)
    arm.update(q, rest)
    K, zeta = np.array([2000.0, 2000.0, 5000.0, 200.0, 200.0, 200.0]), np.full(6, 0.8)
    K_0 = np.full_like(rest, 20.0 if mode is ControlMode.CARTESIAN else 500.0)
    held = Setpoint(stamp, mode, arm.R_WI.copy(), arm.p_WI.copy(), none, none.copy(), K, zeta, q, rest, K_0)
    return held._replace(**changes)


def reference(setpoint_: Setpoint, t: int = 0) -> Reference:
    """Return a set-point as the law follows it at `t` [ns], without extrapolation."""
    return Reference(setpoint_, ReferenceMotion.of(setpoint_.R_WD, coordinates(setpoint_, np.zeros_like(setpoint_.q))), t)
