"""Forward and inverse kinematics of robot and tool, on pinocchio."""

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from palpate_models.numerics.frames import Array
from palpate_models.robot.arm import arm_of, urdf
from palpate_models.scenario.schema import Limits, Robot

_WORLD_AXES = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


class KinematicLimits(NamedTuple):
    """Tolerances of the inverse kinematics, and limits of the elbow."""

    tolerance_m: float = 1e-4
    """Position error at which inverse kinematics is solved."""
    tolerance_rad: float = 1e-3
    """Error of the orientation at which inverse kinematics is solved."""
    iterations: int = 60
    straight_rad: float = 0.2
    """Elbow angle below which the arm is near its singularity: it reaches at most 4 mm further, less than the depth error of the
    perceived surface, and the elbow turns at 25 rad/s or more per m/s of wall motion."""
    too_straight_rad: float = 0.15
    """Minimum elbow angle in contact, where the wall may be deeper than perceived."""


KINEMATIC_LIMITS = KinematicLimits()


class IkSolution(NamedTuple):
    """Result of inverse kinematics."""

    q: Array
    """Joint positions [rad], shape (n,)."""
    ok: bool
    """True if the pose is met to `KINEMATIC_LIMITS.tolerance_m` and `KINEMATIC_LIMITS.tolerance_rad` within the limits."""


class ArmKinematics:
    """Kinematics of the arm on pinocchio. W: world, I: indenter (origin at the sphere's centre), S: F/T sensor."""

    def __init__(self, robot: Robot, limits: Limits) -> None:
        self.arm = arm_of(robot)
        self.model = pin.buildModelFromXML(urdf(robot))
        self.data = self.model.createData()
        self._indenter = self.model.getFrameId("indenter")
        self._sensor = self.model.getFrameId("ft_sensor")
        self._R_WS: Array = self.data.oMf[self._sensor].rotation
        """View of pinocchio's latest result."""
        self.lower: Array = self.arm.lower_rad + limits.joint_margin_rad
        """Joint limits used by planning [rad], shape (n,)."""
        self.upper: Array = self.arm.upper_rad - limits.joint_margin_rad

    def stretched(self, q: Array, bend: float) -> bool:
        """Return True if the elbow is bent by less than `bend` [rad] at joint positions q [rad]."""
        return abs(self.arm.bend(q)) < bend

    def pose(self, q: Array) -> Array:
        """Return X_WI, shape (4, 4), at joint positions q [rad]."""
        pin.forwardKinematics(self.model, self.data, q)
        X_WI: Array = pin.updateFramePlacement(self.model, self.data, self._indenter).homogeneous.copy()
        return X_WI

    def poses(self, q: Array) -> tuple[Array, Array]:
        """Return X_WI and R_WS (orientation of the F/T sensor), shapes (4, 4) and (3, 3), at joint positions q [rad]."""
        model, data = self.model, self.data
        pin.forwardKinematics(model, data, q)
        X_WI: Array = pin.updateFramePlacement(model, data, self._indenter).homogeneous
        pin.updateFramePlacement(model, data, self._sensor)
        return X_WI, self._R_WS.copy()

    def jacobian(self, q: Array) -> Array:
        """Return J with V_WI_W = J qd of the sphere's centre, linear rows first, world axes, shape (6, n)."""
        J: Array = pin.computeFrameJacobian(self.model, self.data, q, self._indenter, _WORLD_AXES)
        return J

    def torque_share(self, q: Array, qd: Array, qdd: Array) -> float:
        """Return the largest share of a joint's torque limit in a motion: positions, speeds, accelerations, shapes (m, n)."""
        model, data, limit = self.model, self.data, self.arm.torque_nm
        torque = np.array([pin.rnea(model, data, *row) for row in zip(q, qd, qdd, strict=True)])
        friction = model.damping * np.abs(qd) + model.upperDryFrictionLimit * (np.abs(qd) > 0)
        return float(((np.abs(torque) + friction) / limit).max())

    def solve(self, X_WI: Array, q_near: Array) -> IkSolution:
        """Return joint positions near `q_near` [rad], shape (n,), that put the indenter at X_WI.

        Damped least squares (Nakamura & Hanafusa 1986); the null space tends to `q_near`, and joints are clipped to the limits
        with margin. Deterministic.
        """
        q = np.clip(q_near, self.lower, self.upper)
        least, best = np.inf, IkSolution(q, False)
        for _ in range(KINEMATIC_LIMITS.iterations):
            X, J = self.pose(q), self.jacobian(q)
            R_IW = X[:3, :3].T
            gap, turn = X_WI[:3, 3] - X[:3, 3], pin.log3(R_IW @ X_WI[:3, :3])
            error_m, error_rad = float(np.linalg.norm(gap)), float(np.linalg.norm(turn))
            if (cost := error_m + 0.1 * error_rad) < least:
                ok = error_m < KINEMATIC_LIMITS.tolerance_m and error_rad < KINEMATIC_LIMITS.tolerance_rad
                least, best = cost, IkSolution(q, ok)
            if error_m < KINEMATIC_LIMITS.tolerance_m / 10 and error_rad < KINEMATIC_LIMITS.tolerance_rad / 10:
                break
            A, b = np.vstack((J[:3], R_IW @ J[3:])), np.concatenate((gap, turn))
            scale = min(1.0, 0.3 / max(float(np.linalg.norm(b)), 1e-9))
            pull = 0.1 * (q_near - q)
            q = q + A.T @ np.linalg.solve(A @ A.T + 1e-6 * np.eye(6), scale * b - A @ pull) + pull
            q = np.clip(q, self.lower, self.upper)
        return best
