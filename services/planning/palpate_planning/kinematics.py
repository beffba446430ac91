"""Forward and inverse kinematics of robot and tool, on pinocchio."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from palpate_models import lbr
from palpate_models.scenario import Limits, Robot

Array = NDArray[np.float64]

TOLERANCE_M = 1e-4
"""Position error at which inverse kinematics counts as solved."""
TOLERANCE_RAD = 1e-3
"""Error of the tool axis at which inverse kinematics counts as solved."""


@dataclass(frozen=True, slots=True)
class Solution:
    """Result of inverse kinematics."""

    q: Array
    """Joint positions [rad], shape (7,)."""
    ok: bool
    """Whether the pose is met to `TOLERANCE_M` and `TOLERANCE_RAD` within the limits."""
    error_m: float
    error_rad: float


class Kinematics:
    """The arm as pinocchio sees it. W: world, I: indenter (origin at the sphere's centre), S: F/T sensor."""

    def __init__(self, robot: Robot, limits: Limits) -> None:
        self.model = pin.buildModelFromXML(lbr.urdf(robot))
        self.data = self.model.createData()
        self._indenter = self.model.getFrameId("indenter")
        self._sensor = self.model.getFrameId("ft_sensor")
        self.upper: Array = lbr.POSITION_LIMIT - limits.joint_margin_rad
        """Highest joint positions that planning uses [rad], shape (7,); the lowest are their negatives."""

    def pose(self, q: Array) -> Array:
        """X_WI, shape (4, 4), at joint positions q [rad]."""
        pin.forwardKinematics(self.model, self.data, q)
        X_WI: Array = pin.updateFramePlacement(self.model, self.data, self._indenter).homogeneous.copy()
        return X_WI

    def poses(self, q: Array) -> tuple[Array, Array]:
        """X_WI and R_WS (orientation of the F/T sensor), shapes (4, 4) and (3, 3)."""
        X_WI = self.pose(q)
        R_WS: Array = pin.updateFramePlacement(self.model, self.data, self._sensor).rotation.copy()
        return X_WI, R_WS

    def jacobian(self, q: Array) -> Array:
        """J with V_WI_W = J qd, rows linear then angular, world axes, of the sphere's centre, shape (6, 7)."""
        J: Array = pin.computeFrameJacobian(self.model, self.data, q, self._indenter, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        return J

    def within_limits(self, q: Array) -> bool:
        """Whether q keeps the joint margin."""
        return bool(np.all(np.abs(q) <= self.upper))

    def solve(self, X_WI: Array, q_seed: Array, q_rest: Array | None = None, iterations: int = 60) -> Solution:
        """Joint positions that put the sphere's centre and the tool axis on those of X_WI; the spin about the axis is free.

        Damped least squares on a five-dimensional task (Nakamura & Hanafusa 1986), with the null space drawn to `q_rest`
        (mid-range where None) and joints clipped to the limits with margin. Deterministic; at most `iterations` steps.
        """
        rest = np.zeros(7) if q_rest is None else q_rest
        q = np.clip(np.asarray(q_seed, dtype=float), -self.upper, self.upper)
        p, z = X_WI[:3, 3], X_WI[:3, 2]
        best = (np.inf, q, np.inf, np.inf)
        for _ in range(iterations):
            X = self.pose(q)
            J = self.jacobian(q)
            axis = np.cross(X[:3, 2], z)
            angle = float(np.arctan2(np.linalg.norm(axis), X[:3, 2] @ z))
            turn = axis * (angle / max(float(np.linalg.norm(axis)), 1e-12))
            gap = p - X[:3, 3]
            error_m = float(np.linalg.norm(gap))
            cost = error_m + 0.1 * angle
            if cost < best[0]:
                best = (cost, q, error_m, angle)
            if error_m < TOLERANCE_M / 10 and angle < TOLERANCE_RAD / 10:
                break
            across = X[:3, :2].T  # angular task in the plane across the tool axis: two rows
            A = np.vstack((J[:3], across @ J[3:]))
            b = np.concatenate((gap, across @ turn))
            scale = min(1.0, 0.3 / max(float(np.linalg.norm(b)), 1e-9))
            AT = A.T
            H = A @ AT + 1e-6 * np.eye(5)
            pull = 0.1 * (rest - q)
            step = AT @ np.linalg.solve(H, scale * b - A @ pull) + pull
            q = np.clip(q + step, -self.upper, self.upper)
        _, q, error_m, angle = best
        return Solution(q, error_m < TOLERANCE_M and angle < TOLERANCE_RAD, error_m, angle)
